"""Tests which scene of a playlist is shown at each time, and how wrong entries are refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.playlist import PlaylistSource, read_playlist
from runtime.errors import InputError
from runtime.support.artifacts import write_png
from tests.calls import refusal
from tests.content.conftest import STACK, panel_view

EYE = (0.6, 0.0, 0.0)
COLOURS = {"red.png": (255, 0, 0), "green.png": (0, 255, 0), "blue.png": (0, 0, 255)}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, colour in COLOURS.items():
        write_png(tmp_path / name, np.full((90, 160, 3), colour, np.uint8))
    return tmp_path


def written(folder: Path, *shows: str, head: str = "") -> Path:
    path = folder / "list.toml"
    path.write_text(head + "".join(f"[[show]]\n{show}\n" for show in shows))
    return path


def colour_at(source: ContentSource, time_s: float) -> str:
    picture = source.render(panel_view(EYE, STACK.panel(1)), time_ns=round(time_s * NS_PER_S))
    pixel = tuple(picture[STACK.height_px // 2, STACK.width_px // 2, :3].tolist())
    return next((name.removesuffix(".png") for name, colour in COLOURS.items() if colour == pixel), str(pixel))


THREE = ("scene = 'red.png'\nseconds = 2", "scene = 'green.png'\nseconds = 3", "scene = 'blue.png'\nseconds = 1")


def test_each_is_shown_for_its_time_from_when_the_first_was(folder: Path, opened: Any) -> None:
    source = opened(written(folder, *THREE))
    start = 1000.0
    times = (0, 1.9, 2.1, 4.9, 5.1, 5.9, 6.1, 8.5)
    shown = [colour_at(source, start + time) for time in times]
    assert shown == ["red", "red", "green", "green", "blue", "blue", "red", "green"]
    assert source.info.name == "list: green (2 of 3)" and source.info.moving
    told = source.describe(time_ns=round((start + 8.5) * NS_PER_S))
    assert told is not None and (told["index"], told["left_s"]) == (1, 2.5)
    assert [entry["seconds"] for entry in told["entries"]] == [2, 3, 1]


def test_one_that_does_not_repeat_stays_at_its_last(folder: Path, opened: Any) -> None:
    source = opened(written(folder, *THREE, head="repeat = false\n"))
    assert [colour_at(source, time) for time in (0, 5.5, 100)] == ["red", "blue", "blue"]
    left_s = [source.describe(time_ns=round(time_s * NS_PER_S))["left_s"] for time_s in (1.5, 4.0, 5.5, 99.0)]
    assert left_s == [0.5, 1.0, None, None]
    assert [source.skip(time_ns=round(time_s * NS_PER_S)) for time_s in (1.5, 1.6, 1.7, 101.0)] == [
        True,
        True,
        False,
        False,
    ]


def test_the_next_one_can_be_asked_for(folder: Path, opened: Any) -> None:
    source = opened(written(folder, *THREE))
    assert colour_at(source, 50.0) == "red"
    assert source.skip(time_ns=round(50.5 * NS_PER_S)) and source.info.name == "list: green (2 of 3)"
    assert colour_at(source, 50.6) == "green"
    assert colour_at(source, 53.4) == "green" and colour_at(source, 53.6) == "blue"


def test_an_entry_has_its_own_settings_and_place(folder: Path, opened: Any) -> None:
    shows = ("scene = 'red.png'\nseconds = 1\nscale = 0.5", "scene = 'sparse'\nseconds = 1\nturntable_per_min = 6")
    source = opened(written(folder, *shows), offset_m=(0.0, 0.05, 0.0))
    picture = source.render(panel_view(EYE, STACK.panel(1)), time_ns=0)
    columns = np.nonzero(picture[..., 3] > 127)[1]
    pitch_m = STACK.width_m / STACK.width_px
    assert columns.mean() + 0.5 - STACK.width_px / 2 == pytest.approx(0.05 / pitch_m, abs=1)
    assert np.ptp(columns) + 1 == pytest.approx(STACK.width_px / 2, rel=0.03)


@pytest.mark.parametrize(
    ("shows", "told"),
    [
        (("scene = 'red.png'\nseconds = 1", "scene = 'gone.png'\nseconds = 1"), "show[1]: content: scene: "),
        (("scene = 'red.png'",), "show[0].seconds: "),
        (("scene = 'red.png'\nseconds = 0",), "show[0].seconds: "),
        (("seconds = 1",), "show[0].scene: "),
        (("scene = 'list.toml'\nseconds = 1",), "show[0].scene: a playlist cannot contain another playlist"),
        (("scene = 'other.toml'\nseconds = 1",), "show[0].scene: a playlist cannot contain another playlist"),
        (("scene = 'red.png'\nseconds = 1\nscael = 2",), "show[0].scael: is not a setting: did you mean scale?"),
        (("scene = 'red.png'\nseconds = 1\nscale = 'x'",), "show[0].scale: "),
        ((), "show: "),
        (("scene = 'red.png'\nseconds = 1",) * 65, "show: "),
    ],
)
def test_a_list_that_is_wrong_is_one_line_that_names_its_entry(
    folder: Path, opened: Any, shows: tuple[str, ...], told: str
) -> None:
    path = written(folder, *shows)
    assert refusal(opened, path).startswith(f"{path}: {told}")


@pytest.mark.parametrize(
    ("name", "text", "told"),
    [
        ("list.json", '{"frames": []}', "is a set of cameras for training a NeRF"),
        ("list.json", "{}", "show: is missing; a JSON file must be a playlist"),
        ("list.toml", "", "show: Field required"),
    ],
)
def test_a_file_without_scenes_is_no_list(tmp_path: Path, name: str, text: str, told: str) -> None:
    (tmp_path / name).write_text(text)
    assert told in refusal(read_playlist, tmp_path / name, ContentSettings())


class Inner(ContentSource):
    """Scene that keeps the times it was asked for."""

    def __init__(self, name: str) -> None:
        self.info, self.closed = ContentInfo(name, moving=True, background=None), 0
        self.picture = np.zeros((STACK.height_px, STACK.width_px, 4), np.uint8)
        self.asked_ns: list[int] = []

    def render(self, view: View, *, time_ns: int) -> np.ndarray:
        self.asked_ns.append(time_ns)
        return self.picture

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def inner(folder: Path) -> tuple[PlaylistSource, list[Inner]]:
    scenes = [Inner(name) for name in ("red", "green", "blue")]
    playlist = read_playlist(written(folder, *THREE), ContentSettings())
    return PlaylistSource(playlist, [lambda context, s=s: s for s in scenes], context=None), scenes


def test_each_scene_has_a_time_that_begins_when_it_is_shown(inner: tuple[PlaylistSource, list[Inner]]) -> None:
    source, scenes = inner
    assert source.info.name == "list: red (1 of 3)"
    for time_s in (100.0, 101.5, 102.0, 104.5, 106.0, 110.25):
        source.render(panel_view(EYE, STACK.panel(1)), time_ns=round(time_s * NS_PER_S))
    shown_s = [[ns / NS_PER_S for ns in scene.asked_ns] for scene in scenes]
    assert shown_s == [[0.0, 1.5, 0.0], [0.0, 2.5, 2.25], []]


def test_closing_a_playlist_closes_every_scene(inner: tuple[PlaylistSource, list[Inner]]) -> None:
    source, scenes = inner
    source.close()
    assert [scene.closed for scene in scenes] == [1, 1, 1]


def no_scene(context: Any) -> ContentSource:
    raise InputError("green", "", "is no scene")


def test_scenes_are_closed_if_a_later_one_cannot_be_shown(folder: Path) -> None:
    first, playlist = Inner("red"), read_playlist(written(folder, *THREE), ContentSettings())
    told = refusal(PlaylistSource, playlist, [lambda context: first, no_scene], context=None)
    assert told == f"{playlist.path}: show[1]: green: is no scene" and first.closed == 1


def test_no_revision_comes_back_when_a_later_round_is_skipped_through(
    inner: tuple[PlaylistSource, list[Inner]],
) -> None:
    source, _ = inner
    times_ns = [round(time_s * NS_PER_S) for time_s in (50.0, 51.0, 52.5, 55.5, 56.5, 58.5)]
    seen = [source.revision(time_ns=time_ns) for time_ns in times_ns]
    for time_ns in (times_ns[-1], times_ns[-1] + NS_PER_S // 2, times_ns[-1] + NS_PER_S):
        assert source.skip(time_ns=time_ns)
        seen.append(source.revision(time_ns=time_ns))
    assert seen == sorted(set(seen))


def test_files_of_an_entry_are_next_to_the_list(folder: Path) -> None:
    playlist = read_playlist(written(folder, "scene = 'truck'\nfile = 'truck.ply'\nseconds = 2"), ContentSettings())
    assert playlist.entries[0].file == str(folder / "truck.ply")
