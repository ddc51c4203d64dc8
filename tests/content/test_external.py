"""Pictures from another process: real sockets, real shared memory, real processes, and clients that misbehave."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.external import FLAT_AFTER_NS, ExternalSource
from runtime.content.external_client import ExternalClient, Request
from runtime.errors import ContentFailure, InputError
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view

EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def small() -> PanelStack:
    return PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 64, 36)


@pytest.fixture
def source(tmp_path: Path, small: PanelStack) -> Iterator[ExternalSource]:
    made = ExternalSource(ContentSettings(scene="external", external=str(tmp_path / "content.sock")), stack=small)
    yield made
    made.close()


def client_of(source: ExternalSource, tmp_path: Path) -> ExternalClient:
    """Connect while the daemon's loop goes on turning."""
    import threading

    made: list[ExternalClient] = []
    thread = threading.Thread(target=lambda: made.append(ExternalClient(str(tmp_path / "content.sock"))))
    thread.start()
    while thread.is_alive():
        source.revision(time_ns=0)
        thread.join(0.005)
    return made[0]


def turn(source: ExternalSource, small: PanelStack, time_ns: int = 0) -> list[np.ndarray]:
    """One turn of the loop: what is new, then both eyes."""
    source.revision(time_ns=time_ns)
    return [source.render(panel_view(EYES[side], small.panel(1), side=side), time_ns=time_ns).copy() for side in (0, 1)]


def ask(source: ExternalSource, small: PanelStack, client: ExternalClient, time_ns: int = 0) -> Request:
    """The loop turns as the daemon's does, which gives a frame up at the first eye that fails, until it asks."""
    for _ in range(4):
        with contextlib.suppress(ContentFailure):
            turn(source, small, time_ns)
    request = client.wait()
    assert request is not None
    return request


def solid(value: int) -> np.ndarray:
    return np.full((36, 64, 4), (value, value, value, 255), np.uint8)


def test_pictures_arrive_for_the_eyes_that_were_asked_for(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        assert (client.width_px, client.height_px) == (64, 36)
        first = ask(source, small, client)
        assert first.eyes_m == pytest.approx(np.array([EYES[0], EYES[0]]))  # nothing to show yet: a flat one
        client.send(first, solid(10), solid(20))
        turn(source, small, 1)
        request = client.wait()
        assert request is not None
        assert request.eyes_m == pytest.approx(np.array(EYES))
        assert request.pixels_from_stack[1] == pytest.approx(panel_view(EYES[1], small.panel(1)).pixels_from_stack)
        before = source.revision(time_ns=0)
        client.send(request, solid(50), solid(200))
        assert source.revision(time_ns=0) != before
        left, right = turn(source, small)
        assert (left[..., :3] == 50).all()
        assert (right[..., :3] == 200).all()


def test_a_late_picture_is_warped_to_where_the_eye_is_now(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (36, 64, 4), np.uint8)
    with client_of(source, tmp_path) as client:
        client.send(ask(source, small, client), picture, picture)
        source.revision(time_ns=0)
        other_panel = source.render(panel_view(EYES[0], small.panel(0)), time_ns=0).copy()
        moved_eye = source.render(panel_view((0.5, 0.1, 0.05), small.panel(1)), time_ns=0)
    # On the centre panel a moved eye sees the same picture; on another panel it is elsewhere.
    assert (moved_eye == picture).all()
    assert (other_panel != picture).any()


def test_until_the_first_picture_the_loop_is_told_why(source: ExternalSource, small: PanelStack) -> None:
    with pytest.raises(ContentFailure, match="external: waiting for a client"):
        turn(source, small)


def test_a_client_that_is_slow_or_dies_leaves_its_last_picture_then_both_eyes_see_one(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    client = client_of(source, tmp_path)
    client.send(ask(source, small, client), solid(50), solid(200))
    turn(source, small)
    client.close()
    left, right = turn(source, small, NS_PER_S)
    assert source.status.startswith("the client is gone")
    assert (left[..., 0] == 50).all()
    assert (right[..., 0] == 200).all()
    left, right = turn(source, small, FLAT_AFTER_NS + 2)
    assert (left == right).all()
    with client_of(source, tmp_path) as again:
        request = ask(source, small, again, FLAT_AFTER_NS + 3)
        again.send(request, solid(60), solid(210))
        left, right = turn(source, small, FLAT_AFTER_NS + 4)
        assert (left[0, 0, 0], right[0, 0, 0]) == (60, 210)


def test_a_picture_that_is_being_written_is_never_shown(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        client.send(ask(source, small, client), solid(50), solid(200))
        turn(source, small)
        # The next one begins and its writer dies half way.
        start = client._first + (2 % client._slots) * client._slot_bytes
        client._memory[start : start + 8] = struct.pack("<Q", 2)
        client._memory[start + client._pixels : start + client._pixels + 100] = b"\xff" * 100
        left, right = turn(source, small)
        assert (left[..., 0] == 50).all()
        assert (right[..., 0] == 200).all()


@pytest.mark.parametrize("request_number", [0, 999999, 2**64 - 1])
def test_a_picture_that_nobody_asked_for_is_refused_and_counted(
    source: ExternalSource, small: PanelStack, tmp_path: Path, request_number: int
) -> None:
    with client_of(source, tmp_path) as client:
        request = ask(source, small, client)
        client.send(request, solid(50), solid(200))
        turn(source, small)
        other = Request(request_number, 0, request.eyes_m, request.pixels_from_stack)
        client.send(other, solid(1), solid(2))
        left, _ = turn(source, small)
        assert (left[..., 0] == 50).all()
        assert source.rejected == 1
        assert "no request of ours" in source.status


def test_noise_on_the_socket_and_in_the_memory_harms_nothing(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        client.send(ask(source, small, client), solid(50), solid(200))
        turn(source, small)
        client._socket.sendall(os.urandom(5000))
        random = np.random.default_rng(0)
        for _ in range(20):
            client._memory[:] = random.integers(0, 256, len(client._memory), np.uint8).tobytes()
            left, right = turn(source, small)
            assert (left[..., 0] == 50).all()
            assert (right[..., 0] == 200).all()


WRITER = """
import sys
import numpy as np
from runtime.content.external_client import ExternalClient

with ExternalClient(sys.argv[1]) as display:
    pictures = [np.full((display.height_px, display.width_px, 4), grey, np.uint8) for grey in range(256)]
    request = display.wait()
    display._socket.setblocking(False)
    count = 0
    while True:
        try:
            request = display.wait()
            if request is None:
                break
        except BlockingIOError:
            pass
        count += 1
        display.send(request, pictures[count % 256], pictures[count % 256])
"""


def test_a_writer_that_never_stops_and_is_killed_again_and_again_leaves_no_torn_picture(tmp_path: Path) -> None:
    """It overwrites its slots as fast as it can; each picture is of one grey, the same for both eyes."""
    display = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 640, 360)
    address = str(tmp_path / "content.sock")
    source = ExternalSource(ContentSettings(scene="external", external=address), stack=display)
    frames, levels = 0, set()
    try:
        for _ in range(3):
            writer = subprocess.Popen([sys.executable, "-c", WRITER, address], cwd=ROOT)
            arrived, deadline = source._arrived, time.monotonic() + 20
            try:
                while source._arrived < arrived + 15 and time.monotonic() < deadline:
                    now = time.monotonic_ns()
                    source.revision(time_ns=now)
                    pictures = []
                    for side, eye in enumerate(EYES):
                        try:
                            pictures.append(source.render(panel_view(eye, display.panel(1), side=side), time_ns=now))
                        except ContentFailure:
                            time.sleep(0.01)
                    if len(pictures) == 2:
                        frames += 1
                        assert (pictures[0] == pictures[0][0, 0]).all()
                        assert (pictures[1] == pictures[0][0, 0]).all()
                        levels.add(int(pictures[0][0, 0, 0]))
            finally:
                writer.kill()
                writer.wait()
            assert source._arrived >= arrived + 15
    finally:
        source.close()
    assert frames > 30
    assert len(levels) > 10


def test_a_picture_that_is_overwritten_while_it_is_copied_is_dropped(
    source: ExternalSource, small: PanelStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with client_of(source, tmp_path) as client:
        request = ask(source, small, client)
        client.send(request, solid(50), solid(60))
        turn(source, small, 1)
        client.send(request, solid(90), solid(91))
        looks: list[int] = []
        numbers = source._numbers

        def overtaken(slot: int) -> tuple[int, int, int]:
            looks.append(slot)
            if len(looks) == 3:  # both slots were looked at, one was copied, now comes the second look
                client.send(request, solid(100), solid(101))
                client.send(request, solid(110), solid(111))
            return numbers(slot)

        monkeypatch.setattr(source, "_numbers", overtaken)
        left, right = turn(source, small, 2)
        assert (left[0, 0, 0], right[0, 0, 0]) == (50, 60)
        assert source.rejected == 1
        left, right = turn(source, small, 3)
        assert (left[0, 0, 0], right[0, 0, 0]) == (110, 111)


def test_a_picture_that_arrives_between_the_eyes_waits_for_the_next_frame(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        request = ask(source, small, client)
        client.send(request, solid(50), solid(60))
        turn(source, small, 1)
        source.revision(time_ns=2)
        left = source.render(panel_view(EYES[0], small.panel(1), side=0), time_ns=2).copy()
        client.send(request, solid(150), solid(160))
        right = source.render(panel_view(EYES[1], small.panel(1), side=1), time_ns=2).copy()
        assert (left[0, 0, 0], right[0, 0, 0]) == (50, 60)
        left, right = turn(source, small, 3)
        assert (left[0, 0, 0], right[0, 0, 0]) == (150, 160)


def test_a_client_hears_of_every_frame_even_where_nothing_is_drawn(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    """A still viewer's frames are not drawn anew: a client that comes then must not wait for ever."""
    with client_of(source, tmp_path) as client:
        client.send(ask(source, small, client), solid(50), solid(60))
        turn(source, small, 1)
        client.wait()
    for time_ns in (2, 3):
        source.revision(time_ns=time_ns)
    with client_of(source, tmp_path) as client:
        for time_ns in (4, 5):
            source.revision(time_ns=time_ns)
        request = client.wait()
        assert request is not None
        assert request.eyes_m == pytest.approx(np.array(EYES))


def test_a_client_that_comes_while_only_the_flat_picture_is_drawn_is_asked_for_it(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        for time_ns in range(3):
            source.revision(time_ns=time_ns)
            with pytest.raises(ContentFailure):
                source.render(panel_view((0.6, 0.0, 0.0), small.panel(1)), time_ns=time_ns)
        request = client.wait()
        assert request is not None
        assert request.eyes_m == pytest.approx(np.array([(0.6, 0.0, 0.0)] * 2))


def test_the_memory_can_t_be_shrunk_under_the_daemon(source: ExternalSource) -> None:
    with pytest.raises(OSError, match="not permitted"):
        os.ftruncate(source._descriptor, 4096)


def test_a_client_that_never_reads_costs_the_loop_nothing(
    source: ExternalSource, small: PanelStack, tmp_path: Path
) -> None:
    with client_of(source, tmp_path) as client:
        client.send(ask(source, small, client), solid(50), solid(200))
        for _ in range(2000):
            left, _ = turn(source, small)
        assert (left[..., 0] == 50).all()


def test_a_second_client_is_told_that_it_is_one_too_many(source: ExternalSource, tmp_path: Path) -> None:
    with client_of(source, tmp_path), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as second:
        second.connect(str(tmp_path / "content.sock"))
        source.revision(time_ns=0)
        assert json.loads(second.recv(1000)) == {"error": "busy"}


def test_a_socket_that_can_t_be_made_is_one_line(small: PanelStack, source: ExternalSource, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"content: external: .*another daemon listens there"):
        ExternalSource(ContentSettings(external=str(tmp_path / "content.sock")), stack=small)
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="content: external: "):
        ExternalSource(ContentSettings(external=str(tmp_path / "file" / "content.sock")), stack=small)


def test_the_example_draws_for_a_running_daemon(source: ExternalSource, small: PanelStack, tmp_path: Path) -> None:
    """The example as a user starts it, in its own process; then it is killed in the middle of its work."""
    process = subprocess.Popen(
        [sys.executable, "examples/external_cube.py", "--socket", str(tmp_path / "content.sock")],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )
    pictures: list[np.ndarray] = []
    deadline = time.monotonic() + 20
    while len(pictures) < 30 and time.monotonic() < deadline and process.poll() is None:
        with contextlib.suppress(ContentFailure):
            pictures.append(turn(source, small, time.monotonic_ns())[1])
        time.sleep(0.005)
    process.kill()
    process.wait()
    assert len(pictures) == 30, process.stderr.read().decode() if process.stderr else ""
    if process.stderr:
        process.stderr.close()
    assert (pictures[0][..., 3] > 0).mean() > 0.02
    last = turn(source, small)
    assert last[0].shape == (36, 64, 4)
