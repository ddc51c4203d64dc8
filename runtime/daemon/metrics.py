"""What Prometheus is told, on a loopback port; nothing is imported or listened to while it is off."""

from __future__ import annotations

import socket
from typing import Any

from prometheus_client import CollectorRegistry, Counter, Enum, Histogram
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from runtime.clock import NS_PER_MS
from runtime.daemon.request_server import Limits, RequestServer
from runtime.errors import InputError
from runtime.records import RefreshAccount, State

LOOPBACK = "127.0.0.1"
BUCKETS_MS = (0.1, 0.25, 0.5, 1, 2, 4, 8, 12, 16, 20, 25, 33, 50, 75, 100, 150, 250, 500, 1000)
CLIENTS_MAX = 16
REQUEST_BYTES = 8192
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
        self._server: RequestServer | None = None

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
        listening = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((LOOPBACK, port))
            # Linux lets two bind one port until one of them listens.
            listening.listen()
        except OSError as error:
            listening.close()
            raise InputError("service", "metrics_port", f"{port} can't be used ({error.strerror})") from error
        limits = Limits(clients=CLIENTS_MAX, request_bytes=REQUEST_BYTES)
        self._server = RequestServer(listening, _Scrapes(self.registry), limits, name="metrics")

    @property
    def address(self) -> tuple[str, int] | None:
        """Where it answers."""
        return self._server.address if self._server is not None else None

    def close(self) -> None:
        """Stop answering. May be called twice."""
        if self._server is not None:
            self._server.close()
            self._server = None


class _Scrapes:
    """HTTP as far as a scrape needs it: one GET a connection, its body and its other headers not looked at."""

    one_request = True

    def __init__(self, registry: CollectorRegistry) -> None:
        self._registry = registry

    def cut(self, received: bytes, *, ended: bool) -> tuple[bytes, bytes] | None:
        head, blank, rest = received.replace(b"\r\n", b"\n").partition(b"\n\n")
        return (head, rest) if blank else None

    def answer(self, request: bytes) -> bytes:
        method, _, rest = request.partition(b"\n")[0].partition(b" ")
        path = rest.partition(b" ")[0].partition(b"?")[0]
        if method not in (b"GET", b"HEAD"):
            return _response("405 Method Not Allowed", "GET alone is answered\n", more="Allow: GET, HEAD\r\n")
        if path not in (b"/", b"/metrics"):
            return _response("404 Not Found", "/metrics is what there is\n", head_only=method == b"HEAD")
        text = generate_latest(self._registry).decode()
        return _response("200 OK", text, kind=CONTENT_TYPE_LATEST, head_only=method == b"HEAD")

    def refusal(self, why: str) -> bytes:
        return _response("503 Service Unavailable", f"{why}\n")


def _response(
    status: str, text: str, *, kind: str = "text/plain; charset=utf-8", more: str = "", head_only: bool = False
) -> bytes:
    body = text.encode()
    head = (
        f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(body)}\r\nConnection: close\r\n{more}\r\n"
    )
    return head.encode() + (b"" if head_only else body)
