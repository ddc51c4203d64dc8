"""Web application for the operator's page.

The daemon can be reached only with a token, which the page's script stores (`session.js`) and sends with every request.
The token cannot be read from other sites or ports, and because it is not a cookie, their requests do not carry it.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import cache
from importlib.resources import files
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from runtime.browser.link import BrowserLink
from runtime.browser.still import asset as browser_asset
from runtime.daemon.client import LOOKED_UP_AGAIN_S, REQUEST_MAX_BYTES, REQUEST_S, DaemonClient
from runtime.daemon.commands import NAMES
from runtime.errors import InputError
from runtime.page.live import live
from runtime.page.metrics import exposition
from runtime.page.token import same
from runtime.support.artifacts import to_json
from runtime.support.untrusted_input import parsed_json

SCRIPT, STYLE = "text/javascript", "text/css"
PROTOCOL = "phasestack"  # WebSocket subprotocol
METRICS = "text/plain; version=0.0.4; charset=utf-8"  # media type of the Prometheus text format
ASSETS = {"page.css": STYLE, "look.css": STYLE}
ASSETS |= dict.fromkeys(("session.js", "page.js", "display.js", "look.js", "try.js", "choice.js"), SCRIPT)
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'none'; base-uri 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}
Handler = Callable[[Request], Awaitable[Response]]


class JsonAnswer(JSONResponse):
    """JSON response in pure ASCII, because it may contain file names that are not valid UTF-8."""

    def render(self, content: Any) -> bytes:
        return to_json(content).encode()


class TooLong(ValueError):
    """Raised if a request's body is longer than `REQUEST_MAX_BYTES`."""


def application(daemon: DaemonClient, token: str, *, link: BrowserLink | None = None) -> Starlette:
    """Create the web application, whose server must listen only on loopback, and whose requests need the
    token. `link` leads to the refresh loop if the page is itself the display.
    """

    def permitted(request: HTTPConnection) -> bool:
        kind, _, key = request.headers.get("authorization", "").partition(" ")
        return kind.lower() == "bearer" and same(key.strip(), token)

    def guarded(handler: Handler) -> Handler:
        async def answer(request: Request) -> Response:
            if not permitted(request):
                return JsonAnswer(
                    {"ok": False, "error": "not logged in; send the token"}, 401, {"WWW-Authenticate": "Bearer"}
                )
            return await handler(request)

        return answer

    async def index(request: Request) -> Response:
        return HTMLResponse(_asset("page.html") if link is None else browser_asset("try.html"))

    async def operator(request: Request) -> Response:
        return HTMLResponse(_asset("page.html"))

    async def connected(socket: WebSocket) -> None:
        # In a browser, the list of protocols is the only WebSocket request header that a script can set.
        offered = [one.strip() for one in socket.headers.get("sec-websocket-protocol", "").split(",")]
        if link is None or not (permitted(socket) or any(same(one, token) for one in offered)):
            await socket.close(1008)
            return
        await live(socket, link, protocol=PROTOCOL if PROTOCOL in offered else None)

    async def asset(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            return Response(status_code=404)
        own = name.startswith(("page", "session"))
        return Response(_asset(name) if own else browser_asset(name), media_type=ASSETS[name])

    async def look_up(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in LOOKED_UP_AGAIN_S:
            return JsonAnswer({"ok": False, "error": "unknown lookup"}, 404)
        answer = await run_in_threadpool(daemon.look_up, name)
        return JsonAnswer(answer, 200 if answer.get("ok") else 503)

    async def metrics(request: Request) -> Response:
        answer = await run_in_threadpool(daemon.look_up, "status")
        if not answer.get("ok"):
            return PlainTextResponse(f"{answer.get('error', '')}\n", 503)
        return PlainTextResponse(exposition(answer), media_type=METRICS)

    async def do(request: Request) -> Response:
        try:
            command = parsed_json(await _body(request), source="the request")
        except TooLong:
            return JsonAnswer({"ok": False, "error": "the request is too long"}, 413)
        except (InputError, ValueError):
            command = None
        if not isinstance(command, dict) or command.get("command") not in NAMES:
            return JsonAnswer({"ok": False, "error": f"command: must be one of {', '.join(NAMES)}"}, 400)
        answer = await run_in_threadpool(daemon.tell, command["command"], command.get("value"))
        code = 200 if answer.get("ok") else 503 if answer.get("running") is False else 409
        return JsonAnswer(answer, code)

    routes: list[BaseRoute] = [
        Route("/", index, methods=["GET"]),
        Route("/do", guarded(do), methods=["POST"]),
        Route("/metrics", guarded(metrics), methods=["GET"]),
        Route("/now/{name}", guarded(look_up), methods=["GET"]),
        Route("/operator", operator, methods=["GET"]),
        WebSocketRoute("/live", connected),
        Route("/{name}", asset, methods=["GET"]),
    ]
    return Starlette(routes=routes, middleware=[Middleware(BaseHTTPMiddleware, dispatch=_guard)])


async def _guard(request: Request, handler: Handler) -> Response:
    """Answer a request, adding security headers."""
    answer = await handler(request)
    answer.headers.update(HEADERS)
    return answer


async def _body(request: Request) -> bytes:
    """Return a request's body. Raises TooLong, or ValueError if it does not arrive within `REQUEST_S`."""
    received = b""
    try:
        async with asyncio.timeout(REQUEST_S):
            async for piece in request.stream():
                received += piece
                if len(received) > REQUEST_MAX_BYTES:
                    raise TooLong
    except (ClientDisconnect, TimeoutError):
        raise ValueError from None
    return received


@cache
def _asset(name: str) -> str:
    return (files("runtime.page") / "assets" / name).read_text(encoding="utf-8")
