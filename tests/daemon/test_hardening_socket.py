"""The control socket under attack and in crowds; what was refused is never done; starting a client is cheap."""

from __future__ import annotations

import fcntl
import grp
import json
import os
import resource
import socket
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from typer.testing import CliRunner

from runtime.clock import SimulatedClock
from runtime.commands import ctl
from runtime.config import ServiceSettings, load_settings
from runtime.daemon import request_server
from runtime.daemon import server as server_module
from runtime.daemon.client import ask
from runtime.daemon.commands import Command
from runtime.daemon.location import DEFAULT_SOCKET, configured_socket
from runtime.daemon.server import SocketInUse, StatusServer
from runtime.errors import InputError
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
OWN_GROUP = grp.getgrgid(os.getgid()).gr_name
STATUS = {"command": "status"}


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / "status.sock"


@pytest.fixture
def server(path: Path) -> Iterator[StatusServer]:
    made = StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    yield made
    made.close()


def connected(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX)
    client.settimeout(20)
    client.connect(str(path))
    return client


# What was refused is never done


def test_a_command_that_was_refused_as_too_late_is_never_done(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.05)
    answer = ask([path], {"command": "pause"})
    assert not answer["ok"]
    assert "nothing was done" in answer["error"]
    assert not server.commands.get(timeout=60).take()


def test_a_command_that_was_taken_in_time_is_waited_for_and_not_given_up(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.05)

    def loop() -> None:
        command = server.commands.get(timeout=60)
        assert command.take()
        time.sleep(0.3)
        command.done()

    thread = threading.Thread(target=loop)
    thread.start()
    assert ask([path], {"command": "reload"}) == {"ok": True}
    thread.join()


def test_either_it_is_done_or_it_is_given_up() -> None:
    for _ in range(200):
        command = Command("pause")
        with ThreadPoolExecutor(2) as pool:
            taken, given_up = pool.submit(command.take), pool.submit(command.give_up)
        assert taken.result() != given_up.result()


def test_the_daemon_leaves_a_command_that_was_given_up(
    server: StatusServer, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from runtime.clock import MonotonicClock
    from runtime.config import Overrides
    from runtime.daemon.notify import Notifier
    from runtime.daemon.signals import Signals
    from runtime.daemon.supervise import Daemon

    class Shown:
        """What a command would change."""

        paused = flat_asked = False

    daemon = Daemon(
        None, Overrides(), signals=Signals(), notifier=Notifier(MonotonicClock(), {}), server=server, metrics=None
    )
    late, timely, shown = Command("pause"), Command("flat"), Shown()
    assert late.give_up()
    server.commands.put(late)
    server.commands.put(timely)
    daemon.carry_out_commands(shown)
    assert (shown.paused, shown.flat_asked) == (False, True)
    assert timely.wait(1.0) == ""


def test_while_it_starts_the_status_says_what_it_waits_for(server: StatusServer, path: Path) -> None:
    from runtime.clock import MonotonicClock
    from runtime.config import Overrides
    from runtime.daemon.notify import Notifier
    from runtime.daemon.signals import Signals
    from runtime.daemon.supervise import Daemon

    notifier = Notifier(MonotonicClock(), {})
    daemon = Daemon(None, Overrides(), signals=Signals(), notifier=notifier, server=server, metrics=None)
    assert daemon.starting("loading content and model")
    answer = ask([path], STATUS)
    assert (answer["state"], answer["reason"]) == ("starting", "loading content and model")


def test_when_the_daemon_stops_who_waits_is_told_and_nothing_is_done_later(server: StatusServer, path: Path) -> None:
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(ask, [path], {"command": "pause"})
        command = server.commands.get(timeout=60)
        server.close()
        assert "stops: nothing was done" in asked.result(timeout=60)["error"]
    assert not command.take()


# Crowds


def test_twenty_at_once_are_all_answered(server: StatusServer, path: Path) -> None:
    server.publish(lambda: {"state": "tracking"})
    with ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(lambda _: ask([path], STATUS), range(200)))
    assert all(answer["ok"] for answer in answers)


def test_twenty_status_commands_at_once_are_all_answered(server: StatusServer, path: Path) -> None:
    """As processes, as an operator's scripts are."""
    server.publish(lambda: {"state": "tracking"})
    command = [sys.executable, "-m", "runtime.cli", "status", "--json", "--socket", str(path)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    running = [
        subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        for _ in range(20)
    ]
    results = [(process.communicate(timeout=120), process.returncode) for process in running]
    assert all(code == 0 and json.loads(output)["state"] == "tracking" for (output, _), code in results)


def test_clients_that_connect_before_any_is_looked_at_find_room(path: Path) -> None:
    """The backlog: connections wait, they are not refused."""
    made = StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    made.publish(lambda: time.sleep(0.5) or {"state": "tracking"})
    try:
        first = connected(path)
        first.sendall(b'{"command": "status"}\n')
        time.sleep(0.1)
        crowd = []
        for _ in range(request_server.BACKLOG - 4):
            client = socket.socket(socket.AF_UNIX)
            client.setblocking(False)
            client.connect(str(path))  # raises BlockingIOError where the backlog is full
            crowd.append(client)
        assert len(crowd) == request_server.BACKLOG - 4
        for client in (first, *crowd):
            client.close()
    finally:
        made.close()


def test_tricklers_lock_out_nobody(server: StatusServer, path: Path) -> None:
    """More of them than there are places, each sending a byte now and then, and coming again when it is sent away."""
    stop = threading.Event()
    sent = [0]

    def trickle() -> None:
        while not stop.is_set():
            try:
                with connected(path) as client:
                    while not stop.is_set():
                        client.sendall(b"x")
                        sent[0] += 1
                        stop.wait(0.05)
            except OSError:
                stop.wait(0.01)

    threads = [threading.Thread(target=trickle) for _ in range(server_module.CLIENTS_MAX + 16)]
    for thread in threads:
        thread.start()
    try:
        assert eventually(lambda: sent[0] > 3 * len(threads), within_s=20)
        assert all(ask([path], STATUS)["ok"] for _ in range(20))
        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(ask, [path], {"command": "reload"})
            command = server.commands.get(timeout=60)
            command.take()
            command.done()
            assert asked.result(timeout=60) == {"ok": True}
        assert server._server.connections <= server_module.CLIENTS_MAX
    finally:
        stop.set()
        for thread in threads:
            thread.join()


@pytest.fixture
def hasty(path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[StatusServer]:
    monkeypatch.setattr(server_module, "REQUEST_S", 0.3)
    made = StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
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
        assert eventually(lambda: hasty._server.connections == 0, within_s=20)
    assert ask([path], STATUS)["ok"]


def test_a_request_without_line_break_is_answered_at_the_end_of_what_is_sent(server: StatusServer, path: Path) -> None:
    with connected(path) as client:
        client.sendall(json.dumps(STATUS).encode())
        client.shutdown(socket.SHUT_WR)
        assert json.loads(client.recv(65536))["ok"]
        assert client.recv(10) == b""


def test_many_requests_in_one_piece_are_answered_in_order(server: StatusServer, path: Path) -> None:
    with connected(path) as client:
        client.sendall(b'{"command": "status"}\n{"command": "nonsense"}\n{"command": "status"}\n')
        stream = client.makefile("rb")
        assert [json.loads(stream.readline())["ok"] for _ in range(3)] == [True, False, True]


def test_without_descriptors_it_waits_and_then_serves_again(server: StatusServer, path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    clients = [socket.socket(socket.AF_UNIX) for _ in range(4)]
    free = os.dup(0)
    resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
    try:
        os.close(free)
        while True:  # everything below the limit
            try:
                clients.append(socket.socket(socket.AF_UNIX))
            except OSError:
                break
        for client in clients[:4]:
            client.settimeout(20)
            client.connect(str(path))
            client.sendall(b'{"command": "status"}\n')
        time.sleep(0.5)
        assert server._server.connections == 0  # none could be let in
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert all(b'"ok": true' in client.recv(65536) for client in clients[:4])
    for client in clients:
        client.close()


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("budget", "HUGE", "value: budget wants milliseconds"),
        ("playlist", '[{"scene": "demo", "seconds": HUGE}]', "value[0].seconds: playlist wants a number"),
        ("playlist", '[{"scene": "demo", "seconds": 1e999}]', "value[0].seconds: playlist wants a number"),
    ],
)
def test_numbers_that_nothing_can_hold_are_refused_by_field(
    server: StatusServer, path: Path, name: str, value: str, told: str
) -> None:
    """Seen: a playlist of 310 digits ended the daemon."""
    line = f'{{"command": "{name}", "value": {value}}}\n'.replace("HUGE", "1" + "0" * 400)
    with connected(path) as client:
        client.sendall(line.encode())
        answer = json.loads(client.makefile("rb").readline())
    assert not answer["ok"] and answer["error"].startswith(told)
    assert server.commands.empty()


@pytest.mark.parametrize("line", [b"[" * 60000 + b"\n", b'{"a":' * 10000 + b"\n", b"\0\n", b"9" * 60000 + b"\n"])
def test_hostile_lines_are_refused_in_one_line(server: StatusServer, path: Path, line: bytes) -> None:
    with connected(path) as client:
        client.sendall(line)
        answer = json.loads(client.makefile("rb").readline())
    assert not answer["ok"]
    assert ask([path], STATUS)["ok"]


def test_a_snapshot_that_fails_is_told_and_the_server_goes_on(server: StatusServer, path: Path) -> None:
    server.publish(lambda: 1 / 0)
    assert not ask([path], STATUS)["ok"]
    server.publish(dict)
    assert ask([path], STATUS)["ok"]


# The lock and the socket's place


def lock_of(path: Path) -> Path:
    return path.with_name(path.name + ".lock")


def test_the_lock_is_its_owners_alone_and_not_inherited(server: StatusServer, path: Path) -> None:
    assert stat.S_IMODE(lock_of(path).stat().st_mode) == 0o600
    assert fcntl.fcntl(server._lock, fcntl.F_GETFD) & fcntl.FD_CLOEXEC


def test_a_lock_of_an_older_version_that_all_could_read_is_made_its_owners(path: Path) -> None:
    path.parent.mkdir()
    lock_of(path).write_text("1\n")
    lock_of(path).chmod(0o644)
    StatusServer(path, group=OWN_GROUP, clock=SimulatedClock()).close()
    assert stat.S_IMODE(lock_of(path).stat().st_mode) == 0o600


@pytest.mark.parametrize("link", ["symlink_to", "hardlink_to"])
def test_a_link_in_the_locks_place_is_refused_and_its_target_stays_as_it_was(
    path: Path, tmp_path: Path, link: str
) -> None:
    path.parent.mkdir()
    precious = tmp_path / "precious"
    precious.write_text("precious")
    getattr(lock_of(path), link)(precious)
    with pytest.raises(InputError, match=r"status\.sock\.lock"):
        StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    assert precious.read_text() == "precious"
    assert stat.S_IMODE(precious.stat().st_mode) & 0o044


@pytest.mark.parametrize("kind", ["fifo", "folder"])
def test_what_is_no_file_in_the_locks_place_is_refused_without_waiting(path: Path, kind: str) -> None:
    path.parent.mkdir()
    os.mkfifo(lock_of(path)) if kind == "fifo" else lock_of(path).mkdir()
    with pytest.raises(InputError, match=r"status\.sock\.lock"):
        StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())


def test_where_the_lock_was_deleted_a_second_daemon_does_not_steal_the_socket(server: StatusServer, path: Path) -> None:
    lock_of(path).unlink()
    with pytest.raises(SocketInUse):
        StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    server.publish(lambda: {"state": "the first"})
    assert ask([path], STATUS)["state"] == "the first"


def test_where_both_were_deleted_the_first_does_not_take_the_seconds_socket_with_it(path: Path) -> None:
    first = StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    lock_of(path).unlink()
    path.unlink()
    second = StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    second.publish(lambda: {"state": "the second"})
    first.close()
    assert ask([path], STATUS)["state"] == "the second"
    second.close()
    assert not path.exists()


def test_a_link_in_the_sockets_place_is_not_followed(path: Path, tmp_path: Path) -> None:
    path.parent.mkdir()
    precious = tmp_path / "precious"
    precious.write_text("precious")
    path.symlink_to(precious)
    with pytest.raises(InputError, match="not a socket"):
        StatusServer(path, group=OWN_GROUP, clock=SimulatedClock())
    assert path.is_symlink()
    assert precious.read_text() == "precious"


# The client


def test_the_clients_default_socket_is_the_configurations() -> None:
    assert DEFAULT_SOCKET == ServiceSettings().socket == configured_socket(None)


@pytest.mark.parametrize("socket_line", ['socket = "/run/x/status.sock"', 'socket = "here.sock"', ""])
def test_the_clients_reading_of_a_configuration_is_the_daemons(tmp_path: Path, socket_line: str) -> None:
    config = tmp_path / "phasestack.toml"
    config.write_text(f"[service]\n{socket_line}\n")
    assert Path(configured_socket(config)) == Path(load_settings(config).service.socket)


@pytest.mark.parametrize(
    "text",
    ["[service\n", "[service]\nsocket = 3\n", '[service]\nsocket = ""\n', "\udcff", '[service]\nsocket="a\\u0000"'],
)
def test_a_bad_configuration_is_told_by_the_client(tmp_path: Path, text: str) -> None:
    config = tmp_path / "phasestack.toml"
    config.write_bytes(text.encode(errors="surrogateescape"))
    with pytest.raises(InputError, match=r"phasestack\.toml"):
        configured_socket(config)


@pytest.mark.parametrize("arguments", [["status"], ["ctl", "pause"], ["ctl", "scene", "demo"]])
def test_a_client_loads_nothing_heavy(tmp_path: Path, arguments: list[str]) -> None:
    config = tmp_path / "phasestack.toml"
    config.write_text(f'[service]\nsocket = "{tmp_path}/none.sock"\n')
    code = (
        "import sys\nfrom runtime.cli import main\n"
        f"sys.argv = ['phasestack', *{arguments!r}, '--config', {str(config)!r}]\n"
        "try:\n    main()\nexcept SystemExit as end:\n"
        "    heavy = [n for n in ('numpy', 'cv2', 'onnxruntime', 'scipy', 'moderngl', 'runtime.config', 'rich')"
        " if n in sys.modules]\n"
        "    print(end.code, *heavy)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": ""}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert done.stdout.split() == ["1"], done.stdout + done.stderr


@pytest.mark.parametrize("name", ["pictures", "a.glb", "sub/a.glb", "./a.glb"])
def test_a_file_or_folder_is_sent_with_its_whole_path(
    server: StatusServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sub").mkdir()
    (tmp_path / "pictures").mkdir()
    for file in ("a.glb", "sub/a.glb"):
        (tmp_path / file).write_bytes(b"")
    assert sent_scene(server, name) == str(tmp_path / name.removeprefix("./"))


@pytest.mark.parametrize("name", ["demo", "lego_bulldozer", "nowhere.glb"])
def test_a_known_name_and_what_is_not_there_are_sent_as_they_are(
    server: StatusServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()  # the built-in scene is meant all the same
    assert sent_scene(server, name) == name


def sent_scene(server: StatusServer, name: str) -> str:
    taken = []

    def loop() -> None:
        taken.append(server.commands.get(timeout=60))
        taken[0].done()

    thread = threading.Thread(target=loop)
    thread.start()
    result = CliRunner().invoke(ctl.app, ["scene", name, "--socket", str(server.path)])
    thread.join()
    assert result.exit_code == 0, result.output
    return taken[0].value
