"""Tests that the doctor finds faults, names remedies and sets its exit code."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.commands.doctor import doctor
from runtime.daemon.server import StatusServer
from tests.calls import invoked


def examined(tmp_path: Any, text: str = "") -> Any:
    config = tmp_path / "phasestack.toml"
    config.write_text(f'{text}\n[service]\nsocket = "{tmp_path}/status.sock"\n')
    result = invoked(doctor, "--json", "--config", config)
    assert result.exception is None or isinstance(result.exception, SystemExit)
    return result.exit_code, {check["name"]: check for check in json.loads(result.stdout)["checks"]}


@pytest.fixture(autouse=True)
def nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)


def test_the_defaults_are_well(tmp_path: Path) -> None:
    code, checks = examined(tmp_path)
    assert code == 0
    assert {name for name, check in checks.items() if check["state"] == "ok"} >= {
        "opengl", "sensor", "calibration", "model",
    }  # fmt: skip
    assert checks["service"]["state"] == "skip"


def test_monitors_without_an_x_server_fail_with_a_remedy(tmp_path: Path) -> None:
    code, checks = examined(tmp_path, '[output]\nkind = "windows"')
    assert code == 1
    assert checks["monitors"]["state"] == "fail"
    assert "DISPLAY" in checks["monitors"]["remedy"]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        (
            '[sensor]\ndriver = "crystal-ball"\n[calibration]\nfile = "missing.toml"\n[model]\nname = "missing.onnx"',
            {"sensor": "unknown", "calibration": "missing.toml", "model": "missing.onnx"},
        ),
        (
            '[sensor]\nsource = "missing.mcap"\n[model]\nprovider = "tensorrt"\n[content]\nscene = "lego_buldozer"',
            {"sensor": "missing.mcap", "model": "tensorrt", "content": "did you mean lego_bulldozer?"},
        ),
    ],
)
def test_what_is_wrong_is_named_and_the_rest_is_still_checked(tmp_path: Path, text: str, wrong: dict[str, str]) -> None:
    code, checks = examined(tmp_path, text)
    assert code == 1 and set(checks) >= {"opengl", "sensor", "calibration", "model", "service"}
    for name, words in wrong.items():
        assert checks[name]["state"] == "fail" and words in checks[name]["detail"]
    assert checks["opengl"]["state"] == "ok"


def test_the_configured_raster_is_timed_and_its_rate_is_told(tmp_path: Path) -> None:
    slow = '[stack]\nwidth_px = 3840\nheight_px = 2160\n[model]\nbackend = "cpu"\neffort = "full"'
    quick = '[stack]\nwidth_px = 96\nheight_px = 54\n[model]\nbackend = "cpu"'
    for raster, text in (("3840x2160", slow), ("96x54", quick)):
        rate = examined(tmp_path, text)[1]["rate"]
        took_ms = float(rate["detail"].removeprefix(f"{raster}: ").split()[0])
        assert rate["state"] == ("ok" if took_ms < 150 else "warn")


def test_a_real_sensor_with_the_demos_calibration_is_a_failure(tmp_path: Path) -> None:
    _, checks = examined(tmp_path, '[sensor]\ndriver = "openni2"\nsource = ""')
    assert checks["calibration"]["state"] == "fail"
    assert "calibrate" in checks["calibration"]["remedy"]
    assert checks["usb"]["state"] == "fail"


SOLVER = {"role": "solver", "pid": 7, "restarts": 0, "memory_mib": 300.5, "cpu_s": 12.0}


@pytest.mark.parametrize(
    ("account", "seconds", "state"),
    [
        ({"state": "tracking", "reason": "eyes seen", "processes": [SOLVER]}, 0, "ok"),
        (
            {"state": "degraded: sensor", "reason": "sensor: unplugged", "processes": [SOLVER | {"restarts": 2}]},
            0,
            "fail",
        ),
        ({"state": "tracking"}, 60, "fail"),
    ],
)
def test_a_running_daemon_is_asked_how_it_is(tmp_path: Path, account: Any, seconds: int, state: str) -> None:
    clock = SimulatedClock()
    server = StatusServer(tmp_path / "status.sock", clock=clock)
    server.publish(lambda: account)
    clock.advance_ns(seconds * NS_PER_S)
    try:
        code, checks = examined(tmp_path, '[sensor]\ndriver = "openni2"')
    finally:
        server.close()
    assert checks["service"]["state"] == state
    if "processes" in account:
        restarts = account["processes"][0]["restarts"]
        assert checks["processes"]["state"] == ("warn" if restarts else "ok")
        words = "solver", "pid 7", "300.5 MiB", "12.0 s", *(["restarted 2 times"] if restarts else [])
        assert all(word in checks["processes"]["detail"] for word in words)
    assert checks["sensor"]["state"] == "skip"  # it has the device: opening it here would fail, or disturb
    assert code == 1


OWN = """
import numpy as np
from phasestack import Capabilities, EyePoints, Sensor, SensorFrame


class Own(Sensor):
    capabilities = Capabilities(eye_points=True, in_stack_frame=True)

    def __init__(self, options, *, clock):
        self._clock = clock

    def open(self):
        pass

    def read_newest(self, timeout_s):
        eyes_m = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
        return SensorFrame(1, self._clock.now_ns(), EyePoints(eyes_m, np.ones(2)))

    def close(self):
        pass
"""


def test_a_sensor_in_the_stack_s_frame_needs_no_calibration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "own_eyes.py").write_text(OWN)
    monkeypatch.syspath_prepend(tmp_path)
    code, checks = examined(tmp_path, '[sensor]\ndriver = "own_eyes:Own"')
    assert code == 0 and checks["usb"]["state"] != "fail"
    assert checks["sensor"]["detail"] == "own_eyes:Own delivers eyes"
    assert "not needed" in checks["calibration"]["detail"]
