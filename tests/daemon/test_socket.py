"""The status and control socket: who may use it, what it answers, and that the loop never waits for it."""

from __future__ import annotations

import grp
import os
import socket
import stat
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Thread
from typing import Any

import pytest

from runtime.clock import NS_PER_S, MonotonicClock, SimulatedClock
from runtime.config import ServiceSettings
from runtime.daemon import server as server_module
from runtime.daemon.client import NotRunning, ask
from runtime.daemon.server import SocketInUse, StatusServer, open_status_server
from runtime.errors import InputError

OWN_GROUP = grp.getgrgid(os.getgid()).gr_name


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "status.sock"


@pytest.fixture
def clock() -> SimulatedClock:
    return SimulatedClock()


@pytest.fixture
def server(path: Path, clock: SimulatedClock) -> Iterator[StatusServer]:
    made = StatusServer(path, group=OWN_GROUP, clock=clock)
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


def test_numbers_that_json_has_not_are_null(server: StatusServer, path: Path) -> None:
    server.publish(lambda: {"psnr_db": float("nan")})
    assert status(path)["psnr_db"] is None


def test_many_questions_on_one_connection(server: StatusServer, path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
        with client.makefile("rwb", buffering=0) as stream:
            for _ in range(3):
                stream.write(b'{"command": "status"}\n')
                assert b'"ok": true' in stream.readline()


def answered_by_loop(server: StatusServer, respond: Callable[..., Any]) -> Thread:
    def loop() -> None:
        respond(server.commands.get(timeout=60))

    thread = threading.Thread(target=loop)
    thread.start()
    return thread


def test_a_command_reaches_the_loop_and_its_answer_the_client(server: StatusServer, path: Path) -> None:
    taken = []
    thread = answered_by_loop(server, lambda command: (taken.append((command.name, command.value)), command.done()))
    assert ask([path], {"command": "scene", "value": "demo"}) == {"ok": True}
    thread.join()
    assert taken == [("scene", "demo")]


def test_what_the_loop_refuses_the_client_is_told(server: StatusServer, path: Path) -> None:
    thread = answered_by_loop(server, lambda command: command.refuse("no such scene"))
    assert ask([path], {"command": "scene", "value": "x"}) == {"ok": False, "error": "no such scene"}
    thread.join()


def test_a_loop_that_hangs_is_told_and_status_still_answers(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.05)
    assert "did not answer" in ask([path], {"command": "pause"})["error"]
    assert status(path)["ok"]


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        (b"hello\n", "JSON"),
        (b"[1]\n", "JSON object"),
        (b'{"command": "reboot"}\n', "command: unknown"),
        (b'{"command": "scene"}\n', "value: scene"),
        (b'{"command": "budget", "value": "fast"}\n', "value: budget"),
        (b'{"command": "budget", "value": -1}\n', "value: budget"),
        (b'{"command": "budget", "value": 1e999}\n', "value: budget"),
        (b'{"command": "budget", "value": true}\n', "value: budget"),
        (b"\xff\xfe\n", "JSON"),
    ],
)
def test_nonsense_is_refused_and_never_reaches_the_loop(server: StatusServer, line: bytes, problem: str) -> None:
    answer = server.answer(line)
    assert not answer["ok"]
    assert problem in answer["error"]
    assert server.commands.empty()


def test_a_request_without_end_is_cut_off(server: StatusServer, path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as client:
        client.connect(str(path))
        client.sendall(b"x" * (server_module.LINE_MAX_BYTES + 1))
        assert b"too long" in client.makefile("rb").readline()


def test_where_all_places_are_taken_the_one_that_has_waited_longest_goes(server: StatusServer, path: Path) -> None:
    crowd = [socket.socket(socket.AF_UNIX) for _ in range(server_module.CLIENTS_MAX)]
    for client in crowd:
        client.connect(str(path))
        client.sendall(b'{"command": "status"}\n')
        assert b"true" in client.makefile("rb").readline()
    assert status(path)["ok"]
    assert b"too many" in crowd[0].recv(1000)
    crowd[-1].sendall(b'{"command": "status"}\n')
    assert b"true" in crowd[-1].makefile("rb").readline()
    for client in crowd:
        client.close()


def test_publishing_costs_the_loop_next_to_nothing(server: StatusServer) -> None:
    clock = MonotonicClock()
    server._clock = clock
    begin = clock.now_ns()
    for _ in range(1000):
        server.publish(dict)
    publishing_ns = clock.now_ns() - begin
    begin = clock.now_ns()
    for _ in range(1000):
        sum(range(1000))
    assert publishing_ns < clock.now_ns() - begin


def test_a_second_daemon_is_refused_and_told_who_has_it(
    server: StatusServer, path: Path, clock: SimulatedClock
) -> None:
    with pytest.raises(SocketInUse, match=f"in use by another phasestack .pid {os.getpid()}"):
        StatusServer(path, group=OWN_GROUP, clock=clock)
    assert status(path)["ok"]


def test_the_socket_of_a_daemon_that_crashed_is_taken_over(path: Path, clock: SimulatedClock) -> None:
    path.parent.mkdir()
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    server = StatusServer(path, group=OWN_GROUP, clock=clock)
    assert status(path)["ok"]
    server.close()
    server.close()
    assert not path.exists()


def test_somebody_elses_file_is_not_removed(path: Path, clock: SimulatedClock) -> None:
    path.parent.mkdir()
    path.write_text("precious")
    with pytest.raises(InputError, match="not a socket"):
        StatusServer(path, group=OWN_GROUP, clock=clock)
    assert path.read_text() == "precious"


def test_a_group_that_does_not_exist_is_survived(path: Path, clock: SimulatedClock) -> None:
    server = StatusServer(path, group="no-such-group", clock=clock)
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    server.close()


def test_by_hand_a_run_goes_on_without_its_socket_and_under_a_supervisor_it_does_not(
    server: StatusServer, path: Path, clock: SimulatedClock
) -> None:
    settings = ServiceSettings(socket=str(path))
    assert open_status_server(settings, clock=clock, supervised=False) is None
    with pytest.raises(SocketInUse):
        open_status_server(settings, clock=clock, supervised=True)


def test_without_a_daemon_the_client_says_what_to_do(path: Path) -> None:
    with pytest.raises(NotRunning, match="systemctl start"):
        status(path)
    path.parent.mkdir()
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.close()
    with pytest.raises(NotRunning, match="nobody listens"):
        status(path)


def test_a_client_tries_the_next_place(server: StatusServer, path: Path, tmp_path: Path) -> None:
    assert ask([tmp_path / "none", path], {"command": "status"})["ok"]
