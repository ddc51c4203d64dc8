"""The live page's connection: the viewer's eyes come in, layers and refreshes go out. On the web server's loop."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from runtime.browser.link import BrowserLink
from runtime.browser.still import stack_table
from runtime.records import Layers, pixels_of
from runtime.support.artifacts import to_json

PAGES_MAX = 8
RANGES = {"noise_mm": (0.0, 50.0), "latency_ms": (0.0, 1000.0), "gap_mm": (1.0, 500.0)}


async def live(socket: WebSocket, link: BrowserLink) -> None:
    """One page, from its first message to its last; it is permitted already."""
    if len(link.news) >= PAGES_MAX:
        await socket.close(1013, "too many pages")
        return
    await socket.accept()
    page = _Page(socket, link)
    loop, me = asyncio.get_running_loop(), object()
    link.news[me] = lambda: _tell(loop, page.news)
    try:
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(page.send(me))
            tasks.create_task(page.receive(me))
    except* (WebSocketDisconnect, RuntimeError, OSError):
        pass
    finally:
        was_viewer = link.is_viewer(me)
        del link.news[me]
        if was_viewer and link.is_sensor:
            link.see(None, 0.0)


def _tell(loop: asyncio.AbstractEventLoop, news: asyncio.Event) -> None:
    with contextlib.suppress(RuntimeError):  # the server's loop has ended
        loop.call_soon_threadsafe(news.set)


class _Page:
    """What one page has, and what it is sent next: the newest, once what went before has been drawn."""

    def __init__(self, socket: WebSocket, link: BrowserLink) -> None:
        self._socket, self._link = socket, link
        self.news, self._sent = asyncio.Event(), {"solved": 0, "flat": 0}
        self._under_way = False  # layers that the page has not taken in yet
        self._stack: Any = None

    async def send(self, me: object) -> None:
        told: dict[str, Any] = {}
        while True:
            link, (frame, account) = self._link, self._link.shown
            if self._stack is not link.stack:
                self._stack, self._sent = link.stack, {"solved": 0, "flat": 0}
                fields = {"fov_deg": link.fov_deg, "is_sensor": link.is_sensor}
                await self._say({"stack": stack_table(link.stack), **fields})
            if frame is not None and not self._under_way:
                for kind, layers, version in (
                    ("flat", frame.flat, frame.flat_version),
                    ("solved", frame.solved, frame.solved_version),
                ):
                    if layers is not None and version != self._sent[kind] and not self._under_way:
                        await self._send_layers(kind, layers, version, account.get("solved_for_m"))
            if account is not told:
                told = account
                await self._say({"refresh": told, "viewer": link.is_viewer(me)})
            await self.news.wait()
            self.news.clear()

    async def _send_layers(self, kind: str, layers: Layers, version: int, solved_for_m: Any) -> None:
        pixels = await asyncio.to_thread(lambda: pixels_of(layers).tobytes())
        self._sent[kind], self._under_way = version, True
        await self._say({"layers": kind, "solved_for_m": solved_for_m})
        await self._socket.send_bytes(pixels)

    async def receive(self, me: object) -> None:
        while True:
            message = json.loads(await self._socket.receive_text())
            if not isinstance(message, dict):
                continue
            if message.get("drawn"):
                self._under_way = False
                self.news.set()
            if "eyes" in message and self._link.is_viewer(me) and self._link.is_sensor:
                with contextlib.suppress(ValueError, TypeError):
                    self._link.see(message["eyes"], float(message.get("page_ms", 0.0)))
            for name, (least, most) in RANGES.items():
                value = message.get(name)
                if isinstance(value, int | float) and math.isfinite(value):
                    self._set(name, min(max(float(value), least), most))

    def _set(self, name: str, value: float) -> None:
        if name == "gap_mm":
            self._link.gap_wanted_m = value * 1e-3
        else:
            setattr(self._link, name, value)

    async def _say(self, message: dict[str, Any]) -> None:
        await self._socket.send_text(to_json(message))
