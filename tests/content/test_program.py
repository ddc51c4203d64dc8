"""Tests `scene = "program"` with a real client and connection."""

from __future__ import annotations

import io
import json
import os
import re
import resource
import shutil
import socket as sockets
import struct
import subprocess
import sys
import threading
import time
from base64 import b64encode
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from runtime.config import ContentSettings, StackGeometry
from runtime.content import program_link, program_server
from runtime.content.placed import Placing, placed_source
from runtime.content.program import camera_of, nearness_of
from runtime.content.program_link import ProgramLink
from runtime.content.program_serving import Serving
from runtime.content.registry import open_content
from runtime.daemon.programs import Programs
from runtime.errors import ContentFailure, InputError
from runtime.optics.views import image_from_stack
from runtime.plan.drawing import raster_views, retina_pictures, retina_view
from runtime.support.channel import Channel
from tests.browser.test_viewer import needs_chromium
from tests.waiting import eventually

STACK = replace(StackGeometry().stack(), width_px=64, height_px=36)
EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def source() -> Iterator[Any]:
    made = open_content(ContentSettings(scene="program"), STACK, None)
    yield made
    made.close()


@pytest.fixture(params=["here", "elsewhere"])
def either(request: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A source whose server is in this process, or in one of its own as in a run on the real clock."""
    if request.param == "here":
        yield request.getfixturevalue("source")
        return
    programs = Programs()
    channel = Channel.of(os.dup(programs.descriptor))
    monkeypatch.setattr(program_link, "_link", ProgramLink(channel))
    made = open_content(ContentSettings(scene="program"), STACK, None)
    yield made
    made.close()
    channel.close()
    programs.close()


def picture_of(asked: dict, eye: dict) -> bytes:
    """Red encodes the eye, green the row (from above)."""
    picture = np.zeros((asked["height"], asked["width"], 4), np.uint8)
    picture[..., 0] = 200 if eye["eye"] == "left" else 100
    picture[..., 1] = np.arange(asked["height"])[:, None]
    picture[..., 3] = 255
    return picture.tobytes()


class Program:
    """Answers as instructed, on a separate thread."""

    def __init__(self, source: Any, answer: Callable[..., bytes | None] = picture_of, **hello: Any) -> None:
        self.asked: list[dict] = []
        self.paths: list[str] = []  # of memory that is shared
        self.memory: Any = None  # mapped by `shares`
        self.ended = threading.Event()
        self._begun = threading.Event()
        self._shares = hello.pop("shares", False)  # writes its pictures to shared memory, and sends only their heads
        self._address, self._answer = source.program["address"], answer
        self._hello = hello | ({"memory": True} if self._shares else {})
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._begun.wait(10)

    def _run(self) -> None:
        with connect(self._address, max_size=None, compression=None) as self.socket:
            self.socket.send(json.dumps({"name": "test"} | self._hello))
            time.sleep(0.1)
            self._begun.set()
            try:
                for message in self.socket:
                    asked = json.loads(message)
                    if "memory" in asked:
                        self.paths.append(asked["memory"]["path"])
                        self.memory = np.memmap(self.paths[-1], np.uint8, "r+") if self._shares else None
                        continue
                    self.asked.append(asked)
                    for side, eye in enumerate(asked["eyes"]):
                        answer = self._answer(asked, eye)
                        if answer is not None and self._shares:
                            self.memory[eye["at"] : eye["at"] + len(answer)] = np.frombuffer(answer, np.uint8)
                            answer = b""
                        if answer is not None:
                            self.socket.send(struct.pack("<II", asked["frame"], side) + answer)
            except ConnectionClosed:
                pass
        self.ended.set()

    def end(self) -> None:
        self.socket.close()
        self._thread.join(10)


def drawn(source: Any, time_ns: int = 0) -> tuple[np.ndarray, np.ndarray]:
    left, right = retina_pictures(source, EYES, STACK, fov_deg=40, time_ns=time_ns)
    return left, right


def closing(socket: Any) -> tuple[int, str]:
    """The code and the reason with which a connection is closed."""
    with pytest.raises(ConnectionClosed) as told:
        while True:
            socket.recv(10)
    assert told.value.rcvd is not None
    return told.value.rcvd.code, told.value.rcvd.reason


def test_both_eyes_are_asked_for_at_once_and_get_their_own_picture(either: Any) -> None:
    program = Program(either)
    left, right = drawn(either, time_ns=1_500_000_000)
    (asked,) = program.asked
    assert either.info.moving and either.info.fixed_views
    assert (asked["width"], asked["height"], asked["time_s"]) == (64, 36, 1.5)
    assert [eye["eye"] for eye in asked["eyes"]] == ["left", "right"]
    assert (left[..., 0] == 200).all() and (right[..., 0] == 100).all() and (left[:, 5, 1] == np.arange(36)).all()
    assert 0 < either.program["frame_ms"] < 400 and either.problem == ""
    program.end()


def test_the_newest_state_is_told_last_and_a_lost_one_again() -> None:
    """Threads that wait for pictures tell it as well as the one that takes instructions."""
    sending, sent = threading.Event(), []

    class Slow(Channel):
        def send(self, message: Any, *, timeout_s: float = 0.0) -> bool:
            if message.frame_ms is None:
                sending.set()
                eventually(lambda: 5.0 in sent, within_s=0.3)  # if another state can be sent meanwhile
            sent.append(message.frame_ms)
            return sent.count(5.0) != 1  # lost, because too many are unread

    class Server:
        problem, frame_ms = "", None

    ours, theirs = sockets.socketpair()
    channel, server = Slow.of(ours.detach()), Server()
    serving = Serving(channel, "token")
    telling = threading.Thread(target=serving._tell, args=(0, server))
    telling.start()
    assert sending.wait(60)
    server.frame_ms = 5.0
    for _ in range(3):
        serving._tell(0, server)
    telling.join(60)
    assert sent == [None, 5.0, 5.0]
    channel.close()
    theirs.close()


def test_rows_may_come_from_below_as_opengl_reads_them(source: Any) -> None:
    program = Program(source, rows="bottom-up")
    assert (drawn(source)[0][:, 5, 1] == np.arange(36)[::-1]).all()
    program.end()


@pytest.mark.parametrize("placed", [False, True])
def test_matrices_put_points_where_the_view_has_them(source: Any, placed: bool) -> None:
    points = np.random.default_rng(1).uniform(-0.05, 0.05, (20, 3))
    views = [*raster_views(EYES, STACK.panel(0)), retina_view(EYES[1], 1, width_px=64, height_px=36, fov_deg=40)]
    if placed:
        moved: Any = placed_source(source, Placing(2.0, (0.01, 0.02, 0.03)))
        views = [moved.forwarded(view, 0)[1] for view in views]
    for view in views:
        told = camera_of(view)
        look, projection = (np.reshape(told[name], (4, 4)).T for name in ("view", "projection"))
        np.testing.assert_allclose(look[:3, :3] @ look[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(look[:3, :3]) == pytest.approx(1)
        np.testing.assert_allclose(look @ [*view.eye_m, 1], [0, 0, 0, 1], atol=1e-12)
        clip = projection @ look @ np.column_stack([points, np.ones(20)]).T
        seen = view.pixels_from_stack @ np.column_stack([points, np.ones(20)]).T
        np.testing.assert_allclose((clip[0] / clip[3] + 1) / 2 * 64, seen[0] / seen[2], atol=1e-9)
        np.testing.assert_allclose((1 - clip[1] / clip[3]) / 2 * 36, seen[1] / seen[2], atol=1e-9)
        assert (np.abs(clip[2] / clip[3]) < 1).all()


def test_without_a_program_the_state_says_where_one_may_connect(either: Any) -> None:
    with pytest.raises(ContentFailure, match="no program is connected; `phasestack status` shows the address"):
        drawn(either)


def test_a_silent_program_is_late_and_gets_at_most_two_requests(either: Any) -> None:
    program = Program(either, lambda asked, eye: None)
    for _ in range(2):
        with pytest.raises(ContentFailure, match="not answer within 400 ms"):
            drawn(either)
    with pytest.raises(ContentFailure, match="late: 2 requests"):
        drawn(either)
    assert len(program.asked) == 2
    time.sleep(2.1)
    with pytest.raises(ContentFailure, match="not answer within"):
        drawn(either)
    assert len(program.asked) == 3
    program.end()


def test_what_comes_late_is_left_and_the_next_is_right(source: Any) -> None:
    late = [0.3, 0.3]
    program = Program(source, lambda asked, eye: time.sleep(late.pop() if late else 0) or picture_of(asked, eye))
    with pytest.raises(ContentFailure):
        drawn(source)
    assert eventually(lambda: program.asked[-1]["frame"] > 1 or _draws(source))
    assert (drawn(source)[1][..., 0] == 100).all()
    program.end()


def _draws(source: Any) -> bool:
    try:
        return len(drawn(source)) == 2
    except ContentFailure:
        return False


def test_a_program_with_the_wrong_size_is_told_why_and_may_return(either: Any) -> None:
    program = Program(either, lambda asked, eye: b"x" * 100)
    with pytest.raises(ContentFailure, match="100 bytes, which is not 64x36"):
        drawn(either)
    assert program.ended.wait(10) and "100 bytes" in either.problem
    again = Program(either)
    assert drawn(either)[0].shape == (36, 64, 3) and either.problem == ""
    again.end()
    assert eventually(lambda: either.problem == "the program closed the connection")


@pytest.mark.parametrize(
    ("head", "size_bytes", "why"),
    [
        ((0,), 4 * 128 * 72, "the answer has 36864 bytes, which is not 64x36 RGBA pixels"),
        ((2,), 4 * 64 * 36, "the answer is for eye 2; the left eye is 0 and the right eye is 1"),
        ((), 0, "the answer is not a picture"),
    ],
)
def test_a_program_is_told_by_the_close_message_what_was_wrong(
    source: Any, head: tuple[int, ...], size_bytes: int, why: str
) -> None:
    with connect(source.program["address"], max_size=None, compression=None) as socket:
        socket.send(json.dumps({"name": "test"}))
        asking = threading.Thread(target=lambda: eventually(lambda: _draws(source) or bool(source.problem)))
        asking.start()
        frame = json.loads(socket.recv(10))["frame"]
        socket.send(struct.pack(f"<{1 + len(head)}I", frame, *head) + bytes(size_bytes))
        assert closing(socket) == (1007, why)
    asking.join()
    assert source.problem == why


def test_a_picture_that_was_not_asked_for_is_left(source: Any) -> None:
    program = Program(source, lambda asked, eye: picture_of(asked, eye) if eye["eye"] == "left" else None)
    view = raster_views(EYES, STACK.panel(0))[1]
    source.expect([view], time_ns=0)
    with pytest.raises(ContentFailure, match="did not answer"):  # it answers for the left eye
        source.render(view, time_ns=0)
    program.end()


def test_a_view_that_was_not_announced_is_asked_for(source: Any) -> None:
    program = Program(source)
    before, after = (raster_views(EYES + shift, STACK.panel(0))[0] for shift in (0.0, 0.01))
    source.expect([before], time_ns=0)
    for view in (before, after, after):
        source.render(view, time_ns=0)
    assert [asked["eyes"][0]["eye_m"] for asked in program.asked] == [before.eye_m.tolist(), after.eye_m.tolist()]
    program.end()


def test_eyes_numbered_from_one_are_told_while_one_eye_is_asked_for(source: Any) -> None:
    """Of one eye, 1 instead of 0 is no number that cannot be."""
    view = raster_views(EYES, STACK.panel(0))[0]
    with connect(source.program["address"], max_size=None, compression=None) as socket:
        socket.send(json.dumps({"name": "test"}))
        time.sleep(0.1)
        with pytest.raises(ConnectionClosed) as told:
            for _ in range(4):
                with suppress(ContentFailure):
                    source.expect([view], time_ns=0)
                socket.send(struct.pack("<II", json.loads(socket.recv(10))["frame"], 1) + bytes(4 * 64 * 36))
    assert told.value.rcvd is not None and told.value.rcvd.reason == (
        "the answer is for eye 1; the left eye is 0 and the right eye is 1"
    )


class Silent:
    """A client that has a small buffer and reads only when it is told to."""

    def __init__(self, source: Any) -> None:
        parts = urlsplit(source.program["address"])
        self._socket = sockets.socket()
        self._socket.setsockopt(sockets.SOL_SOCKET, sockets.SO_RCVBUF, 2048)
        self._socket.settimeout(10)
        self._socket.connect((parts.hostname, parts.port))
        head = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13"
        key = b64encode(bytes(16)).decode()
        request = f"GET /?{parts.query} HTTP/1.1\r\nHost: x\r\n{head}\r\nSec-WebSocket-Key: {key}\r\n\r\n"
        self._socket.sendall(request.encode())
        self.received = b""
        while b"\r\n\r\n" not in self.received:
            self.received += self._socket.recv(1)

    def say(self, hello: str) -> None:
        self._socket.sendall(bytes([0x81, 0x80 | len(hello), 0, 0, 0, 0]) + hello.encode())  # masked by zeros

    def frames_read(self) -> list[int]:
        with suppress(TimeoutError):
            self._socket.settimeout(1)
            while data := self._socket.recv(1 << 20):
                self.received += data
        return [int(number) for number in re.findall(rb'"frame": (\d+)', self.received)]

    def close(self) -> None:
        self._socket.close()


@pytest.mark.slow
def test_a_listener_that_reads_nothing_loses_only_its_own_messages(source: Any) -> None:
    listener, program = Silent(source), Program(source)
    listener.say('{"listens": true}')
    for _ in range(4000):  # 6 MB of requests, more than the system buffers
        assert len(drawn(source)) == 2
    numbers = listener.frames_read()
    assert numbers == sorted(numbers) and len(numbers) < 3900 and numbers[-1] == program.asked[-1]["frame"]
    listener.close()
    program.end()


def test_many_connections_without_a_handshake_keep_nobody_out(source: Any) -> None:
    port, before = urlsplit(source.program["address"]).port, threading.active_count()
    idle = [sockets.create_connection(("127.0.0.1", port)) for _ in range(300)]
    assert eventually(lambda: sum(is_closed(one) for one in idle) >= 300 - 16)
    assert threading.active_count() <= before
    program = Program(source)
    assert len(drawn(source)) == 2
    program.end()
    for one in idle:
        one.close()


def is_closed(socket: sockets.socket) -> bool:
    socket.setblocking(False)
    try:
        return socket.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def test_connections_are_accepted_again_after_too_many_open_files(source: Any, caplog: Any) -> None:
    client = sockets.socket()
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    with caplog.at_level("ERROR", logger="asyncio"):
        resource.setrlimit(resource.RLIMIT_NOFILE, (client.fileno() + 1, limits[1]))
        taken = []
        try:
            with suppress(OSError):
                while True:
                    taken.append(os.dup(0))
            client.connect(("127.0.0.1", urlsplit(source.program["address"]).port))
            assert eventually(lambda: "out of system resource" in caplog.text)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
            for file in taken:
                os.close(file)
    client.close()
    program = Program(source)
    assert len(drawn(source)) == 2
    program.end()


def test_the_address_stays_the_same_when_the_scene_is_opened_again(source: Any) -> None:
    address, program = source.program["address"], Program(source)
    again = open_content(ContentSettings(scene="program"), STACK, None)  # as a reload does, before it closes the first
    source.close()
    assert again.program is not None and again.program["address"] == address
    assert len(drawn(again)) == 2
    again.close()
    assert program.ended.wait(10)
    later = open_content(ContentSettings(scene="program"), STACK, None)
    assert later.program is not None and later.program["address"] == address
    later.close()


def test_the_newest_program_draws(source: Any) -> None:
    first, second = Program(source), Program(source, lambda asked, eye: b"\x07" * (4 * 64 * 36))
    assert first.ended.wait(10)
    assert (drawn(source)[0] == 7).all()
    second.end()


def test_who_listens_is_told_of_the_eyes_and_asked_for_nothing(source: Any) -> None:
    listener, program = Program(source, lambda asked, eye: None, listens=True), Program(source)
    drawn(source)
    assert eventually(lambda: len(listener.asked) == 1)
    assert [eye["eye_m"] for eye in listener.asked[0]["eyes"]] == EYES.tolist()
    program.end()
    listener.end()


def test_a_program_may_draw_smaller_pictures(source: Any) -> None:
    program = Program(source, scale=0.5)
    left, right = drawn(source)
    assert (program.asked[0]["width"], program.asked[0]["height"]) == (32, 18)
    assert left.shape == right.shape == (36, 64, 3) and (left[..., 0] == 200).all() and (right[..., 0] == 100).all()
    program.end()


def jpeg_of(asked: dict, eye: dict) -> bytes:
    """Red encodes the eye in the upper half; the lower half is black."""
    picture = np.zeros((asked["height"], asked["width"], 3), np.uint8)
    picture[: asked["height"] // 2, :, 0] = 200 if eye["eye"] == "left" else 100
    coded = io.BytesIO()
    Image.fromarray(picture).save(coded, "JPEG", quality=95)
    return coded.getvalue()


def test_pictures_may_be_encoded_as_jpeg(either: Any) -> None:
    program = Program(either, jpeg_of, encoding="jpeg")
    for picture, red in zip(drawn(either), (200, 100)):
        assert np.abs(picture[2:14].astype(int) - [red, 0, 0]).max() < 8 and picture[22:].max() < 8
    program.end()


def test_a_jpeg_may_be_followed_by_depth(source: Any) -> None:
    depth = np.zeros((36, 64), "<u2")
    depth[18:] = 65535
    program = Program(
        source,
        lambda asked, eye: jpeg_of(asked, eye) + depth.tobytes(),
        encoding="jpeg",
        depth="uint16",
        rows="bottom-up",
    )
    view = raster_views(EYES, STACK.panel(0))[0]
    assert source.render(view, time_ns=0)[20:34, :, 0].min() > 190
    nearness = source.nearness(view, every=4, first=(0, 0))
    assert (nearness[:4] == 0).all() and (nearness[5:] > 1).all()
    program.end()


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (b"x" * 100, "the answer is not a JPEG picture"),
        (jpeg_of({"width": 32, "height": 18}, {"eye": "left"}), "the answer is a picture of 32x18 pixels, not 64x36"),
        (jpeg_of({"width": 64, "height": 36}, {"eye": "left"})[:-200], "the answer is not a JPEG picture"),
    ],
)
def test_a_wrong_jpeg_is_answered_with_the_reason(source: Any, answer: bytes, why: str) -> None:
    program = Program(source, lambda asked, eye: answer, encoding="jpeg")
    with pytest.raises(ContentFailure, match=why):
        drawn(source)
    assert program.ended.wait(10)


def plane_and_background(asked: dict, eye: dict, dtype: str) -> bytes:
    """The panels' plane x = 0 in front of the background, at the left; rows at the top are nearer by 0.2 m."""
    width, height = asked["width"], asked["height"]
    look, projection = (np.reshape(eye[name], (4, 4)).T for name in ("view", "projection"))
    depth = np.ones((height, width))
    for row in range(height):
        clip = projection @ look @ [0.2 if row < height // 2 else 0.0, 0.0, 0.0, 1.0]
        depth[row, : width // 2] = (clip[2] / clip[3] + 1) / 2
    farthest = 65535 if dtype == "uint16" else 1
    return picture_of(asked, eye) + (depth * farthest).astype(dtype).tobytes()


@pytest.mark.parametrize("dtype", ["uint16", "float32"])
@pytest.mark.parametrize("scale", [1, 0.5])
@pytest.mark.parametrize("first", [(0, 0), (1, 2)])
def test_a_program_may_send_depth(source: Any, dtype: str, scale: float, first: tuple[int, int]) -> None:
    program = Program(source, partial(plane_and_background, dtype=dtype), depth=dtype, scale=scale)
    views = raster_views(EYES, STACK.panel(0))
    assert source.nearness(views[0], every=4, first=first) is None
    source.expect(views, time_ns=0)
    for view in views:
        source.render(view, time_ns=0)
        nearness = source.nearness(view, every=4, first=first)
        assert nearness.shape == (-(-(36 + first[1]) // 4), -(-(64 + first[0]) // 4))
        np.testing.assert_allclose(nearness[:4, :7], 1 / 0.4, rtol=1e-3)
        np.testing.assert_allclose(nearness[6:9, :7], 1 / 0.6, rtol=1e-3)
        assert (nearness[:, 9:] == 0).all()
    program.end()


def test_depths_from_the_near_to_the_far_plane_are_inverse_distances() -> None:
    depth = np.array([[0.0, 0.5, 1.0, -0.1]], np.float32)
    np.testing.assert_allclose(nearness_of(depth, every=1, first=(0, 0)), [[20.0, 10.005, 0.0, 0.0]], rtol=1e-6)


def test_a_program_on_the_same_machine_may_share_memory(either: Any) -> None:
    program = Program(either, shares=True)
    for _ in range(10):
        left, right = drawn(either)
        assert (left[..., 0] == 200).all() and (right[..., 0] == 100).all()
    assert len({eye["at"] for asked in program.asked for eye in asked["eyes"]}) == 8  # four frames of two pictures
    larger = raster_views(EYES, replace(STACK, width_px=128, height_px=72).panel(0))
    either.expect(larger, time_ns=0)
    assert (either.render(larger[1], time_ns=0)[..., 0] == 100).all()
    assert len(program.paths) == 2
    program.end()
    either.close()
    del program.memory  # the client's own mapping
    assert eventually(lambda: open_memories() == 0)


@pytest.mark.parametrize("shares", [False, True])
def test_pictures_stay_while_smaller_ones_of_later_frames_arrive(either: Any, shares: bool) -> None:
    program = Program(either, shares=shares)

    def right_picture(width_px: int, height_px: int) -> np.ndarray:
        views = raster_views(EYES, replace(STACK, width_px=width_px, height_px=height_px).panel(0))
        either.expect(views, time_ns=0)
        return either.render(views[1], time_ns=0)

    for _ in range(program_server.SLOTS):
        kept = right_picture(64, 36)
    for _ in range(2):
        right_picture(60, 34)
    assert (kept[..., 0] == 100).all() and (kept[:, 5, 1] == np.arange(36)).all()
    program.end()


def open_memories() -> int:
    number = 0
    for one in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            number += str(one.readlink()).startswith("/memfd:phasestack-program")
    return number


def test_shared_memory_cannot_be_cut_off(source: Any) -> None:
    program = Program(source, shares=True)
    drawn(source)
    with Path(program.paths[0]).open("r+b") as memory, pytest.raises(PermissionError):
        os.ftruncate(memory.fileno(), 0)
    program.end()


def test_a_program_that_cannot_open_the_memory_sends_its_pictures(source: Any) -> None:
    program = Program(source, memory=True)
    assert (drawn(source)[1][..., 0] == 100).all()
    program.end()


@pytest.mark.parametrize(
    ("hello", "why"),
    [
        ('{"scale": 0}', "scale must be a number from 0.1 to 1"),
        ('{"depth": "int8"}', "depth must be uint16 or float32"),
        ('{"encoding": "png"}', "encoding must be raw or jpeg"),
        ('{"rows": "bottomup"}', "rows must be top-down or bottom-up"),
        ('{"listens": "false"}', "listens must be true or false"),
        ('{"memory": 1}', "memory must be true or false"),
        ("{", "the first message: malformed JSON"),
        ("[]", "the first message is not a JSON object"),
        (b"\xff", "the first message: is not valid UTF-8"),
        ("[" * 50_000, "the first message: the JSON is nested"),
        (None, "no first message within 0.2 s"),
    ],
)
def test_who_begins_with_nonsense_or_silence_is_sent_away(
    source: Any, monkeypatch: pytest.MonkeyPatch, hello: str | bytes | None, why: str
) -> None:
    if hello is None:
        monkeypatch.setattr(program_server, "HELLO_S", 0.2)
    with connect(source.program["address"]) as socket:
        if hello is not None:
            socket.send(hello)
        code, reason = closing(socket)
    assert code == 1007 and reason.startswith(why)
    with pytest.raises(ContentFailure, match="no program is connected"):
        drawn(source)


def test_a_client_that_insists_on_a_subprotocol_gets_its_first(source: Any) -> None:
    with connect(source.program["address"], subprotocols=[Subprotocol("chat"), Subprotocol("3d")]) as socket:
        assert socket.subprotocol == "chat"


def test_without_the_token_nobody_connects(source: Any) -> None:
    address = source.program["address"].partition("?")[0]
    with pytest.raises(InvalidStatus), connect(address):
        pass


def test_a_port_that_is_taken_is_refused(source: Any) -> None:
    port = int(source.program["address"].partition("127.0.0.1:")[2].partition("/")[0])
    with pytest.raises(InputError, match=f"port: cannot listen on port {port}"):
        open_content(ContentSettings(scene="program", options={"port": port}), STACK, None)
    with pytest.raises(InputError, match=r"content\.options: port: "):
        open_content(ContentSettings(scene="program", options={"port": 65536}), STACK, None)


def test_the_example_draws_a_cube_for_each_eye(source: Any) -> None:
    command = [sys.executable, str(ROOT / "examples" / "program.py"), source.program["address"]]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert eventually(lambda: process.poll() is not None or _draws(source), within_s=60.0)
            left, right = drawn(source)
            projection = image_from_stack(EYES[0], width_px=64, height_px=36, fov_deg=40)
            u, v = (projection @ [0, 0, 0, 1])[:2] / (projection @ [0, 0, 0, 1])[2]
            assert (left[0, 0] > 220).all() and not (left[int(v), int(u)] > 220).all()
            assert np.abs(left.astype(int) - right).max() > 20
        finally:
            process.kill()


@pytest.mark.slow
def test_a_page_with_three_js_draws_a_knot_for_each_eye(source: Any, tmp_path: Path) -> None:
    needs_chromium()
    modules = Path(os.environ["NODE_PATH"])
    if not (modules / "three").is_dir():
        pytest.skip("three is needed in NODE_PATH")
    for name in ("three.html", "program.js"):
        shutil.copy(ROOT / "examples" / name, tmp_path)
    (tmp_path / "node_modules").symlink_to(modules)
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(SimpleHTTPRequestHandler, directory=tmp_path)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = f"http://127.0.0.1:{server.server_port}/three.html#{source.program['address']}"
        script = str(ROOT / "tests" / "browser" / "page.mjs")
        with subprocess.Popen(["node", script, page], stdin=subprocess.PIPE, text=True) as browser:
            try:
                assert eventually(lambda: browser.poll() is not None or _draws(source), within_s=120.0)
                left, right = (picture.astype(int) for picture in drawn(source))
            finally:
                browser.communicate("end")
        server.shutdown()
    reds = [(picture[..., 0] - picture[..., 1] > 60) for picture in (left, right)]
    assert all(50 < red.sum() < 1000 for red in reds) and (reds[0] != reds[1]).sum() > 5
    assert left[2, 2].tolist() == [0xDF, 0xE8, 0xF5]
