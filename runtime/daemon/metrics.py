"""What Prometheus is told, on a loopback port; nothing is imported or listened to while it is off."""

from __future__ import annotations

from threading import Thread
from typing import Any
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, Counter, Enum, Gauge, Histogram, start_http_server

from runtime.clock import NS_PER_MS
from runtime.errors import InputError
from runtime.records import FrameAccount, State

LOOPBACK = "127.0.0.1"
BUCKETS_MS = (0.1, 0.25, 0.5, 1, 2, 4, 8, 12, 16, 20, 25, 33, 50, 75, 100, 150, 250, 500, 1000)


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
        self._frames = Counter("frames", "turns of the loop", ["result"], **common)
        self._inferences = Counter("inferences", "what became of the network's run", ["result"], **common)
        self._faults = Counter("faults", "faults that were survived", ["part"], **common)
        self._missed = Counter("missed_vblanks", "vertical blanks with the old picture", **common)
        self._state = Enum("state", "what the daemon is doing", states=[str(state) for state in State], **common)
        self._fps = Gauge("presented_frames_per_second", "over the last second", **common)
        self._psnr = Gauge(
            "displayed_psnr_decibels", "estimate of what the eyes see; only where it is asked for", **common
        )
        self._children: dict[str, Any] = {}
        self._server: tuple[WSGIServer, Thread] | None = None

    def frame(self, account: FrameAccount) -> None:
        """One turn of the loop."""
        for stage, spent_ms in account.stage_ms.items():
            child = self._children.get(stage)
            if child is None:
                child = self._children[stage] = self._stages.labels(stage)
            child.observe(spent_ms)
        self._frames.labels("presented" if account.presented else "dropped").inc()
        self._inferences.labels(account.inference).inc()
        self._state.state(str(account.state))
        if account.presented:
            self._skew.observe(account.skew_ms)
            if account.capture_ns:
                self._age.observe((account.present_ns - account.capture_ns) / NS_PER_MS)

    def fault(self, part: str) -> None:
        """A fault of `sensor`, `content`, `model`, `panel`, `record`, ... that the daemon lives on with."""
        self._faults.labels(part).inc()

    def missed_vblanks(self, count: int) -> None:
        """As a PresentReport says."""
        if count:
            self._missed.inc(count)

    def fps(self, frames_per_second: float) -> None:
        """The presented rate, whenever it was worked out."""
        self._fps.set(frames_per_second)

    def psnr(self, decibels: float) -> None:
        """Displayed quality of one frame; costs far more than the frame, so that nobody calls it by default."""
        self._psnr.set(decibels)

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
