"""Tests `phasestack status` and `phasestack ctl` with a real socket."""

from __future__ import annotations

import json
import logging
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.commands import ctl
from runtime.commands.ctl import status
from runtime.daemon.server import StatusServer
from runtime.errors import InputError
from runtime.support.logs import RateLimit
from tests.calls import invoked

ACCOUNT = {
    "state": "degraded: sensor", "reason": "sensor: unplugged", "missing": {"sensor": "unplugged"}, "fps": 31.25,
    "scene": "room", "model": "fast", "fps_now": 31.5, "solutions_per_s_now": 0.0, "light_db": 33.5,
    "effort": "1/2+1", "efforts": {"1/2+1": 3.0},
    "frames": 100, "presented": 98, "dropped": 2,
    "stage_ms": {"render": {"p50": 3.0, "p99": 4.0}, "inference": {"p50": 12.0, "p99": 13.0}},
    "eyes_m": [[0.9, -0.03, 0.0], [0.9, 0.03, 0.0]], "eyes_label": "held", "faults": {"sensor": 4},
    "plan": [{"what": "warp of the centre panel", "why": "identity"}],
    "loading": "reading a.glb",
}  # fmt: skip


@pytest.fixture
def clock() -> Any:
    return SimulatedClock()


@pytest.fixture
def server(tmp_path: Path, clock: Any) -> Any:
    made = StatusServer(tmp_path / "status.sock", clock=clock)
    made.publish(lambda: ACCOUNT)
    yield made
    made.close()


def configuration(socket: Path) -> Path:
    """A file that says where the socket is."""
    path = socket.with_name("phasestack.toml")
    path.write_text(f'[service]\nsocket = "{socket}"\n')
    return path


def ask_status(socket: Path, *arguments: str) -> Any:
    return invoked(status, *arguments, "--config", configuration(socket))


def test_people_see_state_reason_rate_eyes_and_faults_and_machines_one_object(server: StatusServer) -> None:
    result = ask_status(server.path)
    assert result.exit_code == 0
    told = " ".join(result.stdout.split())
    for words in ("degraded: sensor", "unplugged", "fps 31.25", "dropped 2", "(0.9 -0.03 0)", "held",
                  "inference 12", "4 x sensor", "warp of the centre panel", "reading a.glb",
                  "effort 1 step on half the rows and columns"):  # fmt: skip
        assert words in told
    assert json.loads(ask_status(server.path, "--json").stdout)["state"] == "degraded: sensor"


def test_the_status_begins_with_the_five_lines_that_matter(server: StatusServer) -> None:
    lines = ask_status(server.path).stdout.splitlines()
    assert [" ".join(line.split()) for line in lines[:6]] == [
        "state degraded: sensor (unplugged)", "shows room with the model fast",
        "rate 31.5 refreshes/s, 0 solutions/s", "quality 33.5 dB (light_db, at the eyes now)",
        "faults sensor: unplugged; 4 x sensor since startup", "",
    ]  # fmt: skip
    groups = [line for line in lines[5:] if line and not line.startswith(" ")]
    assert groups == ["scene", "eyes", "solver", "panels", "service"]


def test_every_placement_is_in_the_service_s_log(server: StatusServer, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "phasestack")
    limit, sent = RateLimit(SimulatedClock()), [1.0 + n / 10 for n in range(12)]

    def loop() -> None:
        for _ in sent:
            server.commands.get(timeout=60).done()

    thread = threading.Thread(target=loop)
    thread.start()
    for scale in sent:
        ctl.tell({"command": "place", "value": {"scale": scale}}, configuration(server.path))
    thread.join()
    passed = [record.getMessage() for record in caplog.records if limit.filter(record)]
    assert [line for line in passed if line.startswith("command: ")] == [
        f"command: place {{'scale': {s}}}" for s in sent
    ]


def test_the_configuration_may_stand_before_the_subcommand(server: StatusServer) -> None:
    thread = threading.Thread(target=lambda: server.commands.get(timeout=60).done(paused=True))
    thread.start()
    result = invoked(ctl.app, "--config", configuration(server.path), "pause")
    thread.join()
    assert (result.exit_code, result.stdout.split()) == (0, ["paused", "yes"])


def test_a_loop_that_stands_still_is_a_failure(server: StatusServer, clock: SimulatedClock) -> None:
    clock.advance_ns(6 * NS_PER_S)
    result = ask_status(server.path)
    assert result.exit_code == 1
    assert "the display loop has not responded for 6 s" in result.stderr


def test_without_a_daemon_status_fails_with_one_line(tmp_path: Path) -> None:
    result = ask_status(tmp_path / "none.sock")
    assert result.exit_code == 1
    assert result.stderr.count("\n") == 1
    assert "no daemon is listening; start one with `phasestack run`" in result.stderr


@pytest.mark.parametrize(
    ("state", "result", "told"),
    [
        ("inactive", "success", "is stopped; run: sudo systemctl start phasestack"),
        (
            "failed",
            "exit-code",
            "exit status 2: a.toml: stack: no); fix the error, then run: sudo systemctl restart phasestack",
        ),
        ("failed", "start-limit-hit", "sudo systemctl reset-failed phasestack"),
        ("activating", "success", "journalctl -u phasestack"),
    ],
)
def test_without_the_service_status_says_how_it_is_and_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str, result: str, told: str
) -> None:
    """Output of systemd 252; the test of the booted system uses the real one."""
    lines = ["LoadState=loaded", f"ActiveState={state}", f"Result={result}", "ExecMainStatus=2",
             "StatusText=a.toml: stack: no"]  # fmt: skip
    (tmp_path / "systemctl").write_text("#!/bin/sh\ncat <<'E'\n" + "\n".join(lines) + "\nE\n")
    (tmp_path / "systemctl").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    assert told in ask_status(tmp_path / "none.sock").stderr


@pytest.mark.parametrize(
    ("arguments", "name", "value"),
    [
        (["scene", "lego_bulldozer"], "scene", "lego_bulldozer"),
        (["scene", "a.glb"], "scene", "{folder}/a.glb"),
        (["pause"], "pause", None),
        (["resume"], "resume", None),
        (["flat"], "flat", None),
        (["scene", "next"], "next", None),
        (["place", "--scale", "2"], "place", {"scale": 2.0}),
        (["reload"], "reload", None),
    ],
)
def test_every_command_arrives(
    server: StatusServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], name: str, value: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.glb").touch()  # a file is sent with its whole path
    taken = []

    def loop() -> None:
        taken.append(server.commands.get(timeout=60))
        taken[0].done(scene="demo", content="demo", model="fast", placing={"scale": 1.5}, paused=True)

    thread = threading.Thread(target=loop)
    thread.start()
    result = invoked(ctl.app, *arguments, "--config", configuration(server.path))
    thread.join()
    assert result.exit_code == 0
    holds = [" ".join(line.split()) for line in result.stdout.splitlines()]
    assert holds == ["scene demo", "content demo", "model fast", "placing scale 1.5", "paused yes"]
    expected = value.format(folder=tmp_path) if isinstance(value, str) else value
    assert (taken[0].name, taken[0].value) == (name, expected)


def test_a_refusal_is_bad_input(server: StatusServer) -> None:
    with pytest.raises(InputError, match="place requires an object"):
        ctl.tell({"command": "place", "value": 1e8}, configuration(server.path))
