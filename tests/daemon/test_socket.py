"""Tests permissions, answers and limits of the status and control socket."""

from __future__ import annotations

import fcntl
import grp
import os
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.config import ServiceSettings
from runtime.daemon import server as server_module
from runtime.daemon.client import NotRunning, ask
from runtime.daemon.server import StatusServer, open_status_server
from runtime.daemon.socket_file import SocketInUse
from runtime.errors import InputError
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
STATUS = {"command": "status"}
OWN_GROUP = grp.getgrgid(os.getgid()).gr_name


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "status.sock"


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def server(path: Path, clock: SimulatedClock, monkeypatch: pytest.MonkeyPatch) -> Iterator[StatusServer]:
    monkeypatch.setattr("runtime.daemon.socket_file.GROUP", OWN_GROUP)
    made = StatusServer(path, clock=clock)
    yield made
    made.close()


def status(path: Path) -> dict[str, Any] | None:
    return ask([path], {"command": "status"})


def test_only_the_owner_and_the_group_may_use_it(server: StatusServer, path: Path) -> None:
    info = path.stat()
    assert stat.S_ISSOCK(info.st_mode)
    assert stat.S_IMODE(info.st_mode) == 0o660
    assert info.st_gid == os.getgid()


def test_status_is_the_newest_published_account(server: StatusServer, path: Path, clock: SimulatedClock) -> None:
    server.publish(lambda: {"state": "starting"})
    server.publish(lambda: {"state": "tracking", "fps": 60.0})
    clock.advance_ns(2 * NS_PER_S)
    answer = status(path)
    assert (answer["ok"], answer["state"], answer["fps"], answer["pid"]) == (True, "tracking", 60.0, os.getpid())
    assert (answer["uptime_s"], answer["turn_age_s"]) == (2.0, 2.0)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (b"hello\n", "JSON"),
        (b"[1]\n", "JSON object"),
        (b'{"command": "reboot"}\n', "command: unknown"),
        (b'{"command": "scene"}\n', "value: scene"),
        (b"[" * 60000 + b"\n", "JSON"),
        (b'{"a":' * 10000 + b"\n", "JSON"),
        (b"9" * 60000 + b"\n", "JSON"),
        (b"\xff\xfe\n", "JSON"),
    ],
)
def test_nonsense_is_refused_and_never_reaches_the_loop(server: StatusServer, line: bytes, problem: str) -> None:
    answer = server.answer(line)
    assert not answer["ok"]
    assert problem in answer["error"]
    assert server.commands.empty()


def test_a_request_without_end_is_cut_off(server: StatusServer, path: Path) -> None:
    with connected(path) as client:
        client.sendall(b"x" * (server_module.REQUEST_MAX_BYTES + 1))
        assert b"too long" in client.makefile("rb").readline()


def test_where_all_places_are_taken_the_one_that_has_waited_longest_goes(server: StatusServer, path: Path) -> None:
    crowd = [connected(path) for _ in range(server_module.CLIENTS_MAX)]
    for client in crowd:
        client.sendall(b'{"command": "status"}\n')
        assert b"true" in client.makefile("rb").readline()
    assert status(path)["ok"]
    assert b"too many" in crowd[0].recv(1000)
    crowd[-1].sendall(b'{"command": "status"}\n')
    assert b"true" in crowd[-1].makefile("rb").readline()
    for client in crowd:
        client.close()


def test_a_second_daemon_is_refused_and_told_who_has_it(
    server: StatusServer, path: Path, clock: SimulatedClock
) -> None:
    with pytest.raises(SocketInUse, match=f"in use by another phasestack .pid {os.getpid()}"):
        StatusServer(path, clock=clock)
    assert status(path)["ok"]


def test_the_socket_of_a_daemon_that_crashed_is_taken_over(path: Path, clock: SimulatedClock) -> None:
    path.parent.mkdir()
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    server = StatusServer(path, clock=clock)
    assert status(path)["ok"]
    server.close()
    server.close()
    assert not path.exists()


@pytest.mark.parametrize("is_link", [False, True])
def test_somebody_elses_file_is_neither_removed_nor_followed(
    path: Path, tmp_path: Path, clock: SimulatedClock, is_link: bool
) -> None:
    path.parent.mkdir()
    precious = tmp_path / "precious" if is_link else path
    precious.write_text("precious")
    if is_link:
        path.symlink_to(precious)
    with pytest.raises(InputError, match="not a socket"):
        StatusServer(path, clock=clock)
    assert precious.read_text() == "precious" and path.is_symlink() == is_link


def test_without_its_socket_a_run_goes_on_unless_supervised(
    server: StatusServer, path: Path, clock: SimulatedClock
) -> None:
    settings = ServiceSettings(socket=str(path))
    assert open_status_server(settings, clock=clock, supervised=False) is None
    with pytest.raises(SocketInUse):
        open_status_server(settings, clock=clock, supervised=True)


def test_without_a_daemon_the_client_says_what_to_do(path: Path) -> None:
    with pytest.raises(NotRunning, match="no daemon"):
        status(path)
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    with pytest.raises(NotRunning, match="the daemon has died"):
        status(path)


def test_an_answer_that_is_no_object_is_of_no_daemon(path: Path) -> None:
    path.parent.mkdir()
    with socket.socket(socket.AF_UNIX) as other, ThreadPoolExecutor() as pool:
        other.bind(str(path))
        other.listen()
        asked = pool.submit(status, path)
        with other.accept()[0] as client:
            client.sendall(b"[1]\n")
            with pytest.raises(NotRunning, match="the answer is not a JSON object"):
                asked.result(timeout=20)


def connected(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(20)
    try:
        client.connect(str(path))
    except OSError:  # the queue is full: the next client is refused immediately
        client.close()
        raise
    return client


# Refused commands are never executed


def test_a_command_during_the_start_is_told_what_is_awaited(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.05)
    server.publish(lambda: {"state": "starting", "reason": "loading the scene"})
    answer = ask([path], {"command": "pause"})
    assert answer["error"] == "the display is still starting (loading the scene), so the command was not run"


def test_a_command_that_was_refused_as_too_late_is_never_done(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.05)
    answer = ask([path], {"command": "pause"})
    assert not answer["ok"]
    assert "the command was not run" in answer["error"]
    assert not server.commands.get(timeout=60).take()


def test_when_the_daemon_stops_waiting_clients_are_told_and_nothing_follows(server: StatusServer, path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(ask, [path], {"command": "pause"})
        command = server.commands.get(timeout=60)
        server.close()
        assert "stopping; the command was not run" in asked.result(timeout=60)["error"]
    assert not command.take()


# Crowds


@pytest.fixture
def hasty(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StatusServer]:
    monkeypatch.setattr(server_module, "REQUEST_S", 0.3)
    made = StatusServer(path, clock=SimulatedClock())
    yield made
    made.close()


def test_a_request_has_so_long_altogether_however_it_trickles(hasty: StatusServer, path: Path) -> None:
    with connected(path) as client:
        begin_s = time.monotonic()
        with pytest.raises(OSError):
            while time.monotonic() - begin_s < 20:
                client.sendall(b" ")
                time.sleep(0.02)
        assert b"in time" in client.recv(1000)


def test_a_client_that_does_not_read_its_answers_is_let_go(hasty: StatusServer, path: Path) -> None:
    hasty.publish(lambda: {"long": "x" * 60000})
    with connected(path) as client:
        client.settimeout(0.05)
        with pytest.raises(OSError):  # at last the server reads no more
            while True:
                client.sendall(b'{"command": "status"}\n' * 100)
        assert eventually(lambda: not hasty._clients, within_s=20)
    assert ask([path], STATUS)["ok"]


def test_what_its_asker_did_not_wait_for_is_never_done(server: StatusServer, path: Path) -> None:
    """A daemon that hung for a while did what somebody had asked for who had gone long ago."""
    with connected(path) as client:
        client.sendall(b'{"command": "flat"}\n')
        waiting = server.commands.get(timeout=20)
    assert eventually(waiting.answer.cancelled, within_s=4.0) and not waiting.take()
    gate = threading.Event()
    server._loop.call_soon_threadsafe(gate.wait, 20.0)
    with connected(path) as client:
        client.sendall(b'{"command": "flat"}\n')
    gate.set()
    assert ask([path], STATUS)["ok"] and server.commands.empty()


def test_an_asker_that_only_sends_no_more_is_still_there(server: StatusServer, path: Path) -> None:
    with connected(path) as client:
        client.sendall(b'{"command": "flat"}')
        client.shutdown(socket.SHUT_WR)
        waiting = server.commands.get(timeout=20)
        time.sleep(0.3)
        assert waiting.take()
        waiting.done(flat=True)
        assert b'"flat": true' in client.recv(1000)


def test_a_folder_that_stays_locked_is_used_and_a_line_says_so(
    path: Path, clock: SimulatedClock, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("runtime.daemon.socket_file.LOCKED_WITHIN_S", 0.05)
    path.parent.mkdir()
    other = os.open(path.parent, os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    made = StatusServer(path, clock=clock)
    assert status(path)["ok"]
    made.close()
    os.close(other)
    assert f"{path.parent} is locked by another program" in caplog.text


TAKES_IT = """
import sys
from pathlib import Path
from runtime.clock import MonotonicClock
from runtime.daemon.server import StatusServer
from runtime.daemon.socket_file import SocketInUse
print("there", flush=True)
for line in sys.stdin:
    try:
        server = StatusServer(Path(line.strip()), clock=MonotonicClock())
    except SocketInUse:
        print("in use", flush=True)
    else:
        print("mine", flush=True)
        sys.stdin.readline()
        server.close()
        print("closed", flush=True)
"""


def test_of_daemons_that_begin_at_once_one_has_the_socket(path: Path) -> None:
    """Two had it in five of two hundred starts."""
    command = [sys.executable, "-c", TAKES_IT]
    begun = [
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1) for _ in range(4)
    ]
    try:
        assert [one.stdout.readline() for one in begun] == ["there\n"] * 4
        path.parent.mkdir()
        for _ in range(50):
            with socket.socket(socket.AF_UNIX) as dead:
                dead.bind(str(path))
            for one in begun:
                one.stdin.write(f"{path}\n")
            told = [one.stdout.readline() for one in begun]
            assert sorted(told) == ["in use\n"] * 3 + ["mine\n"]
            owner = begun[told.index("mine\n")]
            owner.stdin.write("close\n")
            assert owner.stdout.readline() == "closed\n"
    finally:
        for one in begun:
            one.stdin.close()
            one.wait(60)
            one.stdout.close()
