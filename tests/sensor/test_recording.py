"""Tests that a recording is read as written, survives crashes and stays within its limits."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from runtime.errors import InputError
from runtime.records import EyePoints, Intrinsics, SensorFrame
from runtime.sensor.recording import MAX_S, Recording, recording_to
from runtime.sensor.recording_format import RecordingHeader, eyes_message, frame_from_eyes_message
from runtime.sensor.replay import demo_recording_path

EYES_ONLY = RecordingHeader(driver="test", serial="S1")
WITH_IMAGES = RecordingHeader(driver="test", colour=True, depth=True)
DEMO = [eyes_message(frame) for frame in Recording(demo_recording_path()).samples()]
DEMO_BYTES = demo_recording_path().read_bytes()
CAMERA = Intrinsics(64, 48, 60.0, 61.0, 32.5, 23.5)


def sample(k: int, **parts: Any) -> SensorFrame:
    eyes = EyePoints(np.array([[0.03, 0.0, 0.6 + k * 1e-4], [-0.03, 0.0, 0.6]]), np.array([0.9, 0.5]))
    return SensorFrame(k, 10**9 + k * 33_333_333, eyes, **parts)


def write(
    path: Path, frames: list[SensorFrame], header: RecordingHeader = EYES_ONLY, *, max_s: float = MAX_S
) -> list[bool]:
    with recording_to(path, header, max_s=max_s) as writer:
        return [writer.write(frame) for frame in frames]


def test_all_people_come_back_with_their_true_eyes(tmp_path: Path) -> None:
    second = EyePoints(np.full((2, 3), 0.8), np.array([0.7, 1.0]), "left", np.diag([1e-6, 2e-6, 3e-6]))
    absent = np.full((2, 3), np.nan)
    truth = np.concatenate([absent, np.full((2, 3), 0.5)])
    alone, both = sample(1, true_eyes_m=truth), sample(2, true_eyes_m=truth, others=(second,))
    write(tmp_path / "two.mcap", [alone, both])
    first, read = Recording(tmp_path / "two.mcap").samples()
    assert first.others == () and len(read.people) == 2
    np.testing.assert_allclose(read.true_eyes_m, truth)
    (back,) = read.others
    np.testing.assert_allclose(back.eyes_m, second.eyes_m)
    np.testing.assert_allclose(back.covariance_m2, second.covariance_m2)
    assert back.completed == "left" and back.confidence.tolist() == [0.7, 1.0]


def test_a_sample_of_one_person_is_written_as_before() -> None:
    assert "others" not in eyes_message(sample(1, true_eyes_m=np.zeros((2, 3)))).decode()


def test_others_without_a_nearest_person_are_refused() -> None:
    message = json.dumps(
        {"sequence": 1, "capture_ns": 1, "eyes_m": None, "others": [{"eyes_m": [[0, 0, 1], [0, 0, 1]]}]}
    )
    with pytest.raises(ValueError, match="others"):
        frame_from_eyes_message(message.encode())


finite = st.floats(-10, 10)


@given(
    values=st.lists(st.one_of(finite, st.just(float("nan"))), min_size=6, max_size=6),
    sequence=st.integers(0, 2**40),
    capture_ns=st.integers(0, 2**62),
    completed=st.sampled_from(["", "left", "right"]),
    truth=st.booleans(),
    face=st.booleans(),
)
def test_a_sample_comes_back_to_a_tenth_of_a_micrometre(
    values: list[float], sequence: int, capture_ns: int, completed: str, truth: bool, face: bool
) -> None:
    points = np.array(values).reshape(2, 3)
    covariance_m2 = np.array([[4e-6, 1e-9, 0.0], [1e-9, 1e-8, 0.0], [0.0, 0.0, 1.2e-8]])
    eyes = EyePoints(points, np.array([0.25, 1.0]), completed, covariance_m2) if face else None
    frame = SensorFrame(sequence, capture_ns, eyes, true_eyes_m=np.nan_to_num(points) if truth else None)
    back = frame_from_eyes_message(eyes_message(frame))
    assert (back.sequence, back.capture_ns, back.eyes is None) == (sequence, capture_ns, not face)
    if face:
        np.testing.assert_allclose(back.eyes.eyes_m, points, atol=6e-8)
        assert back.eyes.completed == completed
        np.testing.assert_allclose(back.eyes.covariance_m2, covariance_m2, rtol=1e-3)
    assert (back.true_eyes_m is not None) == truth


def test_a_file_tells_its_sensor_and_all_its_samples(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.mcap"
    assert all(write(path, [sample(k) for k in range(100)]))
    recording = Recording(path)
    assert recording.header == EYES_ONLY
    assert [f.sequence for f in recording.samples()] == list(range(100))
    assert [f.sequence for f in recording.samples()] == list(range(100))  # as often as one likes
    assert recording.is_whole


def test_other_tools_open_it(tmp_path: Path) -> None:
    write(tmp_path / "a.mcap", [sample(k) for k in range(50)])
    with (tmp_path / "a.mcap").open("rb") as file:
        found = [(s.name, s.encoding, c.topic, json.loads(m.data)) for s, c, m in make_reader(file).iter_messages()]
    assert len(found) == 50
    assert found[0][:3] == ("phasestack.EyeSample", "jsonschema", "/eyes")
    assert found[3][3]["sequence"] == 3


def test_images_are_recorded_only_with_a_header_that_says_so(tmp_path: Path) -> None:
    random = np.random.default_rng(0)
    depth = random.integers(0, 65535, (48, 64), dtype=np.uint16)
    colour = np.full((48, 64, 3), (200, 100, 50), np.uint8)
    frame = sample(1, colour=colour, depth_mm=depth, intrinsics=CAMERA)
    write(tmp_path / "images.mcap", [frame, frame], WITH_IMAGES)
    write(tmp_path / "eyes.mcap", [frame, frame])
    for back in Recording(tmp_path / "images.mcap").samples():
        np.testing.assert_array_equal(back.depth_mm, depth)
        np.testing.assert_allclose(back.colour, colour, atol=3)
        assert back.intrinsics == CAMERA
    for back in Recording(tmp_path / "eyes.mcap").samples():
        assert back.colour is None and back.depth_mm is None and back.intrinsics is None
    assert b"/colour" not in (tmp_path / "eyes.mcap").read_bytes()


@pytest.mark.parametrize("kept", ["colour", "depth"])
def test_only_the_kind_of_picture_that_the_header_names_is_written(tmp_path: Path, kept: str) -> None:
    frame = sample(1, colour=np.zeros((48, 64, 3), np.uint8), depth_mm=np.ones((48, 64), np.uint16), intrinsics=CAMERA)
    write(tmp_path / "a.mcap", [frame], RecordingHeader(driver="test", **{kept: True}))
    back = Recording(tmp_path / "a.mcap").first
    assert (back.colour is not None, back.depth_mm is not None) == (kept == "colour", kept == "depth")
    assert back.intrinsics == CAMERA


def test_images_do_not_pile_up_in_memory(tmp_path: Path) -> None:
    depth = np.zeros((480, 640), np.uint16)
    write(tmp_path / "a.mcap", [sample(k, depth_mm=depth) for k in range(30)], WITH_IMAGES)
    tracemalloc.start()
    count = sum(1 for _ in Recording(tmp_path / "a.mcap").samples())
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert count == 30 and peak < 15 * depth.nbytes


def test_a_truncated_file_opens_up_to_its_last_whole_chunk(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole, path, counts = DEMO_BYTES, tmp_path / "cut.mcap", []
    with demo_recording_path().open("rb") as file:
        chunks = [one.chunk_start_offset + one.chunk_length for one in make_reader(file).get_summary().chunk_indexes]
    places = np.array([whole.index(message) for message in DEMO])
    for size in (40, 1000, *range(3000, len(whole), 4801)):
        path.write_bytes(whole[:size])
        caplog.clear()
        try:
            recording = Recording(path)
        except InputError as error:
            assert re.search(r"cut\.mcap: .*ends (before|within) ", str(error)) and size < chunks[0]
            continue
        found = list(recording.samples())
        assert [f.sequence for f in found] == list(range(1, 1 + len(found)))
        assert not recording.is_whole and "truncated" in caplog.text
        counts.append(len(found))
        assert len(found) == (places < max(end for end in chunks if end <= size)).sum()
    assert counts == sorted(counts) and counts[-1] > 280


@settings(max_examples=25, deadline=None)
@given(place=st.floats(0, 1, exclude_max=True), bits=st.integers(1, 255))
def test_a_damaged_byte_loses_no_sample_before_it_and_never_invents_one(
    tmp_path_factory: pytest.TempPathFactory, place: Any, bits: Any
) -> None:
    data = bytearray(DEMO_BYTES)
    data[int(place * len(data))] ^= bits
    path = tmp_path_factory.mktemp("damaged") / "a.mcap"
    path.write_bytes(bytes(data))
    try:
        found = list(Recording(path).samples())
    except InputError as error:
        assert str(path) in str(error)
        return
    assert [eyes_message(f) for f in found] == DEMO[: len(found)]


@pytest.mark.parametrize("kind", [0, 2, 4, 5, 7, 8, 11, 14, 15, 22, 70, 134, 255])
def test_a_chunk_whose_kind_is_damaged_ends_the_recording_with_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, kind: int
) -> None:
    """MCAP's readers skip records of unknown kinds, and take other kinds' fields out of the chunk's bytes."""
    with demo_recording_path().open("rb") as file:
        starts = [index.chunk_start_offset for index in make_reader(file).get_summary().chunk_indexes]
    for start in (starts[0], starts[len(starts) // 2], starts[-1]):
        path, data = tmp_path / "a.mcap", bytearray(DEMO_BYTES)
        data[start] = kind
        path.write_bytes(bytes(data))
        before = sum(DEMO_BYTES.index(message) < start for message in DEMO)
        caplog.clear()
        if not before:
            with pytest.raises(InputError, match=r"a\.mcap"):
                Recording(path)
            continue
        recording = Recording(path)
        assert [eyes_message(frame) for frame in recording.samples()] == DEMO[:before]
        assert not recording.is_whole and f"the chunk at byte {start} has no chunk marker" in caplog.text


def test_another_program_s_or_version_s_recording_is_called_so(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    foreign = r"missing from this MCAP recording \(ros2, libmcap 0\.8\.0, topic /camera/image\); .*`/eyes`.* \(see docs"
    for name, told in (("else", foreign), ("phasestack.recording", "schema version 99 is not supported")):
        with path.open("wb") as file:
            writer = Writer(file)
            writer.start(profile="ros2", library="libmcap 0.8.0")
            writer.add_metadata(name, {"schema_version": "99"})
            writer.add_message(writer.register_channel("/camera/image", "cdr", 0), 1, b"x", 1)
            writer.finish()
        with pytest.raises(InputError, match=told):
            Recording(path)
    for data, told in (
        (b"", "is empty"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag; convert it with `mcap convert`"),
        (b"SQLite format 3\0", "a ROS 2 bag in SQLite; convert it with `ros2 bag convert`"),
        (b"version https://git-lfs", r"a Git LFS pointer; fetch the file itself with `git lfs pull`"),
        (b"abc", "is not an MCAP"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=told):
            Recording(path)


def test_a_recording_with_its_metadata_at_the_end_is_played(tmp_path: Path) -> None:
    """Repair tools write such files."""
    path = tmp_path / "mended.mcap"
    with demo_recording_path().open("rb") as old, path.open("wb") as file:
        reader, writer = make_reader(old), Writer(file)
        writer.start(library="mender")
        channels: dict[str, int] = {}
        for _, channel, message in reader.iter_messages():
            if channel.topic not in channels:
                channels[channel.topic] = writer.register_channel(channel.topic, channel.message_encoding, 0)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        writer.finish()
    assert [eyes_message(frame) for frame in Recording(path).samples()] == DEMO


@pytest.mark.parametrize("limit", [30_000, 200_000])
def test_a_recording_stays_within_its_limits_of_length_and_size(
    tmp_path: Path, limit: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = write(tmp_path / "a.mcap", [sample(k) for k in range(100)], max_s=1.0)
    assert done.count(True) == 31 and not done[-1]  # 0 to 30/30 s
    assert len(list(Recording(tmp_path / "a.mcap").samples())) == 31
    depth = np.random.default_rng(0).integers(0, 65535, (48, 64), dtype=np.uint16)
    frames = [sample(k, depth_mm=depth) for k in range(1500)]
    monkeypatch.setattr("runtime.sensor.recording.MAX_BYTES", limit)
    for header in (EYES_ONLY, WITH_IMAGES):
        write(tmp_path / "a.mcap", frames, header)
        assert 0.4 * limit < (tmp_path / "a.mcap").stat().st_size <= limit
        recording = Recording(tmp_path / "a.mcap")
        assert list(recording.samples()) and recording.is_whole


def test_without_a_sample_an_older_file_stays_and_nothing_new_is_left(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"older")
    write(tmp_path / "a.mcap", [])
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("a.mcap", b"older")]


# A separate process with no unneeded imports.
RECORDER = """
import pathlib, resource, sys, time
import numpy as np
from runtime.records import EyePoints, SensorFrame
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
if limit := int(sys.argv[2]):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
eyes = EyePoints(np.array([[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]), np.array([0.9, 0.5]))
with recording_to(pathlib.Path(sys.argv[1]), RecordingHeader(driver="test")) as writer:
    for k in range(1000 if limit else 200):
        writer.write(SensorFrame(k, 10**9 + k * 33_333_333, eyes))
    print("written", flush=True)
    time.sleep(60)
"""


def test_a_killed_recorder_leaves_all_but_its_last_chunk(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    process = subprocess.Popen([sys.executable, "-c", RECORDER, str(path), "0"], stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"written\n"
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    recording = Recording(path)
    count = len(list(recording.samples()))
    assert not recording.is_whole and 170 <= count <= 200


def test_a_full_disk_is_named_and_what_was_written_can_be_read(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    # A measurement of coverage would write its own file.
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE_")}
    command = [sys.executable, "-c", RECORDER, str(path), "30000"]
    answer = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert answer.returncode != 0 and "InputError" in answer.stderr.splitlines()[-1] and str(path) in answer.stderr
    assert len(list(Recording(path).samples())) > 50


def bomb(path: Path, packed: bytes, *, kind: str, says: int) -> None:
    """A recording that begins with a chunk which is small, and large when unpacked."""
    from mcap.data_stream import RecordBuilder
    from mcap.records import Chunk

    builder = RecordBuilder()
    Chunk(kind, packed, 0, 0, 0, says).write(builder)
    whole, at = DEMO_BYTES, 8
    for _ in range(2):  # the header and the metadata
        at += 9 + int.from_bytes(whole[at + 1 : at + 9], "little")
    path.write_bytes(whole[:at] + builder.end() + whole[at:])


OPENED = """
import pathlib, resource, sys
from runtime.errors import InputError
from runtime.sensor.recording import Recording
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for name in sys.argv[1:]:
    try:
        list(Recording(pathlib.Path(name)).samples())
    except InputError as error:
        print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - base) >> 10)
"""


def test_a_small_chunk_that_becomes_a_large_one_takes_no_memory(tmp_path: Path) -> None:
    import lz4.frame
    import zstandard

    large, names = b"\0" * (300 << 20), []
    for kind, pack in (("lz4", lz4.frame.compress), ("zstd", zstandard.ZstdCompressor().compress)):
        packed = pack(large)
        assert len(packed) < 2 << 20
        for says in (300 << 20, 100, 1 << 62):
            names.append(str(tmp_path / f"{kind}-{says}.mcap"))
            bomb(Path(names[-1]), packed, kind=kind, says=says)
    answer = subprocess.run([sys.executable, "-c", OPENED, *names], capture_output=True, text=True, check=True)
    *told, grown_mib = answer.stdout.splitlines()
    assert int(grown_mib) < 120
    for name, line in zip(names, told, strict=True):
        assert (
            "unpacks to 300.0 MiB, but the maximum is 32 MiB" if name.endswith(f"-{300 << 20}.mcap") else name
        ) in line


def test_two_recorders_into_one_file_are_one_too_many(tmp_path: Path) -> None:
    path = tmp_path / "o.mcap"
    with recording_to(path, RecordingHeader("test")) as writer:
        for _ in range(2):  # before the file has its name, and after; a lock belongs to an open file, in any process
            second = recording_to(path, RecordingHeader("second"))
            with pytest.raises(InputError, match="is being recorded by another process"), second:
                pass
            assert writer.write(SensorFrame(writer.count + 1, writer.count * 10**7))
    assert len(list(Recording(path).samples())) == 2


@pytest.mark.parametrize(("colour", "mode"), [(False, 0o644), (True, 0o600)])
def test_recordings_with_pictures_are_their_owner_s_alone(tmp_path: Path, colour: bool, mode: int) -> None:
    with recording_to(tmp_path / "o.mcap", RecordingHeader("test", colour=colour)) as writer:
        writer.write(SensorFrame(1, 0))
    assert (tmp_path / "o.mcap").stat().st_mode & 0o777 == mode


@pytest.mark.parametrize(
    "text", ["Infinity", "-Infinity", "NaN", "1e999", str(2**70), "1e300", "-1", "1.5", '"12"', "true", "9" * 5000]
)
def test_a_capture_time_that_is_none_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"capture_ns|JSON") as caught:
        frame_from_eyes_message(f'{{"sequence":2,"eyes_m":null,"capture_ns":{text}}}'.encode())
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
