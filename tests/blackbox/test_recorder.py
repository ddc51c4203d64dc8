"""A black box beside a running daemon: bounded, written at a fault, an error, or when asked; never in the way."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.blackbox import recorder as recording
from runtime.blackbox.file import BlackBoxFile
from runtime.blackbox.location import black_box_folder, state_folder
from runtime.blackbox.messages import Message, state
from runtime.blackbox.pictures import pictures_of, seen
from runtime.blackbox.recorder import Plan, Recorder
from runtime.blackbox.ring import OVERHEAD_BYTES, Ring
from runtime.blackbox.schemas import STATE
from runtime.clock import NS_PER_S, MonotonicClock, SimulatedClock
from runtime.errors import InputError, SensorLost
from runtime.eyes.calibration import load_calibration
from runtime.optics.stack import PanelStack
from runtime.records import EyePoints, PanelFrame, SensorFrame
from runtime.sensor.recording import Recording
from runtime.sensor.recording_format import RecordingHeader
from tests.blackbox.conftest import read
from tests.daemon.rig import Rig
from tests.waiting import eventually

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 64, 36)


def message(number: int, *, size: int = 1000, topic: str = "/refresh") -> Message:
    return Message(topic, number, b"x" * size, number)


def test_a_ring_is_no_larger_than_it_may_be() -> None:
    ring = Ring(most_s=1e6, most_bytes=10 * (1000 + OVERHEAD_BYTES))
    for number in range(100):
        ring.add(message(number), at_ns=number)
    assert [held.sequence for held in ring.held()] == list(range(90, 100))
    assert ring.bytes_held == 10 * (1000 + OVERHEAD_BYTES)


def test_a_ring_is_no_longer_than_it_may_be_whatever_the_wall_clock_is_set_to() -> None:
    ring = Ring(most_s=5.0, most_bytes=1 << 30)
    for second in range(20):
        wall_ns = second * NS_PER_S + (10**18 if second >= 15 else 0)  # set in between
        ring.add(replace(message(second), wall_ns=wall_ns), at_ns=second * NS_PER_S)
    assert [held.sequence for held in ring.held()] == list(range(14, 20))
    assert ring.seconds == 5.0


def test_a_ring_still_knows_the_state_that_held_at_its_begin() -> None:
    ring = Ring(most_s=5.0, most_bytes=1 << 30)
    ring.add(Message(STATE, 0, state("tracking", "eyes seen", monotonic_ns=0)), at_ns=0)
    ring.add(message(60), at_ns=60 * NS_PER_S)
    assert [held.topic for held in ring.held()] == [STATE, "/refresh"]


def wait_for_file(folder: Path) -> Path:
    assert eventually(lambda: bool(list(folder.glob("blackbox-*.mcap"))), within_s=30.0)
    return next(iter(folder.glob("blackbox-*.mcap")))


def test_a_fault_writes_what_was_before_it_and_what_followed(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(recording, "AFTER_FAULT_NS", NS_PER_S // 2)
    recorder = Recorder(Plan(minutes=2.0, folder=tmp_path))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        rig.plan.fault = SensorLost("unplugged")
        rig.refresh_until("degraded: sensor")
        rig.plan.fault = None
        rig.refresh_until("tracking")
        rig.refresh_until(lambda: bool(list(tmp_path.glob("blackbox-*.mcap"))))
        recorder.close()
    told = read(wait_for_file(tmp_path))
    passed = [m.value["state"] for m in told if m.topic == "/state"]
    assert passed.index("tracking") < passed.index("degraded")
    assert passed[-1] == "tracking"
    reason = next(m.value for m in told if m.topic == "/state" and m.value["state"] == "degraded")
    assert reason["missing"] == ["sensor"] and "unplugged" in reason["reason"]
    assert any("degraded: sensor" in m.value["message"] for m in told if m.topic == "/log")
    assert len(list(tmp_path.iterdir())) == 1  # nothing half-written beside it


def test_it_is_written_when_asked_and_the_samples_in_it_are_a_recording(tmp_path: Path) -> None:
    answers: list[tuple[str, Path | None]] = []
    recorder = Recorder(Plan(minutes=2.0, folder=tmp_path))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        recorder.save("asked for", lambda problem, path: answers.append((problem, path)))
        rig.refresh_until(lambda: bool(answers))
        recorder.close()
        sent_m = rig.accounts[-1].eyes_m
    problem, path = answers[0]
    assert problem == "" and path is not None and path.parent == tmp_path
    samples = list(Recording(path).samples())
    assert samples and sent_m is not None
    # This sensor's points are in the stack's frame; the recording's are in a sensor's, as the calibration has it.
    points = samples[-1].eyes
    assert points is not None
    np.testing.assert_allclose(load_calibration(None).apply(points).eyes_m, sent_m, atol=0.01)


def test_where_nothing_is_kept_asking_is_refused() -> None:
    answers: list[str] = []
    Recorder(Plan(minutes=0.0)).save("asked for", lambda problem, _: answers.append(problem))
    assert "blackbox_minutes" in answers[0]


def test_an_error_that_ends_the_run_leaves_its_black_box(tmp_path: Path) -> None:
    recorder = Recorder(Plan(minutes=2.0, folder=tmp_path))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        recorder.close(crashed="ValueError: a bug")
    assert [m.value["state"] for m in read(wait_for_file(tmp_path)) if m.topic == "/state"][-1] == "tracking"


def test_only_so_many_files_stay(tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / f"blackbox-2020010{number}T000000Z-1.mcap").write_bytes(b"old")
    (tmp_path / "mine.mcap").write_bytes(b"kept")
    recorder = Recorder(Plan(minutes=2.0, folder=tmp_path, files=3))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        recorder.save("asked for")
        recorder.close()
    names = sorted(path.name for path in tmp_path.glob("blackbox-*.mcap"))
    assert len(names) == 3 and names[:2] == [f"blackbox-2020010{n}T000000Z-1.mcap" for n in (3, 4)]
    assert (tmp_path / "mine.mcap").exists()


def test_who_does_not_keep_up_loses_entries_and_the_presenter_never_waits(monkeypatch: Any) -> None:
    monkeypatch.setattr(recording, "TURN_S", 3600.0)  # its thread never comes round
    monkeypatch.setattr(recording, "QUEUED_MAX", 10)
    recorder = Recorder(Plan(minutes=2.0))
    with Rig(recorder=recorder) as rig:
        rig.refreshes(60)
        assert recorder.lost >= 50
        assert recorder.describe()["lost"] == recorder.lost
        recorder.close()


@pytest.mark.parametrize("images", [False, True])
def test_the_sensors_pictures_are_in_it_only_where_asked_for(tmp_path: Path, images: bool) -> None:
    path = tmp_path / "box.mcap"
    recorder = Recorder(Plan(record=path, images=images))
    presenter: Any = SimpleNamespace(
        clock=SimulatedClock(NS_PER_S),
        samples=SimpleNamespace(serial="S"),
        machine=SimpleNamespace(name="tracking", reason="eyes seen"),
        run_cell=SimpleNamespace(state=SimpleNamespace(settings=Rig().settings, calibration=load_calibration(None))),
    )
    recorder.watches(presenter, stack=STACK, simulated=True, in_stack_frame=False)
    face = np.full((48, 64, 3), 120, np.uint8)
    eyes = EyePoints(np.array([[-0.03, 0.0, 0.6], [0.03, 0.0, 0.6]]), np.ones(2))
    recorder.sampled(SensorFrame(1, NS_PER_S, eyes, colour=face, depth_mm=face[..., 0].astype(np.uint16)))
    recorder.close()
    topics = {message.topic for message in read(path)}
    assert ({"/colour", "/depth"} <= topics) == images
    assert "/eyes" in topics
    assert (Recording(path).first.colour is not None) == images


def test_a_file_that_cant_be_written_is_told_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        BlackBoxFile(tmp_path / "file" / "box.mcap", RecordingHeader("replay"), why="record")


def test_a_full_disk_ends_the_file_and_not_the_run(tmp_path: Path, caplog: Any) -> None:
    path = tmp_path / "box.mcap"
    recorder = Recorder(Plan(record=path))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        file: Any = recorder._file
        full = os.open("/dev/full", os.O_WRONLY)
        os.dup2(full, file._file.fileno())
        os.close(full)
        rig.refresh_until(lambda: recorder.describe()["recording"] is None)
        rig.refreshes(5)
        recorder.close()
    assert any("cannot be written" in record.getMessage() for record in caplog.records)
    assert [left.name for left in tmp_path.iterdir() if left.name.startswith(".")] == []


def test_an_eye_sees_the_display_the_right_way_round() -> None:
    layers = np.zeros((3, 36, 64, 4), np.uint8)
    layers[1, :9, :16] = 128  # top left of the middle panel
    frame = PanelFrame(1, layers, 1)
    image = seen(frame, STACK, np.array([0.6, 0.0, 0.0]), width_px=64, height_px=36)
    assert image[4, 8].min() > 100  # half of sin²'s period
    assert image[20:, 20:40].max() == 0


def test_what_an_eye_sees_of_the_front_panel_shifts_with_the_eye() -> None:
    layers = np.zeros((3, 36, 64, 4), np.uint8)
    layers[2, :, 32] = 255
    frame = PanelFrame(1, layers, 1)
    columns = []
    for y_m in (-0.1, 0.0, 0.1):
        image = seen(frame, STACK, np.array([0.6, y_m, 0.0]), width_px=64, height_px=36)
        columns.append(float(np.nonzero(image[18, :, 0] > 200)[0].mean()))
    # The front panel is 6 cm before the plane that is pictured: it moves the other way, by y · 0.06 / 0.54.
    pixels = 0.1 * 0.06 / 0.54 / (0.5184 / 64)
    assert columns[0] - columns[1] == pytest.approx(pixels, abs=1.0)
    assert columns[1] - columns[2] == pytest.approx(pixels, abs=1.0)


def refresh_of(frame: PanelFrame, *, number: int = 1, eyes_m: Any = None) -> Any:
    return SimpleNamespace(frame=frame, account=SimpleNamespace(frame=number, present_ns=number, eyes_m=eyes_m))


def decoded(jpeg: bytes) -> Any:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]


@pytest.mark.parametrize("wider", [1, 8, 30])
def test_a_layers_picture_has_its_colours_where_they_are(wider: int) -> None:
    stack = PanelStack(0.5184, 0.2916, STACK.x_m, 64 * wider, 36 * wider)
    layers = np.zeros((3, stack.height_px, stack.width_px, 4), np.uint8)
    layers[0, :, : stack.width_px // 2] = (200, 100, 40, 255)
    found = decoded(pictures_of(refresh_of(PanelFrame(1, layers, 1)), stack, width_px=64).jpegs["layer-0"])
    assert found.shape == (36, 64, 3)
    np.testing.assert_allclose(found[:, :28].mean((0, 1)), (200, 100, 40), atol=4)
    assert found[:, 36:].max() < 20


def test_pictures_are_made_anew_only_where_something_else_shows(monkeypatch: Any) -> None:
    made: list[int] = []

    def counted(refresh: Any, stack: PanelStack) -> Any:
        made.append(refresh.account.frame)
        return pictures_of(refresh, stack)

    monkeypatch.setattr(recording, "pictures_of", counted)
    monkeypatch.setattr(recording, "KEPT_PICTURES_EVERY_NS", 0)
    layers = np.zeros((3, 36, 64, 4), np.uint8)
    recorder = Recorder(Plan(minutes=1.0))
    recorder._clock, recorder._stack = MonotonicClock(), STACK
    eyes_m = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
    shown = [PanelFrame(1, layers, 1), PanelFrame(2, layers, 1), PanelFrame(3, layers, 2)]
    for number, frame in enumerate(shown, start=1):
        recorder._latest = refresh_of(frame, number=number, eyes_m=eyes_m)
        recorder._make_pictures()
        assert recorder.look_at_pictures()["frame"] == number
    recorder._latest = refresh_of(shown[-1], number=4, eyes_m=eyes_m + 0.01)
    recorder._make_pictures()
    assert made == [1, 3, 4]


def test_black_boxes_go_where_the_service_may_write() -> None:
    assert black_box_folder("/data/boxes") == Path("/data/boxes")
    assert state_folder({"STATE_DIRECTORY": "/var/lib/phasestack", "HOME": "/root"}) == Path("/var/lib/phasestack")
    assert state_folder({"XDG_STATE_HOME": "/x", "HOME": "/root"}) == Path("/x/phasestack")
    assert state_folder({"HOME": "/home/me"}) == Path("/home/me/.local/state/phasestack")


def test_telling_the_recorder_costs_the_presenter_little_of_a_refresh() -> None:
    """A ratio within one run: both figures are of the same machine at the same time."""
    recorder = Recorder(Plan(minutes=1.0))
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        refresh = rig.presenter.last
        assert refresh is not None
        clock = MonotonicClock()
        spent = []
        for _ in range(200):
            begun_ns = clock.now_ns()
            recorder.refreshed(refresh)
            spent.append(clock.now_ns() - begun_ns)
        recorder.close()
    assert np.median(spent) < 0.02 * NS_PER_S / 60
