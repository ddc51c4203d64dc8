"""Serve a live page's WebSocket. The page sends eye positions and receives layers and refreshes.

Each is sent once the page has dealt with the previous one, so that a slow page shows the present.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import cv2
from starlette.websockets import WebSocket, WebSocketDisconnect

from runtime.browser.link import BrowserLink, PageMode
from runtime.browser.still import half_floats, stack_table
from runtime.optics.carried import intensities
from runtime.optics.retina import as_codes
from runtime.records import F32, U8
from runtime.support.artifacts import to_json

RANGES = {"noise_mm": (0.0, 50.0), "latency_ms": (0.0, 1000.0), "camera_fov_deg": (20.0, 150.0)}
RANGES |= {"gap_mm": (1.0, 500.0), "camera": (0.0, 1.0)}  # changing either of these restarts the refresh loop


async def live(socket: WebSocket, link: BrowserLink, *, protocol: str | None) -> None:
    """Serve an authorised page on a socket not accepted yet, with its subprotocol, until it leaves."""
    page, me = _Page(socket, link), object()
    loop = asyncio.get_running_loop()
    if not link.join(me, lambda: _tell(loop, page.news)):
        await socket.close(1013, "too many pages are open")
        return
    try:
        await socket.accept(protocol)
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(page.send(me))
            tasks.create_task(page.receive(me))
    except* (WebSocketDisconnect, RuntimeError, OSError):
        pass
    finally:
        link.leave(me)


def _tell(loop: asyncio.AbstractEventLoop, news: asyncio.Event) -> None:
    with contextlib.suppress(RuntimeError):  # the server's event loop may have ended
        loop.call_soon_threadsafe(news.set)


class _Page:
    """Sends data to one page, and receives its messages."""

    def __init__(self, socket: WebSocket, link: BrowserLink) -> None:
        self._socket, self._link = socket, link
        self.news, self._sent = asyncio.Event(), {"solved": 0, "flat": 0}
        self._under_way = False  # True while the page has not drawn the latest layers
        self._unheard = False  # True while the page has not received the latest refresh
        self._mode: PageMode | None = None
        self._checks, self._moment = False, None  # _checks: send the latest measured refresh, not the live one

    async def send(self, me: object) -> None:
        told: Mapping[str, Any] | None = None
        found: Mapping[str, Any] | None = None
        while True:
            link, mode, shown = self._link, self._link.mode, self._link.shown
            if self._mode is not mode:
                self._mode, self._sent = mode, {"solved": 0, "flat": 0}
                fields = {name: getattr(mode, name) for name in ("fov_deg", "is_sensor", "is_camera", "heads")}
                await self._say({"stack": stack_table(mode.stack), **fields})
            frame, moment = shown.frame, shown.moment
            if self._checks and moment is not None and moment is not self._moment and not self._under_way:
                await self._send_moment(moment)
            if frame is not None and not self._under_way and not self._checks:
                for kind, layers, version, relief in (
                    ("flat", frame.flat, frame.flat_version, None),
                    ("solved", frame.solved, frame.solved_version, frame.relief),
                ):
                    if layers is not None and version != self._sent[kind] and not self._under_way:
                        self._sent[kind], self._under_way = version, True
                        await self._send_layers(kind, layers, relief, shown.told)
            if shown.told is not told and not self._unheard:
                told, self._unheard = shown.told, True
                head = link.head_of(me)
                page_ms = link.page_ms_of(told.get("capture_ns", 0), head or 0)
                await self._say({"refresh": told, "head": head, "page_ms": page_ms})
            if link.found is not found and link.found is not None:
                found = link.found
                await self._say({"found": found})
            await self.news.wait()
            self.news.clear()

    async def _send_layers(self, kind: str, layers: U8, relief: F32 | None, told: Mapping[str, Any]) -> None:
        """Send RGBA layers (N, h, w, 4) of `kind` `solved` or `flat` and, if known, relief (h, w) as 16-bit floats."""
        data = await asyncio.to_thread(lambda: layers.tobytes() + (b"" if relief is None else half_floats(relief)))
        message: dict[str, Any] = {"layers": kind, "size": layers.shape[2:0:-1]}
        message |= {name: told.get(name) for name in ("solved_for", "state_version")}
        await self._say(message if relief is None else message | {"relief": relief.shape[::-1]})
        await self._socket.send_bytes(data)

    async def _send_moment(self, moment: Any) -> None:
        """Send a measured refresh's layers and each eye's target picture, all as RGBA."""
        views = moment.eye_views

        def packed() -> bytes:
            pictures = [*moment.layers, *(as_codes(intensities(picture)) for picture in views.wanted)]
            return b"".join(cv2.cvtColor(p[..., :3], cv2.COLOR_RGB2RGBA).tobytes() for p in pictures)

        numbers = [person.number for person in moment.account.people if person.solved_for_m is not None]
        eyes_m = views.eyes_m.reshape(-1, 2, 3)
        solved_for = [{"number": n, "eyes_m": pair} for n, pair in zip(numbers, eyes_m, strict=True)]
        self._moment, self._under_way = moment, True
        data = await asyncio.to_thread(packed)
        height, width = views.wanted[0].shape[:2]
        size = [moment.layers.shape[2], moment.layers.shape[1]]
        message = {"layers": "solved", "solved_for": solved_for, "state_version": moment.state_version, "size": size}
        await self._say(message | {"target": [width, height], "frame": moment.account.frame})
        await self._socket.send_bytes(data)

    async def receive(self, me: object) -> None:
        picture_ms = 0.0
        while True:
            given = await self._socket.receive()
            if given["type"] == "websocket.disconnect":
                raise WebSocketDisconnect(given.get("code", 1000))
            if given.get("bytes") is not None:
                if self._link.is_camera(me) and self._link.mode.is_camera:
                    self._link.send_picture(given["bytes"], picture_ms)
                continue
            message = json.loads(given["text"])
            if not isinstance(message, dict):
                continue
            picture_ms = _number(message.get("picture_ms"), picture_ms)
            if isinstance(message.get("checks"), bool):
                self._checks, self._moment, self._sent["solved"] = message["checks"], None, 0
                self.news.set()
            if message.get("drawn"):
                self._under_way = False
                self.news.set()
            if message.get("heard"):
                self._unheard = False
                self.news.set()
            if "eyes" in message and (head := self._link.head_of(me)) is not None:
                with contextlib.suppress(ValueError, TypeError):
                    page_ms = float(message.get("page_ms", 0.0))
                    self._link.see(message["eyes"], page_ms, head, message.get("velocity_m_s"))
            for name, (least, most) in RANGES.items():
                value = _number(message.get(name), None)
                if value is None or (name == "camera" and not self._link.is_camera(me)):
                    continue
                if not least <= value <= most:
                    continue
                if name in ("gap_mm", "camera"):
                    self._link.wish(name, value)
                else:
                    self._link.sensor = replace(self._link.sensor, **{name: value})

    async def _say(self, message: dict[str, Any]) -> None:
        await self._socket.send_text(to_json(message))


def _number(value: Any, default: Any) -> Any:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else default
