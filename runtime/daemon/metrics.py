"""What Prometheus is told, on a loopback port: the status's numbers, each under its own name."""

from __future__ import annotations

import asyncio
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Iterator
from typing import Any

from runtime.daemon.listener import LIMITED, Listener
from runtime.errors import InputError

LOOPBACK = "127.0.0.1"
KIND = "text/plain; version=0.0.4; charset=utf-8"


class Metrics(Listener):
    """HTTP for who scrapes: any local user may ask."""

    def __init__(self, port: int, status: Callable[[], dict[str, Any]]) -> None:
        """status: as the socket answers it. Raises InputError where the port is taken."""
        self._status = status
        try:
            super().__init__("metrics", lambda serve: asyncio.start_server(serve, LOOPBACK, port, **LIMITED))
        except OSError as error:
            raise InputError("service", "metrics_port", f"{port} can't be used ({error.strerror})") from error
        self.start()

    async def converse(self, reader: StreamReader, writer: StreamWriter) -> None:
        asked = (await self.request(reader, b"\r\n\r\n")).split(b" ", 1)[0]
        if asked in (b"GET", b"HEAD"):
            text = "\n".join([*told(self._status()), ""]).encode()
            await self.send(writer, _answer("200 OK", text if asked == b"GET" else b""))
        elif asked:
            await self.send(writer, _answer("405 Method Not Allowed"))

    def refuse(self, writer: StreamWriter, why: str) -> None:
        writer.write(_answer("503 Service Unavailable", why.encode()))


def told(status: dict[str, Any]) -> Iterator[str]:
    """A line a number; the keys of what stands below a name are labels: `phasestack_stage_ms{of="render p50"} 3.1`.

    What was not measured is left out.
    """
    yield f'phasestack_state{{of="{str(status.get("state", "")).partition(":")[0]}"}} 1'
    for name, value in status.items():
        for of, number in _numbers(value, ()):
            labels = f'{{of="{" ".join(of)}"}}' if of else ""
            yield f"phasestack_{name}{labels} {number}"


def _numbers(value: Any, of: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], float]]:
    if isinstance(value, int | float):
        yield of, float(value)
    elif isinstance(value, dict):
        for key, each in value.items():
            if str(key).replace("_", "").replace(" ", "").isalnum():
                yield from _numbers(each, (*of, str(key)))


def _answer(status: str, text: bytes = b"") -> bytes:
    head = f"HTTP/1.1 {status}\r\nContent-Type: {KIND}\r\nContent-Length: {len(text)}\r\nConnection: close\r\n\r\n"
    return head.encode() + text
