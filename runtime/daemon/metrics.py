"""What Prometheus is told, on a loopback port; nothing is imported or listened to while it is off."""

from __future__ import annotations

from threading import Thread
from typing import Any
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, Counter, Enum, Histogram, start_http_server

from runtime.clock import NS_PER_MS
from runtime.errors import InputError
from runtime.records import RefreshAccount, State

LOOPBACK = "127.0.0.1"
BUCKETS_MS = (0.1, 0.25, 0.5, 1, 2, 4, 8, 12, 16, 20, 25, 33, 50, 75, 100, 150, 250, 500, 1000)

BUCKETS_MM = (0.1, 0.2, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 20)


class Metrics:
    """Counters and histograms of the running daemon."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        common: dict[str, Any] = {"registry": self.registry, "namespace": "phasestack"}
        self._stages = Histogram(
            "stage_milliseconds", "time of one stage of a frame", ["stage"], buckets=BUCKETS_MS, **common
        )
        self._skew = Histogram(
            "skew_milliseconds", "between the first and the last panel", buckets=BUCKETS_MS, **common
        )
        self._age = Histogram(
            "photon_latency_milliseconds", "from capture to the panels' light", buckets=BUCKETS_MS, **common
        )
        self._interval = Histogram("interval_milliseconds", "between two refreshes", buckets=BUCKETS_MS, **common)
        self._solution_age = Histogram(
            "solution_age_milliseconds", "from the instant solved for to the light", buckets=BUCKETS_MS, **common
        )
        self._sigma = Histogram(
            "eye_sigma_millimetres",
            "standard deviation of an axis of the eyes",
            buckets=BUCKETS_MM,
            **common,
        )
        self._frames = Counter("refreshes", "of the panels", ["result"], **common)
        self._inferences = Counter("solutions", "ran: first shown by a refresh", ["result"], **common)
        self._faults = Counter("faults", "faults that were survived", ["part"], **common)
        self._missed = Counter("missed_blanks", "vertical blanks that a refresh came too late for", **common)
        self._state = Enum("state", "what the daemon is doing", states=[str(state) for state in State], **common)
        self._presented_ns = 0
        self._children: dict[str, Any] = {}
        self._server: tuple[WSGIServer, Thread] | None = None

    def refresh(self, account: RefreshAccount) -> None:
        """One refresh. Rates are counters: whoever scrapes them divides by the time between."""
        for stage, spent_ms in account.stage_ms.items():
            child = self._children.get(stage)
            if child is None:
                child = self._children[stage] = self._stages.labels(stage)
            child.observe(spent_ms)
        self._frames.labels("presented" if account.presented else "dropped").inc()
        self._inferences.labels(account.inference).inc()
        self._state.state(str(account.state))
        if account.solution_age_ms is not None:
            self._solution_age.observe(account.solution_age_ms)
        if account.eye_sigma_mm is not None:
            self._sigma.observe(account.eye_sigma_mm)
        if not account.presented:
            self._presented_ns = 0
            return
        if self._presented_ns:
            self._interval.observe((account.present_ns - self._presented_ns) / NS_PER_MS)
        self._presented_ns = account.present_ns
        self._skew.observe(account.skew_ms)
        if account.capture_ns:
            self._age.observe((account.photon_ns - account.capture_ns) / NS_PER_MS)

    def fault(self, part: str) -> None:
        """A fault of `sensor`, `content`, `model`, `panel`, `record`, ... that the daemon lives on with."""
        self._faults.labels(part).inc()

    def missed_blanks(self, count: int) -> None:
        """Since the last call."""
        if count:
            self._missed.inc(count)

    def serve(self, port: int) -> None:
        """Answer on loopback, on a thread of its own. Raises InputError where the port is taken."""
        try:
            self._server = start_http_server(port, addr=LOOPBACK, registry=self.registry)
        except OSError as error:
            raise InputError("service", "metrics_port", f"{port} can't be used ({error.strerror})") from None

    def close(self) -> None:
        """Stop answering. May be called twice."""
        if self._server is not None:
            server, thread = self._server
            self._server = None
            server.shutdown()
            server.server_close()
            thread.join(timeout=2.0)
