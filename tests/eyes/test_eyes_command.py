"""Tests that `phasestack eyes` finds pupils in pictures, films and recordings, and draws overlays."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import Result

from runtime.commands.eyes import eyes as command
from runtime.errors import InputError
from runtime.evaluation.motion_recording import write_motion
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.artifacts import write_png
from runtime.support.picture_file import read_image
from tests.calls import invoked
from tests.eyes.scene import camera, eileen, frame, scene

CAMERA = camera(640, 480, 65.0)


def eyes(*arguments: str | Path) -> Result:
    return invoked(command, *arguments)


def places(count: int) -> list[np.ndarray]:
    return [np.array([0.004 * number, 0.0, 0.6]) for number in range(count)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A portrait, a picture of nobody, a film and a recording of a head that moves."""
    folder = tmp_path_factory.mktemp("pictures")
    write_png(folder / "eileen.png", eileen().picture)
    write_png(folder / "nobody.png", np.full((90, 120, 3), 77, np.uint8))
    film = cv2.VideoWriter(str(folder / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 30, (640, 480))
    header = RecordingHeader("openni2", "1", colour=True, depth=True)
    with recording_to(folder / "record.mcap", header) as recording:
        for number, place in enumerate(places(5)):
            colour, depth, _ = scene(place, intrinsics=CAMERA)
            film.write(np.ascontiguousarray(colour[..., ::-1]))
            recording.write(frame(colour, depth, CAMERA, number=number + 1))
    film.release()
    return folder


def test_pictures_films_and_recordings_in_the_order_given(folder: Path, tmp_path: Path) -> None:
    names = ["eileen.png", "nobody.png", "film.mp4", "record.mcap"]
    done = eyes(*(folder / name for name in names), "--out", tmp_path / "out", "--json")
    assert done.exit_code == 0, done.exception
    rows = json.loads(done.stdout)["pictures"]
    assert [Path(row["file"]).name for row in rows] == [*names[:2], *["film.mp4"] * 5, *["record.mcap"] * 5]
    portrait, nobody, *frames = rows
    assert np.abs(np.array(portrait["eyes_px"]) - eileen().pupils).max() < 1.5
    assert portrait["seen"] == "found" and 0 < portrait["sigma_px"] < 1 and portrait["ms"] > 0
    assert nobody["eyes_px"] is None and nobody["sigma_px"] is None and nobody["reason"] == "no face"
    assert [row["seen"] for row in frames] == ["found", *["followed"] * 4] * 2
    for row, place in zip(rows[-5:], places(5)):
        assert np.abs(np.mean(row["eyes_m"], axis=0) - place).max() < 0.006
    left = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert left == ["000-eileen.png", "001-nobody.png", "002-film.mp4", "003-record.mp4"]
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "out").iterdir()} == {0o600}
    overlay = read_image(tmp_path / "out" / "000-eileen.png").astype(int)
    assert ((overlay[..., 1] - overlay[..., 0] > 120) & (overlay[..., 1] - overlay[..., 2] > 120)).sum() > 50  # green


def test_pictures_in_sequence_are_followed(folder: Path) -> None:
    done = eyes(folder / "eileen.png", folder / "eileen.png", "--sequence", "--rate-hz", "60", "--json")
    assert [row["seen"] for row in json.loads(done.stdout)["pictures"]] == ["found", "followed"]


def test_an_unreadable_file_gives_one_line_and_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    for name in ("text.png", "text.mp4", "text.mcap", "missing.png", "missing.mp4"):
        if name.startswith("text"):
            (tmp_path / name).write_text("no picture")
        done = eyes(folder / "eileen.png", tmp_path / name, "--out", tmp_path / "out")
        assert isinstance(done.exception, InputError) and done.stdout == "", name
        assert name in str(done.exception) and "\n" not in str(done.exception) and not (tmp_path / "out").exists()


def test_without_a_file_the_sensor_is_looked_at(tmp_path: Path) -> None:
    done = eyes("--json")
    row, *_ = json.loads(done.stdout)["pictures"]
    assert done.exit_code == 0 and row["eyes_px"] is None and len(row["eyes_m"]) == 2
    assert row["reason"] == "this sensor delivers eye positions but no pictures"
    config = tmp_path / "end.toml"
    write_motion(tmp_path / "second.mcap", "still", seconds=1.0)
    config.write_text('[sensor]\nsource = "second.mcap"\n')
    live = eyes("--config", config)
    assert live.exit_code == 0 and "eyes_m (" in live.stdout
