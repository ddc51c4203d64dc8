"""The page's web application: what may be seen and done with the token, and nothing without.

A GET never does anything. What does is a POST from the page itself: the browser says so (`Origin`), or who posts
gives the token in the request, which no other site can.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import re
from collections.abc import Awaitable, Callable
from functools import cache
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.middleware.base import BaseHTTPMiddleware
from starlette.requests import ClientDisconnect, HTTPConnection, Request
from starlette.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket

from runtime.browser.link import BrowserLink
from runtime.browser.still import asset as browser_asset
from runtime.daemon.client import LOOKED_UP_AGAIN_S, Daemon
from runtime.daemon.commands import NAMES
from runtime.errors import InputError
from runtime.page.connections import REQUEST_S
from runtime.page.live import live
from runtime.page.token import cookie_of, same
from runtime.support.artifacts import to_json
from runtime.support.untrusted_input import parsed_json

BODY_MAX_BYTES = 65536
SCRIPT, STYLE = "text/javascript", "text/css"
ASSETS = {"page.css": STYLE, "look.css": STYLE}
ASSETS |= dict.fromkeys(("page.js", "display.js", "look.js", "try.js"), SCRIPT)
Handler = Callable[[Request], Awaitable[Response]]


class Answer(JSONResponse):
    """JSON in plain ASCII: a name need not be UTF-8."""

    def render(self, content: Any) -> bytes:
        return to_json(content).encode()


class TooLong(ValueError):
    """A request's body."""


def application(daemon: Daemon, token: str, *, port: int, link: BrowserLink | None = None) -> Starlette:
    """The application, on loopback: by another name than this machine's own nobody reaches it.

    port: that it is served on. Browsers know cookies by the host alone: another display's page has another name.
    link: this page is the display itself; the address with the token opens it.
    """
    name, cookie = f"phasestack-{port}", cookie_of(token)

    def permitted(request: HTTPConnection) -> bool:
        kind, _, given = request.headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer":
            return same(given.strip(), token)
        return same(request.cookies.get(name, ""), cookie)

    def guarded(handler: Handler) -> Handler:
        async def answer(request: Request) -> Response:
            if not permitted(request):
                return Answer({"ok": False, "error": "log in first"}, 401, {"WWW-Authenticate": "Bearer"})
            return await handler(request)

        return answer

    async def index(request: Request) -> Response:
        if link is not None and same(request.query_params.get("token", ""), token):
            return entered()
        if not permitted(request):
            return HTMLResponse(_login(), 401)
        return HTMLResponse(_asset("page.html") if link is None else browser_asset("try.html"))

    async def operator(request: Request) -> Response:
        return HTMLResponse(_asset("page.html"))

    async def connected(socket: WebSocket) -> None:
        own = (socket.headers.get("origin") or "").partition("://")[2] == socket.headers.get("host")
        bearer = socket.headers.get("authorization", "").lower().startswith("bearer ")
        if link is None or _refused(socket) or not permitted(socket) or not (own or bearer):
            await socket.close(1008)
            return
        await live(socket, link)

    async def asset(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in ASSETS:
            return Response(status_code=404)
        return Response(_asset(name) if name.startswith("page") else browser_asset(name), media_type=ASSETS[name])

    async def look_up(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in LOOKED_UP_AGAIN_S:
            return Answer({"ok": False, "error": "there is no such thing to look up"}, 404)
        answer = await run_in_threadpool(daemon.look_up, name)
        return Answer(answer, 200 if answer.get("ok") else 503)

    async def do(request: Request) -> Response:
        try:
            asked = parsed_json(await _body(request), source="the request")
        except TooLong:
            return Answer({"ok": False, "error": "the request is too long"}, 413)
        except (InputError, ValueError):
            asked = None
        if not isinstance(asked, dict) or asked.get("command") not in NAMES:
            return Answer({"ok": False, "error": f"command: one of {', '.join(NAMES)}"}, 400)
        answer = await run_in_threadpool(daemon.tell, asked["command"], asked.get("value"))
        code = 200 if answer.get("ok") else 503 if answer.get("running") is False else 409
        return Answer(answer, code)

    async def login(request: Request) -> Response:
        try:
            fields = parse_qs((await _body(request)).decode("utf-8", "replace"))
        except ValueError:  # too long, or the client went away
            fields = {}
        if not same(fields.get("token", [""])[0].strip(), token):
            return HTMLResponse(_login("That is not the token."), 401)
        return entered()

    def entered() -> Response:
        answer = RedirectResponse("/", 303)
        answer.set_cookie(name, cookie, httponly=True, samesite="strict", path="/")
        return answer

    routes: list[BaseRoute] = [
        Route("/", index, methods=["GET"]),
        Route("/login", login, methods=["POST"]),
        Route("/do", guarded(do), methods=["POST"]),
        Route("/now/{name}", guarded(look_up), methods=["GET"]),
        Route("/operator", guarded(operator), methods=["GET"]),
        WebSocketRoute("/live", connected),
        Route("/{name}", guarded(asset), methods=["GET"]),
    ]
    return Starlette(routes=routes, middleware=[Middleware(BaseHTTPMiddleware, dispatch=_guard)])


async def _guard(request: Request, handler: Handler) -> Response:
    """For every request: whose page it comes from, by which name, and what the answer may load."""
    refused = _refused(request)
    answer = Answer({"ok": False, "error": refused}, 403) if refused else await handler(request)
    answer.headers.update(_headers())
    return answer


def _refused(request: HTTPConnection) -> str:
    host = request.headers.get("host", "")
    # A name that another site has made to lead here is none of ours.
    if re.sub(r":\d*$", "", host) not in ("localhost", "127.0.0.1", "[::1]"):
        return "not by this name: open http://localhost"
    if request.scope.get("method", "GET") in ("GET", "HEAD"):
        return ""
    origin = request.headers.get("origin")
    if origin is None:
        given = request.headers.get("authorization", "").lower().startswith("bearer ")
        return "" if given else "a browser's request says where it comes from (Origin)"
    return "" if origin.partition("://")[2] == host else "from another site"


@cache
def _headers() -> dict[str, str]:
    style = base64.b64encode(hashlib.sha256(_login_style().encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'self'; style-src 'self' 'sha256-{style}'; img-src 'self' data:; "
        "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    )
    return {
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "X-Frame-Options": "DENY",
        "Referrer-Policy": "same-origin",
        "Cross-Origin-Resource-Policy": "same-origin",
        "Cross-Origin-Opener-Policy": "same-origin",
        "Cache-Control": "no-store",
    }


async def _body(request: Request) -> bytes:
    """Raises TooLong; ValueError where the client goes away, or trickles."""
    received = b""
    try:
        async with asyncio.timeout(REQUEST_S):
            async for piece in request.stream():
                received += piece
                if len(received) > BODY_MAX_BYTES:
                    raise TooLong
    except (ClientDisconnect, TimeoutError):
        raise ValueError from None
    return received


@cache
def _asset(name: str) -> str:
    return (files("runtime.page") / "assets" / name).read_text(encoding="utf-8")


def _login_style() -> str:
    """What stands between the style tags of the login page: the policy allows just this."""
    return _asset("login.html").partition("<style>")[2].partition("</style>")[0]


def _login(problem: str = "") -> str:
    told = f'<p role="alert">{problem}</p>' if problem else ""
    return _asset("login.html").replace("<!-- problem -->", told)
