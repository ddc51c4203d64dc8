"""Faults are injected into the real loop: it degrades, says why, goes on, and recovers. One test each."""

from __future__ import annotations

import subprocess
import sys
import time

import numpy as np
import pytest

from runtime.clock import NS_PER_S, MonotonicClock
from runtime.daemon.notify import Notifier
from runtime.errors import ContentFailure, InputError, ModelFailure, SensorLost
from runtime.model.session import ModelSession
from runtime.sensor.recording import Recording
from tests.daemon.rig import TRACKING, BreakablePanels, BreakablePredictor, Rig
from tests.daemon.test_notify import Supervisor


@pytest.fixture
def rig():
    with Rig() as made:
        made.turn_until(TRACKING)
        yield made


def presented_all(accounts) -> bool:
    return all(account.presented for account in accounts)


@pytest.mark.parametrize(
    "fault", [SensorLost("unplugged"), RuntimeError("SDK confused"), OSError(19, "no such device")]
)
def test_a_sensor_that_raises_degrades_and_comes_back(rig, fault):
    rig.plan.fault = fault
    rig.turn_until("degraded: sensor")
    assert str(fault.args[-1]) in rig.loop.machine.reason
    assert presented_all(rig.turns(3))
    rig.plan.fault = None
    rig.turn_until(TRACKING)
    assert rig.plan.opened >= 2


def test_a_sensor_that_hangs_is_left_behind_and_opened_anew(rig):
    rig.plan.hang.set()
    rig.turn_until("degraded: sensor")
    longest_ms = max(sum(account.measured_ms.values()) for account in rig.turns(5))
    assert longest_ms < 1000 * rig.settings.sensor.timeout_s * 20  # the loop never waits for it
    rig.plan.hang.clear()
    rig.turn_until(TRACKING)
    assert rig.plan.opened >= 2


def test_a_sensor_that_can_not_be_opened_is_waited_for(rig):
    rig.plan.fault = rig.plan.refuse = SensorLost("unplugged")
    rig.turn_until("degraded: sensor")
    assert presented_all(rig.turns(3))
    rig.plan.fault = rig.plan.refuse = None
    rig.turn_until(TRACKING)


def test_a_sensor_that_never_will_be_ends_the_run_with_one_line(rig):
    rig.plan.fault = SensorLost("unplugged")
    rig.plan.refuse = InputError("sensor", "driver", "is not allowed here")
    with pytest.raises(InputError, match="not allowed here"):
        rig.turns(10_000)


@pytest.mark.parametrize("fault", [ModelFailure("out of memory"), RuntimeError("unexpected"), MemoryError()])
def test_a_model_that_raises_keeps_the_last_picture(rig, fault):
    def fail(images, eyes_m):
        raise fault

    rig.loop.pipeline.predictor = predictor = BreakablePredictor(rig.loop.pipeline.predictor)
    rig.turns(2)
    before = rig.loop.layers.copy()
    predictor.answer = fail
    account = rig.turn_until("degraded: model")
    assert account.presented
    assert np.array_equal(rig.loop.layers, before)
    assert rig.loop.stats.faults["model"] >= 1
    predictor.answer = None
    rig.turn_until(TRACKING)


def test_a_model_that_answers_nan_is_a_model_that_failed(rig, monkeypatch):
    rig.turns(2)
    before = rig.loop.layers.copy()
    with monkeypatch.context() as patch:
        patch.setattr(ModelSession, "run", lambda *_, output_shape: np.full(output_shape, np.nan, np.float32))
        account = rig.turn_until("degraded: model", within_s=2.0)
        assert account.presented
        assert np.array_equal(rig.loop.layers, before)
    rig.turn_until(TRACKING)


@pytest.mark.parametrize("fault", [ContentFailure("no such frame"), ZeroDivisionError()])
def test_content_that_raises_keeps_the_last_picture(rig, fault, monkeypatch):
    def fail(*arguments, **keywords):
        raise fault

    rig.turns(2)
    with monkeypatch.context() as patch:
        patch.setattr(rig.loop.pipeline.content, "render", fail)
        patch.setattr(rig.loop.pipeline.content, "revision", lambda time_ns: time_ns)
        account = rig.turn_until("degraded: content")
        assert account.presented
    rig.turn_until(TRACKING)


@pytest.mark.parametrize("why", ["DUMMY1 was disconnected", "a panel's window was closed", "the X server died"])
def test_a_lost_panel_drops_frames_and_comes_back_with_the_newest(rig, why):
    rig.loop.panels = panels = BreakablePanels(rig.loop.panels)
    panels.lost = why
    account = rig.turn_until("degraded: panel")
    assert not account.presented
    assert why in rig.loop.machine.reason
    dropped = rig.loop.stats.dropped
    lost = rig.turns(5)
    assert rig.loop.stats.dropped == dropped + 5
    panels.lost = ""
    account = rig.turn_until(TRACKING)
    assert account.presented
    assert panels.shown[-1].number > lost[-1].frame


def test_several_faults_are_all_named(rig):
    rig.loop.panels = panels = BreakablePanels(rig.loop.panels)
    panels.lost = "gone"
    rig.plan.fault = SensorLost("unplugged")
    rig.turn_until("degraded: sensor, panel")
    panels.lost, rig.plan.fault = "", None
    rig.turn_until(TRACKING)


@pytest.mark.parametrize("jump_s", [-3600, -5, 5, 3600])
def test_a_sensor_clock_that_jumps_leaves_no_nonsense_on_the_panels(rig, jump_s):
    rig.plan.clock_jump_ns = jump_s * NS_PER_S
    for account in rig.turns(30):
        assert account.presented
        assert account.eyes_m is None or np.abs(account.eyes_m - rig.plan.eyes_m).max() < 0.1
    rig.plan.clock_jump_ns = 0
    rig.turn_until(TRACKING)


@pytest.mark.parametrize("place_m", [(-0.5, 0.0, 0.0), (0.05, 0.0, 0.0), (np.nan, 0.0, 0.0), (1e9, 0.0, 0.0)])
def test_eyes_at_impossible_places_never_stop_the_loop(rig, place_m):
    well = rig.plan.eyes_m
    rig.plan.eyes_m = np.array(place_m) + np.array([[0.0, -0.031, 0.0], [0.0, 0.031, 0.0]])
    assert presented_all(rig.turns(30))
    rig.plan.eyes_m = well
    rig.turn_until(TRACKING)


def test_one_very_slow_turn_does_not_make_it_look_too_far_ahead_for_ever(rig):
    rig.loop.pipeline.predictor = predictor = BreakablePredictor(rig.loop.pipeline.predictor)
    whole = predictor._predictor.predict

    def slow(images, eyes_m):
        time.sleep(20 * rig.settings.tracker.hold_s)  # a machine that was suspended, or swapped
        predictor.answer = None
        return whole(images, eyes_m)

    predictor.answer = slow
    rig.turns(1)
    assert predictor.answer is None
    rig.turn_until(TRACKING, within_s=3.0)


class Watched:
    """The daemon's part that feeds the watchdog."""

    def __init__(self, notifier: Notifier) -> None:
        self.notifier = notifier

    def stop_reason(self) -> str:
        return ""

    def obey(self, loop) -> None:
        return

    def turn(self, loop, account) -> None:
        self.notifier.turn(loop.machine.state, loop.machine.missing, presented=account.presented)


def test_a_frame_that_takes_for_ever_starves_the_watchdog(tmp_path, monkeypatch):
    heard = Supervisor(str(tmp_path / "notify"))
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    period_s = 0.4
    notifier = Notifier(MonotonicClock(), {"WATCHDOG_USEC": str(int(period_s * 1e6))})
    with Rig(supervisor=Watched(notifier)) as rig:
        rig.turn_until(TRACKING)
        rig.turns(20)
        assert "WATCHDOG=1" in heard.heard()
        rig.loop.pipeline.predictor = predictor = BreakablePredictor(rig.loop.pipeline.predictor)
        spoken = []

        def slow(images, eyes_m):
            time.sleep(period_s * 1.5)
            spoken.extend(heard.heard())
            raise ModelFailure("too slow")

        rig.turns(1)
        heard.heard()
        predictor.answer = slow
        rig.turns(2)
        assert spoken.count("WATCHDOG=1") <= 1  # at most one from the turn between: nothing feeds it beside the loop
        predictor.answer = None
        rig.turn_until(TRACKING)
        time.sleep(period_s / 2)
        rig.turns(2)
        assert "WATCHDOG=1" in heard.heard()
    notifier.close()
    heard.close()


FILL_THE_DISK = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from runtime.errors import InputError
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, 300_000))  # beyond it a write fails, as on a full disk
eyes = EyePoints(np.array([[0.7, -0.03, 0.0], [0.7, 0.03, 0.0]]), np.ones(2))
written = 0
try:
    with recording_to(Path(sys.argv[1]), RecordingHeader("fixed")) as writer:
        for number in range(100_000):
            writer.write(SensorFrame(number, number * 33_000_000, eyes))
            written += 1
except InputError as error:
    print(error)
finally:
    print(written)
"""


@pytest.fixture(scope="module")
def disk_filled(tmp_path_factory):
    path = tmp_path_factory.mktemp("disk") / "recording.mcap"
    return path, subprocess.run(
        [sys.executable, "-c", FILL_THE_DISK, str(path)], capture_output=True, text=True, timeout=60, check=False
    )


def test_a_disk_that_fills_up_while_recording_loses_nothing_that_was_written(disk_filled):
    path, result = disk_filled
    written = int(result.stdout.splitlines()[-1])
    read = sum(1 for _ in Recording(path).samples())
    assert read > 0.5 * written


def test_a_disk_that_fills_up_while_recording_is_told_in_one_line(disk_filled):
    path, result = disk_filled
    assert "Traceback" not in result.stderr
    assert str(path) in result.stdout.splitlines()[0]


def test_transitions_are_logged_once_each(rig, caplog):
    caplog.set_level("INFO", logger="phasestack")
    rig.plan.fault = SensorLost("unplugged")
    rig.turn_until("degraded: sensor")
    rig.turns(20)
    told = [record.getMessage() for record in caplog.records if "-> degraded: sensor" in record.getMessage()]
    assert len(told) == 1
    assert "unplugged" in told[0]
