"""Show video from a pipe: Y4M, as FFmpeg, GStreamer and mpv write it, or raw RGB."""

from __future__ import annotations

import os
import select
import stat
import subprocess
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av
import numpy as np
from pydantic import Field, model_validator

from runtime.config import Section, validated
from runtime.content.base import ContentSource
from runtime.content.live import Feed, LiveSource, end_group
from runtime.content.placing import SceneFile
from runtime.errors import InputError, one_line
from runtime.records import U8

LOOKS_EVERY_S = 0.1  # how often the end of the scene is looked for while no data arrives
AGAIN_S = 1.0  # pause before a command that ended is started again
HEADER_MAX = 1024  # longest line of a Y4M header, in bytes
SIZE_MAX_PX = 16384
FRAME_MAX_BYTES = 1 << 28
CHUNK_BYTES = 1 << 20
COLOURS = {"420": "yuv420p", "422": "yuv422p", "444": "yuv444p", "mono": "gray"}
HD_ROWS = 720  # from this height on, FFmpeg's colours are BT.709


class PipeOptions(Section):
    """Options in [content.options] for the scene `pipe`: either `path` or `command`."""

    path: str = Field("", description="named pipe (FIFO) to read")
    command: tuple[str, ...] = Field((), description="program, with its arguments, that writes video to its output")
    rgb_size: tuple[int, int] | None = Field(None, description="width and height if the video is raw RGB, not Y4M")

    @model_validator(mode="after")
    def _one(self) -> PipeOptions:
        if bool(self.path) == bool(self.command):
            raise ValueError("set either path or command, such as { path = '/tmp/video' }")
        if self.rgb_size is not None and not all(0 < edge <= SIZE_MAX_PX for edge in self.rgb_size):
            raise ValueError(f"rgb_size: must be from 1 to {SIZE_MAX_PX} pixels")
        return self


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Function that creates the source. Raises InputError if an option is invalid or no pipe exists."""
    options = validated(PipeOptions, file.settings.options, source="content.options")
    if options.path:
        path = Path(options.path)
        if not path.exists():
            raise InputError("content.options", "path", f"{path} does not exist; create it with `mkfifo {path}`")
        if not stat.S_ISFIFO(path.stat().st_mode):
            raise InputError(
                "content.options", "path", f"{path} is not a pipe; to show a file, set content.scene to it"
            )
    return partial(_source, options, file)


def _source(options: PipeOptions, file: SceneFile, context: Any = None) -> ContentSource:
    return LiveSource(PipeFeed(options), file=file)


class _Ended(Exception):
    """Raised if the writer has closed the pipe or the scene ends."""


class PipeFeed(Feed):
    """Feed that reads a pipe, and begins again if the writer closes it or sends something else."""

    def __init__(self, options: PipeOptions) -> None:
        super().__init__(options.path or options.command[0])
        self._options = options
        self._file = -1
        self._held = b""  # data read beyond the last line or frame

    def _run(self) -> None:
        while not self._ends.is_set():
            process: subprocess.Popen[bytes] | None = None
            try:
                if self._options.command:
                    process = subprocess.Popen(
                        self._options.command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, start_new_session=True
                    )
                    assert process.stdout is not None
                    self._file = os.dup(process.stdout.fileno())
                    process.stdout.close()
                else:
                    self._file = os.open(self._options.path, os.O_RDONLY | os.O_NONBLOCK)
                self._held = b""
                for picture, aspect in self._pictures():
                    self._take(picture, aspect)
            except _Ended:
                self.problem = f"{self.name}: closed"
            except (OSError, ValueError) as error:
                self.problem = one_line(f"{self.name}: {getattr(error, 'strerror', None) or error}")
            finally:
                self._close(process)
            self._ends.wait(AGAIN_S if self._options.command else LOOKS_EVERY_S)

    def _close(self, process: subprocess.Popen[bytes] | None) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        if process is not None:
            end_group(process)
            if process.returncode > 0 and not self._ends.is_set():
                self.problem = f"{self.name}: ended with exit status {process.returncode}"

    def _pictures(self) -> Iterator[tuple[U8, float]]:
        """Read pictures and their pixel aspect ratio until the pipe is closed. Raises ValueError for invalid data."""
        if self._options.rgb_size is not None:
            width, height = self._options.rgb_size
            while True:
                yield np.frombuffer(self._read(3 * width * height), np.uint8).reshape(height, width, 3), 1.0
        fields = self._line().split()
        if not fields or fields[0] != "YUV4MPEG2":
            raise ValueError("is neither Y4M nor, by `rgb_size`, raw RGB; use `ffmpeg ... -f yuv4mpegpipe`")
        found = {field[0]: field[1:] for field in fields[1:]}
        width, height = (int(found.get(name, "0")) for name in "WH")
        if not (0 < width <= SIZE_MAX_PX and 0 < height <= SIZE_MAX_PX and width * height * 3 <= FRAME_MAX_BYTES):
            raise ValueError(f"pictures of {width} x {height} pixels cannot be shown")
        colours, aspect = found.get("C", "420jpeg"), found.get("A", "1:1").split(":")
        kind = next((kind for kind in COLOURS if colours == kind or colours.startswith(f"{kind}jpeg")
                     or colours in (f"{kind}mpeg2", f"{kind}paldv")), None)  # fmt: skip
        if kind is None:
            raise ValueError(f"has colours {colours}; use `-pix_fmt yuv420p`")
        pixel_aspect = int(aspect[0]) / int(aspect[-1]) if "0" not in aspect else 1.0
        while True:
            if not self._line().startswith("FRAME"):
                raise ValueError("is not valid Y4M")
            yield self._frame(kind, width, height, is_full="XCOLORRANGE=FULL" in fields), pixel_aspect

    def _frame(self, kind: str, width: int, height: int, *, is_full: bool) -> U8:
        """Read a frame's planes and convert them to RGB. `is_full` means values from 0 to 255, as grey always has."""
        frame: Any = av.VideoFrame(width, height, COLOURS[kind])
        for number, plane in enumerate(frame.planes):
            wide = width if number == 0 or kind == "444" else (width + 1) // 2
            high = height if number == 0 or kind != "420" else (height + 1) // 2
            rows = np.zeros((high, plane.line_size), np.uint8)
            rows[:, :wide] = np.frombuffer(self._read(wide * high), np.uint8).reshape(high, wide)
            plane.update(rows.tobytes().ljust(plane.buffer_size, b"\0")[: plane.buffer_size])
        colours = "ITU709" if height >= HD_ROWS else "ITU601"
        values = "JPEG" if is_full else "MPEG"
        given = {} if kind == "mono" else {"src_colorspace": colours, "src_color_range": values}
        return np.asarray(frame.to_ndarray(format="rgb24", **given), np.uint8)

    def _line(self) -> str:
        while b"\n" not in self._held:
            if len(self._held) > HEADER_MAX:
                raise ValueError("is neither Y4M nor, by `rgb_size`, raw RGB; use `ffmpeg ... -f yuv4mpegpipe`")
            self._held += self._some()
        line, _, self._held = self._held.partition(b"\n")
        return line.decode("ascii", "replace")

    def _read(self, count: int) -> bytes:
        parts, length = [self._held], len(self._held)
        while length < count:
            parts.append(self._some())
            length += len(parts[-1])
        data = b"".join(parts)
        self._held = data[count:]
        return data[:count]

    def _some(self) -> bytes:
        """Wait for data. Raises _Ended at the pipe's end and at the scene's."""
        while not self._ends.is_set():
            if not select.select([self._file], [], [], LOOKS_EVERY_S)[0]:
                continue
            try:
                data = os.read(self._file, CHUNK_BYTES)
            except BlockingIOError:
                continue
            if not data:
                raise _Ended
            return data
        raise _Ended
