"""Tests that the black box stays bounded, is written at faults and on request, and can be replayed."""

from __future__ import annotations

import json
import logging
import os
import stat
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from mcap.exceptions import EndOfFile, RecordLengthLimitExceeded
from mcap.reader import NonSeekingReader

from runtime.blackbox import recorder as recording
from runtime.blackbox.recorder import Recorder, make_room, write_file
from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.daemon.build import Host, RunOptions, build_run
from runtime.errors import SensorLost
from runtime.eyes.calibration import load_calibration
from runtime.records import RefreshAccount
from runtime.sensor.recording import Recording, recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.sensor.replay import demo_recording_path
from tests.daemon.rig import Rig
from tests.waiting import eventually

SMALL: dict[str, Any] = {
    "stack": {"width_px": 64, "height_px": 36},
    "model": {"name": "fast", "threads": 1},
    "loop": {"rate_hz": 20.0},
}


@dataclass(frozen=True)
class Read:
    """A message as a reader has it."""

    topic: str
    schema: dict[str, Any]
    value: dict[str, Any]


def read(path: Path) -> list[Read]:
    """Every message of a file, by the mcap library."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return [
            Read(channel.topic, json.loads(schema.data), json.loads(message.data))
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
            if schema is not None
        ]


def run_of(source: Path, *, recorder: Recorder | None = None) -> list[RefreshAccount]:
    """Every refresh of a recording on the simulated clock."""
    settings = Settings.model_validate({**SMALL, "sensor": {"driver": "replay", "source": str(source)}})
    accounts: list[RefreshAccount] = []
    with ExitStack() as cleanup:
        host = Host()
        host.recorder = recorder
        run = build_run(settings, RunOptions(max_speed=True), cleanup, host, on_account=accounts.append)
        run.presenter.run()
        if recorder is not None:
            recorder.save("asked")
            recorder.close()
    return accounts


@pytest.fixture(autouse=True)
def logged(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "phasestack")


@pytest.fixture(scope="module")
def stalled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Four seconds of the demo recording, of which one and a half are missing."""
    path = tmp_path_factory.mktemp("stalled") / "stalled.mcap"
    demo = Recording(demo_recording_path())
    with recording_to(path, demo.header) as writer:
        for sample in demo.samples():
            second = (sample.capture_ns - demo.first.capture_ns) / NS_PER_S
            if second < 4.0 and not 1.0 < second < 2.5:
                writer.write(sample)
    yield path


def the_file(folder: Path) -> Path:
    (found,) = folder.glob("blackbox-*.mcap")
    return found


def test_it_holds_every_refresh_and_sample_and_replays_to_the_same_states(stalled: Path, tmp_path: Path) -> None:
    recorder = Recorder(tmp_path, minutes=2.0)
    accounts = run_of(stalled, recorder=recorder)
    path = the_file(tmp_path)
    messages = read(path)
    count = Counter(message.topic for message in messages)
    assert (count["/refresh"], count["/eyes"]) == (len(accounts), 76)  # 30 samples a second, less those missing
    passed = [state for state, _ in groupby(m.value["state"] for m in messages if m.topic == "/state")]
    assert passed == ["flat", "tracking", "holding", "flat", "tracking"]
    for message in messages:
        jsonschema.validate(message.value, message.schema)
    again = run_of(path)
    assert [account.state for account in again] == [account.state for account in accounts]
    for before, after in zip(accounts, again, strict=True):
        if before.eyes_m is not None:
            np.testing.assert_allclose(after.eyes_m, before.eyes_m, atol=1e-6)


def test_it_keeps_no_more_than_its_minutes_and_its_bytes(tmp_path: Path, monkeypatch: Any) -> None:
    recorder = Recorder(tmp_path, minutes=1.0 / 60)
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        rig.refreshes_for(1.5)
        assert 0.5 < recorder.describe()["kept_s"] <= 1.0
        monkeypatch.setattr(recording, "BYTES_MAX", 20_000)
        rig.refreshes(3)
        assert recorder.describe()["kept_mib"] * (1 << 20) <= 20_000 * 1.1
        recorder.close()


def test_a_journal_that_hangs_costs_no_more_memory_than_is_kept(tmp_path: Path, monkeypatch: Any) -> None:
    """Entries waiting for the journal used to be kept without bound."""
    hangs, added, add = threading.Event(), [], recording._Journal.add
    monkeypatch.setattr(recording, "JOURNAL_EVERY_NS", 0)
    monkeypatch.setattr(recording, "BYTES_MAX", 20_000)

    def slow(self: Any, fresh: list[Any], *more: Any, **named: Any) -> None:
        added.append(len(fresh))
        if len(added) == 1:
            assert hangs.wait(60.0)
        add(self, fresh, *more, **named)

    monkeypatch.setattr(recording._Journal, "add", slow)
    recorder = Recorder(tmp_path, minutes=2.0)
    with Rig(recorder=recorder) as rig:
        rig.refreshes(300)
        assert len(added) == 1
        hangs.set()
        rig.refresh_until(lambda: len(added) > 1)
        recorder.close()
    assert 10 < added[1] < 100  # 20,000 bytes hold no more


def test_a_fault_writes_what_preceded_and_followed_it_for_its_owner_alone(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(recording, "AFTER_FAULT_NS", NS_PER_S // 2)
    recorder = Recorder(tmp_path, minutes=2.0)
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        rig.plan.fault = SensorLost("unplugged")
        rig.refresh_until("degraded: sensor")
        rig.plan.fault = None
        rig.refresh_until("tracking")
        rig.refresh_until(lambda: bool(list(tmp_path.glob("blackbox-*.mcap"))))
        recorder.close()
    path = the_file(tmp_path)
    assert [fault["file"] for fault in recorder.look_at_log()["faults"]] == [str(path)]
    assert path.stem.endswith("-fault-sensor") and stat.S_IMODE(path.stat().st_mode) == 0o600
    messages = read(path)
    states = [m.value["state"] for m in messages if m.topic == "/state"]
    passed = [state for state, _ in groupby(s for s in states if s not in ("holding", "flat"))]  # a busy machine's
    assert passed[-3:] == ["tracking", "degraded", "tracking"]
    reason = [m.value for m in messages if m.topic == "/state" and m.value["state"] == "degraded"][-1]
    assert reason["missing"] == ["sensor"] and "unplugged" in reason["reason"]
    assert any("degraded: sensor" in m.value["message"] for m in messages if m.topic == "/log")
    assert len(list(tmp_path.iterdir())) == 1  # no partial file next to it


def test_a_start_without_a_sensor_is_no_fault(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(recording, "AFTER_FAULT_NS", 0)
    recorder = Recorder(tmp_path, minutes=2.0)
    rig = Rig(recorder=recorder)
    rig.plan.refuse = SensorLost("not plugged in yet")
    with rig:
        rig.refresh_until("degraded: sensor")
        rig.refreshes(3)
        recorder.close()
    assert not list(tmp_path.iterdir())


def test_a_requested_file_is_written_and_its_samples_are_a_recording(tmp_path: Path) -> None:
    answers: list[tuple[str, Path | None]] = []
    recorder = Recorder(tmp_path, minutes=2.0)
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        recorder.save("asked", lambda problem, path: answers.append((problem, path)))
        rig.refresh_until(lambda: bool(answers))
        recorder.close()
        sent_m = rig.plan.eyes_m
    problem, path = answers[0]
    assert problem == "" and path is not None and path.parent == tmp_path
    points = list(Recording(path).samples())[-1].eyes
    assert points is not None
    # This sensor's points are in the stack's frame; the recording's are in a sensor's, as the calibration has it.
    np.testing.assert_allclose(load_calibration(None).apply(points).eyes_m, sent_m, atol=0.01)


def test_where_nothing_is_kept_asking_is_refused(tmp_path: Path) -> None:
    answers: list[str] = []
    Recorder(tmp_path, minutes=0.0).save("asked", lambda problem, _: answers.append(problem))
    assert "blackbox_minutes" in answers[0]


def test_an_error_that_ends_the_run_leaves_its_black_box(tmp_path: Path) -> None:
    with pytest.raises(ValueError), Recorder(tmp_path, minutes=2.0) as recorder, Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        raise ValueError("a bug")
    messages = read(the_file(tmp_path))
    assert any("ValueError: a bug" in m.value["message"] for m in messages if m.topic == "/log")


def test_a_folder_that_cant_be_written_is_reported_to_who_asks(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    answers: list[str] = []
    recorder = Recorder(tmp_path / "file", minutes=2.0)
    with Rig(recorder=recorder) as rig:
        rig.refresh_until("tracking")
        recorder.save("asked", lambda problem, _: answers.append(problem))
        rig.refresh_until(lambda: bool(answers))
        recorder.close()
    assert "cannot be written" in answers[0]


def test_a_flood_of_one_kind_displaces_no_other_kind(tmp_path: Path) -> None:
    earlier = tmp_path / "blackbox-20200101T000000Z-fault-sensor.mcap"
    earlier.write_bytes(b"an earlier run's")
    (tmp_path / "mine.mcap").write_bytes(b"kept")
    for day, kind in ((2, "fault-model"), (3, "fault-panel")):
        for number in range(100):
            file = tmp_path / f"blackbox-2020010{day}T00{number:04}Z-{kind}.mcap"
            file.write_bytes(b"new")
            make_room(tmp_path)
    kept = [path.name for path in sorted(tmp_path.glob("blackbox-*.mcap"))]
    assert len(kept) == recording.FILES_MAX and (tmp_path / "mine.mcap").exists()
    assert kept[:2] == [earlier.name, "blackbox-20200102T000000Z-fault-model.mcap"]
    assert "blackbox-20200102T000099Z-fault-model.mcap" in kept
    assert "blackbox-20200103T000000Z-fault-panel.mcap" in kept and kept[-1] == file.name


def test_many_requests_in_one_second_all_get_whole_files(tmp_path: Path) -> None:
    """A hundred requests once gave 73 refusals and 3 unreadable files."""
    answers: list[tuple[str, Path | None]] = []
    with Rig(recorder=(recorder := Recorder(tmp_path, minutes=1))) as rig:
        rig.refreshes(50)
        for _ in range(25):
            asking = [
                threading.Thread(target=recorder.save, args=("asked", lambda *answer: answers.append(answer)))
                for _ in range(4)
            ]
            for one in asking:
                one.start()
            rig.presenter.refresh()
        rig.refresh_until(lambda: len(answers) == 100)
    assert [problem for problem, _ in answers if problem] == []
    there = sorted(tmp_path.glob("blackbox-*.mcap"))
    assert all(len(read(path)) > 50 for path in there) and there[-1] == answers[-1][1]
    assert not [path for path in tmp_path.iterdir() if path not in there and recording.JOURNAL not in path.name]


def test_setting_the_clock_back_does_not_age_the_newest_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class SetBack(datetime):
        year_now = 2026

        @classmethod
        def now(cls, tz: Any = None) -> Any:
            return datetime(cls.year_now, 11, 20, tzinfo=tz)

    monkeypatch.setattr(recording, "datetime", SetBack)
    files = []
    for number in range(recording.FILES_MAX + 5):
        SetBack.year_now = 2026 if number < recording.FILES_MAX else 2000
        files.append(write_file(tmp_path, "asked", [], RecordingHeader("replay", ""), "{}"))
        make_room(tmp_path)
        assert files[-1].exists()
    assert sorted(tmp_path.glob("blackbox-*.mcap")) == [files[0], *files[6:]]


WRITES = """
import sys
from pathlib import Path
from runtime.blackbox.recorder import BlackBoxMessage, write_file
from runtime.sensor.recording_format import RecordingHeader


def kept():
    yield BlackBoxMessage(1, 1, "/refresh", b'"' + b"x" * 4000000 + b'"', 1)
    print("writing", flush=True)
    sys.stdin.read()


write_file(Path(sys.argv[1]), "asked", kept(), RecordingHeader("replay", ""), "{}")
"""


def test_leftovers_of_a_killed_writer_are_swept_but_not_files_being_written(tmp_path: Path) -> None:
    def writer() -> subprocess.Popen[str]:
        command = [sys.executable, "-c", WRITES, str(tmp_path)]
        begun = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert begun.stdout is not None and begun.stdout.readline() == "writing\n"
        return begun

    with writer() as killed:
        killed.kill()
    with writer() as busy:
        assert len(list(tmp_path.iterdir())) == 2
        Recorder(tmp_path, minutes=1)
        (left,) = tmp_path.iterdir()
        assert left.name.endswith(".part")
    (whole,) = tmp_path.iterdir()
    assert busy.returncode == 0 and len(read(whole)) == 1


def test_after_a_kill_the_next_run_finds_all_but_the_last_seconds(tmp_path: Path) -> None:
    config = tmp_path / "a.toml"
    config.write_text(f'[stack]\nwidth_px = 64\nheight_px = 36\n[model]\nname = "fast"\nthreads = 1\nbackend = "cpu"\n'
                      f'[service]\nsocket = "{tmp_path}/s.sock"\n')  # fmt: skip
    command = [sys.executable, "-m", "runtime.cli", "run", "--config", config, "--replay", "demo", "--headless"]
    with subprocess.Popen(command, env={**os.environ, "STATE_DIRECTORY": str(tmp_path)}) as run:
        boxes = tmp_path / "blackbox"
        assert eventually(lambda: any(path.stat().st_size > 200_000 for path in boxes.glob(".*.part")))
        killed_ns = time.monotonic_ns()
        run.kill()
    Recorder(boxes, minutes=1).close()
    (cut,) = boxes.iterdir()
    assert cut.name.endswith("-cut.mcap")
    at_ns = []
    with cut.open("rb") as file, suppress(EndOfFile, RecordLengthLimitExceeded):
        for _, channel, message in NonSeekingReader(file).iter_messages(log_time_order=False):
            at_ns += [json.loads(message.data)["present_ns"]] if channel.topic == "/refresh" else []
    assert killed_ns - at_ns[-1] < recording.JOURNAL_EVERY_NS + 9 * NS_PER_S and len(at_ns) > 100  # of a busy machine
    assert sum(1 for _ in Recording(cut).samples()) > 50  # it is a recording as others are
