"""Live pictures: the newest one for both eyes; a source that ends, stalls, changes its size or lies is told."""

from __future__ import annotations

import logging
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import MonotonicClock
from runtime.config import ContentSettings
from runtime.content import stream
from runtime.content.base import ContentSource
from runtime.content.registry import open_content, prepare_content
from runtime.errors import ContentFailure, InputError, MissingPart
from runtime.optics.stack import PanelStack
from runtime.support.plugins import located
from tests.content.conftest import panel_view
from tests.waiting import eventually

pytest.importorskip("av")
from tests.content.streams import served, transport_stream

EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))
CLOCK = MonotonicClock()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(stream, "STALLED_S", 0.5)
    monkeypatch.setattr(stream, "AGAIN_S", 0.1)


def opened(name: str, context: Any, stack: PanelStack, **settings: Any) -> Any:
    settings = {"layout": "side-by-side"} | settings
    return open_content(ContentSettings(scene=name, **settings), stack, context)


def seen(source: ContentSource, stack: PanelStack) -> list[list[int]]:
    """The middle pixel of both eyes' pictures of one frame."""
    time_ns = CLOCK.now_ns()
    source.revision(time_ns=time_ns)
    return [
        source.render(panel_view(EYES[side], stack.panel(1), side=side), time_ns=time_ns)[
            stack.height_px // 2, stack.width_px // 2, :3
        ].tolist()
        for side in (0, 1)
    ]


def level(source: ContentSource, stack: PanelStack) -> int:
    return seen(source, stack)[0][1]


def test_each_eye_gets_its_half_of_one_picture(context: Any, stack: PanelStack) -> None:
    levels = set()
    with served(transport_stream(200)) as server:
        source = opened(server.url, context, stack)

        def moves() -> bool:
            left, right = seen(source, stack)
            assert left[0] > 150 and left[2] < 60 and right[2] > 150 and right[0] < 60
            assert abs(left[1] - right[1]) < 12  # one picture
            levels.add(left[1] // 8)
            return len(levels) >= 4

        assert source.info.moving and eventually(moves, within_s=20)
        assert source.problem == ""
        source.close()


def test_a_stream_that_stalls_and_ends_keeps_its_last_picture_and_is_taken_up_again(
    context: Any, stack: PanelStack, caplog: pytest.LogCaptureFixture
) -> None:
    with served(transport_stream(500)) as server, caplog.at_level(logging.WARNING, "phasestack.content"):
        source = opened(server.url, context, stack)
        first = level(source, stack)
        assert eventually(lambda: level(source, stack) != first, within_s=20)
        server.hold.set()
        assert eventually(lambda: "no new picture for" in source.problem, within_s=20)
        held = seen(source, stack)
        assert held[0][0] > 150 and seen(source, stack) == held  # the last good one
        server.hold.clear()
        assert eventually(lambda: bool(seen(source, stack)) and source.problem == "", within_s=20)
        server.hang_up.set()
        assert eventually(lambda: server.connections >= 2, within_s=20)
        assert seen(source, stack)[0][0] > 150
        assert eventually(lambda: bool(seen(source, stack)) and source.problem == "", within_s=20)
        source.close()
    told = [record.getMessage() for record in caplog.records]
    assert sum("the last picture stays" in line for line in told) == 1
    assert all("\n" not in line and server.url in line for line in told)


def test_a_stream_that_changes_its_size_goes_on(context: Any, stack: PanelStack) -> None:
    data = transport_stream(60) + transport_stream(400, size=(320, 48), first=60)
    with served(data) as server:
        source = opened(server.url, context, stack)
        seen(source, stack)
        shape = source._views[0].shape

        def changed() -> bool:
            seen(source, stack)
            return source._views[0].shape == (48, 160, 4) != shape

        assert eventually(changed, within_s=30)
        assert seen(source, stack)[1][2] > 150
        source.close()


def test_one_that_is_not_there_yet_is_waited_for(context: Any, stack: PanelStack, monkeypatch: Any) -> None:
    monkeypatch.setattr(stream, "FIRST_PICTURE_S", 0.3)
    with served(b"") as server:
        url = server.url
    source = opened(url, context, stack)
    with pytest.raises(ContentFailure, match=r"127\.0\.0\.1"):
        seen(source, stack)
    assert "it is tried again" in source.problem
    source.close()


def test_a_password_is_in_no_name_and_no_log(context: Any, stack: PanelStack, monkeypatch: Any) -> None:
    monkeypatch.setattr(stream, "FIRST_PICTURE_S", 0.3)
    source = opened("rtsp://operator:secret@127.0.0.1:9/door", context, stack)
    assert eventually(lambda: "tried again" in source.problem)
    assert source.info.name == "rtsp://127.0.0.1:9/door" and "secret" not in source.problem
    source.close()


@pytest.mark.parametrize(
    ("name", "settings", "told"),
    [
        ("live:film.mp4", {}, "content: scene: `live:` is gone: a film plays by its own name, film.mp4"),
        ("gopher://x", {}, "content: scene: gopher:// is none of rtsp"),
        ("file:///etc/passwd", {}, "content: scene: file:// is none of"),
        ("tcp://0.0.0.0:9/?listen=1", {}, "content: scene: an address that others may send to is not opened"),
        ("srt://:9?latency=2&mode=listener", {}, "content: scene: an address that others may send to is not opened"),
        ("rtsp://127.0.0.1:9/x", {"layout": "rgbd"}, "content: layout: rgbd is not for live pictures"),
    ],
)
def test_what_is_no_live_source_is_one_line(
    context: Any, stack: PanelStack, name: str, settings: dict[str, Any], told: str
) -> None:
    with pytest.raises(InputError) as refused:
        opened(name, context, stack, **settings)
    assert told in str(refused.value)


def test_without_the_extra_the_line_says_what_to_install(
    context: Any, stack: PanelStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingPart, match=r"pip install av"):
        opened("tcp://127.0.0.1:9", context, stack)


def test_a_scene_that_is_dropped_while_it_loads_ends_its_thread(stack: PanelStack) -> None:
    with served(transport_stream(200)) as server:
        opener = prepare_content(ContentSettings(scene=server.url), stack)
        assert any(thread.name == "stream" for thread in threading.enumerate())
        del opener
        assert eventually(lambda: not any(thread.name == "stream" for thread in threading.enumerate()), within_s=20)


def test_names_of_live_scenes_are_no_paths(tmp_path: Path) -> None:
    assert located("rtsp://host/a.mkv", tmp_path) == "rtsp://host/a.mkv"
    assert located("/dev/video0", tmp_path) == "/dev/video0"
