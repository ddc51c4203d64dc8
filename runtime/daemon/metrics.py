"""What Prometheus is told, on a loopback port; nothing is imported or listened to while it is off."""

from __future__ import annotations

import asyncio
from asyncio import StreamReader, StreamWriter
from typing import Any

from prometheus_client import CONTENT_TYPE_LATEST, CollectorRegistry, Counter, Enum, Histogram, generate_latest

from runtime.clock import NS_PER_MS
from runtime.daemon.listener import LIMITED, Listener
from runtime.errors import InputError
from runtime.records import RefreshAccount, State

LOOPBACK = "127.0.0.1"
BUCKETS_MS = (0.1, 0.25, 0.5, 1, 2, 4, 8, 12, 16, 20, 25, 33, 50, 75, 100, 150, 250, 500, 1000)
BUCKETS_MM = (0.1, 0.2, 0.5, 1, 1.5, 2, 3, 4, 6, 8, 12, 20)


class Metrics:
    """Counters and histograms of the running daemon. Rates are counters: who scrapes divides by the time between."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        common: dict[str, Any] = {"registry": self.registry, "namespace": "phasestack"}

        def histogram(name: str, text: str, *labels: str, buckets: tuple[float, ...] = BUCKETS_MS) -> Histogram:
            return Histogram(name, text, labels, buckets=buckets, **common)

        self._stages = histogram("stage_milliseconds", "time of one stage of a frame", "stage")
        self._skew = histogram("skew_milliseconds", "between the first and the last panel")
        self._photon = histogram("photon_latency_milliseconds", "from capture to the panels' light")
        self._interval = histogram("interval_milliseconds", "between two refreshes")
        self._age = histogram("solution_age_milliseconds", "from the instant solved for to the light")
        self._sigma = histogram("eye_sigma_millimetres", "standard deviation of an eye's axis", buckets=BUCKETS_MM)
        self._frames = Counter("refreshes", "of the panels", ["result"], **common)
        self._inferences = Counter("solutions", "ran: first shown by a refresh", ["result"], **common)
        self._faults = Counter("faults", "faults that were survived", ["part"], **common)
        self._missed = Counter("missed_blanks", "vertical blanks that a refresh came too late for", **common)
        self._state = Enum("state", "what the daemon is doing", states=[str(state) for state in State], **common)
        self._presented_ns = 0
        self._counted: dict[str, int] = {}
        self._scraped: _Scraped | None = None

    def refresh(self, account: RefreshAccount, *, faults: dict[str, int], missed_blanks: int) -> None:
        """One refresh; faults (of `sensor`, `content`, `model`, ...) and blanks that were missed since the start."""
        for stage, spent_ms in account.stage_ms.items():
            self._stages.labels(stage).observe(spent_ms)
        for part, count in faults.items():
            self._faults.labels(part).inc(self._since_last(part, count))
        self._missed.inc(self._since_last("", missed_blanks))
        self._frames.labels("presented" if account.presented else "dropped").inc()
        self._inferences.labels(account.inference).inc()
        self._state.state(str(account.state))
        if account.solution_age_ms is not None:
            self._age.observe(account.solution_age_ms)
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
            self._photon.observe((account.photon_ns - account.capture_ns) / NS_PER_MS)

    def _since_last(self, name: str, count: int) -> int:
        more = count - self._counted.get(name, 0)
        self._counted[name] = count
        return more

    def serve(self, port: int) -> None:
        """Answer on loopback, on a thread of its own. Raises InputError where the port is taken."""
        try:
            self._scraped = _Scraped(port, self.registry)
        except OSError as error:
            raise InputError("service", "metrics_port", f"{port} can't be used ({error.strerror})") from error
        self._scraped.start()

    def close(self) -> None:
        """Stop answering. May be called twice."""
        if self._scraped is not None:
            self._scraped.close()


class _Scraped(Listener):
    """HTTP for who scrapes: any local user may ask."""

    def __init__(self, port: int, registry: CollectorRegistry) -> None:
        self._registry = registry
        super().__init__("metrics", lambda serve: asyncio.start_server(serve, LOOPBACK, port, **LIMITED))

    async def converse(self, reader: StreamReader, writer: StreamWriter) -> None:
        asked = (await self.request(reader, b"\r\n\r\n")).split(b" ", 1)[0]
        if asked in (b"GET", b"HEAD"):
            text = generate_latest(self._registry)
            await self.send(writer, _answer("200 OK", text if asked == b"GET" else b""))
        elif asked:
            await self.send(writer, _answer("405 Method Not Allowed"))

    def refuse(self, writer: StreamWriter, why: str) -> None:
        writer.write(_answer("503 Service Unavailable", why.encode()))


def _answer(status: str, text: bytes = b"") -> bytes:
    kind = CONTENT_TYPE_LATEST if status.startswith("200") else "text/plain"
    head = f"HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(text)}\r\nConnection: close\r\n\r\n"
    return head.encode() + text
