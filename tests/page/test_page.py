"""Tests the operator's page without a browser: the token is required, and GET changes nothing."""

from __future__ import annotations

import errno
import http.client
import json
import os
import resource
import socket
import stat
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import anyio
import pytest

from runtime.clock import MonotonicClock
from runtime.commands.page import page as page_command
from runtime.daemon.client import REQUEST_S, DaemonClient
from runtime.daemon.server import StatusServer
from runtime.errors import InputError, TransientError
from runtime.page.connections import CONNECTIONS_MAX
from runtime.page.server import application
from runtime.page.token import token_of
from tests.page.rig import ROOT, Page, page_of, short_folder
from tests.test_cli import refusal
from tests.waiting import eventually

PATHS = ("/metrics", "/now/status", "/now/pictures", "/now/log", "/now/about", "/do")


class Loop:
    """A daemon's socket and a loop that executes commands; `told` records them."""

    def __init__(self, path: Path) -> None:
        self.server = StatusServer(path, clock=MonotonicClock())
        self.server.publish(lambda: {"state": "tracking", "secret": "of the daemon"})  # pragma: allowlist secret
        self.server.lookups["pictures"] = lambda: {"frame": 7, "jpegs": {}}
        self.server.lookups["log"] = lambda: {"lines": [], "states": []}
        self.server.lookups["about"] = lambda: {"scenes": ["demo"]}
        self.told: list[tuple[str, Any]] = []
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.01):
            while not self.server.commands.empty():
                command = self.server.commands.get()
                if command.take():
                    self.told.append((command.name, command.value))
                    if command.value == "missing":
                        command.refuse("nobody knows 'missing'")
                    else:
                        command.done()

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self.server.close()


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    with short_folder() as made:
        yield made


@pytest.fixture(scope="module")
def page(folder: Path) -> Iterator[Page]:
    with page_of(folder / "s.sock", folder) as running:
        yield running


@pytest.fixture
def loop(folder: Path) -> Iterator[Loop]:
    running = Loop(folder / "s.sock")
    yield running
    running.close()


@pytest.mark.parametrize("path", PATHS)
@pytest.mark.parametrize("given", [{}, {"Authorization": "Bearer wrong"}, {"Authorization": "Basic {token}"},
                                   {"Cookie": "phasestack-{port}={token}; token={token}"}])  # fmt: skip
def test_without_the_token_nothing_is_told_or_done(page: Page, loop: Loop, path: str, given: dict) -> None:
    headers = {name: text.format(token=page.token, port=page.port) for name, text in given.items()}
    method = "POST" if path == "/do" else "GET"
    code, _, body = page.ask(method, f"{path}?token={page.token}", body='{"command": "pause"}', **headers)
    assert code == 401 and b"secret" not in body and loop.told == []


def test_no_answer_sets_a_cookie_that_another_port_would_get(page: Page, loop: Loop) -> None:
    for path in ("/", "/page.js", "/session.js", "/operator", f"/?token={page.token}", "/now/status"):
        assert "set-cookie" not in page.ask("GET", path, **page.bearer)[1]


def test_a_get_does_nothing(page: Page, loop: Loop) -> None:
    assert page.ask("GET", "/do?command=pause", **page.bearer)[0] in (404, 405) and loop.told == []


def test_with_the_token_it_tells_what_the_daemon_tells(page: Page, loop: Loop) -> None:
    assert eventually(lambda: page.look_up("status").get("secret") == "of the daemon")
    assert eventually(lambda: page.look_up("pictures").get("frame") == 7)
    assert eventually(lambda: page.look_up("about").get("scenes") == ["demo"])
    assert page.look_up("other") == {"ok": False, "error": "unknown lookup"}


def test_prometheus_reads_the_figures_of_the_status(page: Page, loop: Loop) -> None:
    status = {"state": "tracking", "live_db": 22.5, "light_db": None, "presented": 60, "paused": True,
              "scene": 'a"b', "view_error_mm": {"p50": 4.0, "p95": 9.5}, "efforts": {"1/2+1": 3.5},
              "stage_ms": {"wait": None}}  # fmt: skip
    loop.server.publish(lambda: status)
    wanted = {
        'phasestack_state{state="tracking"} 1', "phasestack_live_db 22.5", "phasestack_presented 60",
        r'phasestack_scene{scene="a\"b"} 1', 'phasestack_view_error_mm{quantile="0.5"} 4.0',
        'phasestack_view_error_mm{quantile="0.95"} 9.5', 'phasestack_efforts{effort="1/2+1"} 3.5',
    }  # fmt: skip

    def samples() -> set[str]:
        code, headers, body = page.ask("GET", "/metrics", **page.bearer)
        assert code == 200 and headers["content-type"].startswith("text/plain; version=0.0.4")
        return {line for line in body.decode().splitlines() if not line.startswith("#")}

    assert eventually(lambda: wanted <= samples()), samples()


def test_who_goes_away_while_asking_makes_no_error(tmp_path: Path) -> None:
    sent: list[Any] = []

    async def asked() -> None:
        app = application(DaemonClient((tmp_path / "s.sock",)), "t" * 40)
        host = b"localhost:8717"
        headers = [(b"host", host), (b"origin", b"http://" + host), (b"authorization", b"Bearer " + b"t" * 40)]
        scope = {"type": "http", "method": "POST", "path": "/do", "headers": headers, "query_string": b""}

        async def receive() -> Any:
            return {"type": "http.disconnect"}

        async def send(message: Any) -> None:
            sent.append(message)

        await app(scope, receive, send)

    anyio.run(asked)
    assert sent[0]["status"] == 400


def test_wishes_reach_the_daemon_and_its_refusals_the_page(page: Page, loop: Loop) -> None:
    assert page.tell("scene", "grey") == (200, {"ok": True})
    assert page.tell("place", {"scale": 2.0}) == (200, {"ok": True})
    code, answer = page.tell("scene", "missing")
    assert (code, answer["error"]) == (409, "nobody knows 'missing'")
    code, answer = page.tell("place", "much")
    assert (code, answer["error"]) == (
        409,
        "value: place requires an object containing settings, or null to restore the configured placement",
    )
    assert loop.told == [("scene", "grey"), ("place", {"scale": 2.0}), ("scene", "missing")]


@pytest.mark.parametrize(
    "body", ["", "[]", "{", '{"command": "status"}', '{"command": "exec"}', "x" * 70_000, "[" * 60_000]
)
def test_what_is_no_wish_is_refused_in_one_line(page: Page, loop: Loop, body: str) -> None:
    code, _, answer = page.ask("POST", "/do", body=body, **page.bearer)
    assert code in (400, 413) and json.loads(answer)["ok"] is False and loop.told == []


def test_a_daemon_that_hangs_is_not_taken_for_none(page: Page, folder: Path) -> None:
    with socket.socket(socket.AF_UNIX) as silent:
        silent.bind(str(folder / "s.sock"))
        silent.listen()
        assert eventually(lambda: page.look_up("status").get("hangs") is True)  # answers are kept for a moment
        assert "the daemon did not answer in time" in page.look_up("status")["error"]
    (folder / "s.sock").unlink()
    assert eventually(lambda: page.look_up("status")["hangs"] is False)


def test_without_a_daemon_the_page_says_so_and_recovers_later(page: Page, folder: Path) -> None:
    assert eventually(lambda: "no daemon" in page.look_up("status").get("error", ""))
    assert page.ask("GET", "/now/status", **page.bearer)[0] == 503
    assert page.tell("pause")[0] == 503
    back = Loop(folder / "s.sock")
    try:
        assert eventually(lambda: page.look_up("status").get("ok") is True)
    finally:
        back.close()


def test_nothing_may_be_loaded_from_elsewhere_and_no_inline_script_runs(page: Page) -> None:
    _, headers, body = page.ask("GET", "/", **page.bearer)
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy and "script-src 'self';" in policy and "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy and headers["cache-control"] == "no-store"
    for name in ("page.html", "page.css", "page.js", "session.js"):
        text = (ROOT / "runtime" / "page" / "assets" / name).read_text()
        assert "https://" not in text and text.replace("http://www.w3.org/2000/svg", "").count("http://") == 0
    assert b"style=" not in body and b"onclick" not in body


def test_the_token_is_made_once_for_its_owner_alone(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "token"
    token = token_of(path)
    assert len(token) >= 40 and token_of(path) == token
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_disk_that_has_no_room_for_a_token_leaves_none_behind(tmp_path: Path) -> None:
    """An empty file stayed, and was refused at every start."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (8, before[1]))
    try:
        with pytest.raises(InputError, match="cannot be created"):
            token_of(tmp_path / "token")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert list(tmp_path.iterdir()) == []
    assert len(token_of(tmp_path / "token")) >= 40


def test_a_full_disk_may_pass_and_the_page_is_started_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "link", full)
    with pytest.raises(TransientError, match="No space left on device"):
        page_command(config=None, port=0, token_file=tmp_path / "token")


def test_connections_that_ask_nothing_shut_nobody_out(page: Page, loop: Loop) -> None:
    """Seventy of them, by anybody on this machine, shut the page for as long as they liked."""
    held = [socket.create_connection(("127.0.0.1", page.port), timeout=20.0) for _ in range(CONNECTIONS_MAX + 10)]
    try:
        assert page.look_up("status")["secret"] == "of the daemon"  # pragma: allowlist secret
        with suppress(ConnectionResetError):
            assert held[-1].recv(1) == b"", "none stays for long"
    finally:
        for client in held:
            client.close()


def test_a_connection_that_asks_again_and_again_stays_open(page: Page, loop: Loop) -> None:
    """It was cut `REQUEST_S` after it was opened, right after an answer."""
    channel = http.client.HTTPConnection("localhost", page.port, timeout=90)
    channel.connect()
    channel.auto_open = 0  # a connection that was cut is not replaced
    opened_s = time.monotonic()
    while time.monotonic() < opened_s + 1.2 * REQUEST_S:
        channel.request("GET", "/now/status", headers=page.bearer)
        assert channel.getresponse().read()
        time.sleep(0.05 * REQUEST_S)
    channel.close()


def given_away(path: Path) -> None:
    token_of(path)
    os.chown(path, 12345, -1)


def linked(path: Path) -> None:
    token_of(path.with_name("aim"))
    path.symlink_to("aim")


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (lambda path: (path.write_text("a" * 40), path.chmod(0o640)), "can be read by other users"),
        (lambda path: path.touch(0o600), "must contain a token"),
        (lambda path: (path.touch(0o600), path.write_text("short")), "must contain a token"),
        (Path.mkdir, "is not a regular file"),
        (linked, "cannot be read"),
        pytest.param(given_away, "belongs to another user", marks=pytest.mark.skipif(os.geteuid() != 0, reason="root")),
    ],
)
def test_a_token_file_that_is_none_is_refused(tmp_path: Path, make: Callable[[Path], object], problem: str) -> None:
    make(tmp_path / "token")
    with pytest.raises(InputError, match=problem):
        token_of(tmp_path / "token")


@pytest.mark.parametrize("option", ["--config", "--port"])
def test_bad_options_are_one_line_and_exit_2(tmp_path: Path, option: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.support.background.set_niceness", lambda niceness: None)  # of this very process
    with socket.create_server(("127.0.0.1", 0)) as taken:
        value = "/nowhere.toml" if option == "--config" else str(taken.getsockname()[1])
        assert value in refusal("page", "--token-file", tmp_path / "t", option, value)


def test_a_name_that_is_not_utf_8_takes_nothing_else_away(page: Page, loop: Loop) -> None:
    loop.server.lookups["log"] = lambda: {"lines": [{"text": "\udcff.glb"}], "states": []}
    assert eventually(lambda: page.look_up("log").get("lines") == [{"text": "\udcff.glb"}])
