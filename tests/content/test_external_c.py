"""The C library beside the Python client: its example compiled and run against the source, and servers that lie."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from runtime.config import ContentSettings
from runtime.content.camera import project
from runtime.content.external import ExternalSource
from runtime.errors import ContentFailure
from runtime.optics.stack import PanelStack
from tests.content.conftest import panel_view

ROOT = Path(__file__).resolve().parents[2]
SOURCES = ("examples/external_squares.c", "runtime/content/external_client.c")
STRICT = ("-std=c11", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O1", "-g")
EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler (cc)")


@pytest.fixture(scope="module")
def squares(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example, with the sanitizers where the compiler has them."""
    program = tmp_path_factory.mktemp("c") / "squares"
    command = ["cc", *STRICT, "-Iruntime/content", *SOURCES, "-o", str(program)]
    checked = [*command, "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    for attempt in (checked, command):
        done = subprocess.run(attempt, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            return program
    pytest.fail(done.stderr)


@pytest.fixture
def stack() -> PanelStack:
    return PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 135)


@pytest.fixture
def source(tmp_path: Path, stack: PanelStack) -> Iterator[ExternalSource]:
    made = ExternalSource(ContentSettings(scene="external", external=str(tmp_path / "s")), stack=stack)
    yield made
    made.close()


def test_what_it_draws_is_seen_by_each_eye_where_it_belongs(
    squares: Path, source: ExternalSource, stack: PanelStack, tmp_path: Path
) -> None:
    pictures: list[np.ndarray] = []
    with subprocess.Popen([squares, tmp_path / "s"], stderr=subprocess.PIPE, text=True) as client:
        time_ns = 0
        while client.poll() is None and source._arrived < 3:
            time_ns += 1_000_000
            try:
                source.revision(time_ns=time_ns)
                pictures = [
                    source.render(panel_view(eye, stack.panel(1), side=side), time_ns=time_ns).copy()
                    for side, eye in enumerate(EYES)
                ]
            except ContentFailure:
                pass
        assert source._arrived >= 3, client.communicate()[1]
        source.close()  # it leaves when the daemon does, without an error
        assert client.wait(timeout=20) == 0, client.communicate()[1]
    for (eye, picture), near in zip(zip(EYES, pictures, strict=True), [(220, 60, 40)] * 2, strict=True):
        place = project(panel_view(eye, stack.panel(1)).pixels_from_stack, np.array([[0.05, 0.10, 0.0]]))[0][0]
        rows, columns = np.nonzero((picture[..., :3] == near).all(2))
        assert columns.mean() + 0.5 == pytest.approx(place[0], abs=1)
        assert rows.mean() + 0.5 == pytest.approx(place[1], abs=1)
        assert (picture[0, 0] == (255, 255, 255, 0)).all()


def test_without_a_daemon_it_says_so(squares: Path, tmp_path: Path) -> None:
    done = subprocess.run([squares, tmp_path / "nobody"], capture_output=True, text=True, timeout=20, check=False)
    assert done.returncode == 1 and done.stderr == "squares: No such file or directory\n"


HELLO = {
    "phasestack_content": 1, "width_px": 8, "height_px": 8, "bytes": 12288, "first_slot": 4096, "slots": 1,
    "slot_bytes": 8192, "pixels": 4096,
}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"phasestack_content": 2}, "no phasestack content socket, or busy"),
        ({"width_px": 65536, "height_px": 65536}, "its memory does not hold what it says"),
        ({"bytes": 1 << 30}, "its memory does not hold what it says"),
        ({"slots": 9}, "its memory does not hold what it says"),
        ({"first_slot": 1 << 50}, "its memory does not hold what it says"),
        ({"slot_bytes": 1 << 62}, "its memory does not hold what it says"),
        ({"width_px": -1}, "no phasestack content socket, or busy"),
        ({"error": "busy", "phasestack_content": "x"}, "no phasestack content socket, or busy"),
    ],
)
def test_a_server_that_promises_what_it_does_not_hold_is_refused(
    squares: Path, tmp_path: Path, change: dict[str, object], told: str
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen(1)

        def serve() -> None:
            client, _ = listening.accept()
            memory = os.memfd_create("test")
            os.ftruncate(memory, 12288)
            with client:
                socket.send_fds(client, [json.dumps(HELLO | change).encode() + b"\n"], [memory])
                client.recv(1)
            os.close(memory)

        serving = threading.Thread(target=serve, daemon=True)
        serving.start()
        done = subprocess.run([squares, tmp_path / "s"], capture_output=True, text=True, timeout=30, check=False)
        serving.join()
    assert done.returncode == 1 and done.stderr == f"squares: {told}\n"


def test_a_request_of_nonsense_ends_it_without_harm(squares: Path, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen(1)
        with subprocess.Popen([squares, tmp_path / "s"], stderr=subprocess.PIPE, text=True) as client:
            channel, _ = listening.accept()
            memory = os.memfd_create("test")
            os.ftruncate(memory, 12288)
            with channel:
                socket.send_fds(channel, [json.dumps(HELLO).encode() + b"\n"], [memory])
                channel.sendall(b'{"request": 1, "time_ns": 2, "eyes_m": [[0.6, ' + b"9" * 300 + b"]]}\n")
                assert client.wait(timeout=20) == 1
            os.close(memory)
            assert client.communicate()[1] == ""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler")
def test_the_header_is_one_of_cpp_too(tmp_path: Path) -> None:
    (tmp_path / "a.cpp").write_text('#include "external_client.h"\nint main() { return ps_open ? 0 : 1; }\n')
    command = ["c++", "-Wall", "-Wno-address", "-fsyntax-only", f"-I{ROOT}/runtime/content", "a.cpp"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
