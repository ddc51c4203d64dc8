"""Show video from a pipe: Y4M, as FFmpeg, GStreamer and mpv write it, or raw RGB."""

from __future__ import annotations

import io
import os
import select
import stat
import subprocess
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import av
from pydantic import Field, model_validator

from runtime.config import Section, validated
from runtime.content.base import ContentSource
from runtime.content.live import Feed, LiveSource, end_group
from runtime.content.placing import SceneFile
from runtime.errors import InputError, one_line
from runtime.records import U8
from runtime.support.film import rgb_of

LOOKS_EVERY_S = 0.1  # how often the end of the scene is looked for while no data arrives
AGAIN_S = 1.0  # pause before a command that ended is started again
SIZE_MAX_PX = 16384
FRAME_MAX_BYTES = 1 << 28


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
            problem = f"{path} is not a pipe; to show a file, set content.scene to it"
            raise InputError("content.options", "path", problem)
    return partial(_source, options, file)


def _source(options: PipeOptions, file: SceneFile, context: Any = None) -> ContentSource:
    return LiveSource(PipeFeed(options), file=file)


class _Waiting:
    """A pipe that waits for data. It ends if its writer closes it or the scene ends."""

    def __init__(self, reader: io.FileIO, ends: threading.Event) -> None:
        self._reader, self._ends, self.is_at_end = reader, ends, False

    def read(self, size: int) -> bytes:
        data = None
        while data is None and not self._ends.is_set():
            if select.select([self._reader], [], [], LOOKS_EVERY_S)[0]:
                data = self._reader.read(size)
        self.is_at_end = not data
        return data or b""


class PipeFeed(Feed):
    """Feed that reads a pipe, and begins again if the writer closes it or sends something else."""

    def __init__(self, options: PipeOptions) -> None:
        super().__init__(options.path or options.command[0])
        self._options = options

    def _run(self) -> None:
        command = self._options.command
        while not self._ends.is_set():
            process: Any = None
            try:
                if command:
                    pipe = subprocess.PIPE
                    process = subprocess.Popen(
                        command, stdin=subprocess.DEVNULL, stdout=pipe, bufsize=0, start_new_session=True
                    )
                reader = (
                    process.stdout if process else io.FileIO(os.open(self._options.path, os.O_RDONLY | os.O_NONBLOCK))
                )
                with reader:
                    for picture, aspect in self._pictures(_Waiting(reader, self._ends)):
                        self._take(picture, aspect)
                self.problem = f"{self.name}: closed"
            except (OSError, ValueError) as error:
                self.problem = one_line(f"{self.name}: {getattr(error, 'strerror', None) or error}")
            if process is not None:
                end_group(process)
                if process.returncode > 0 and not self._ends.is_set():
                    self.problem = f"{self.name}: ended with exit status {process.returncode}"
            self._ends.wait(AGAIN_S if command else LOOKS_EVERY_S)

    def _pictures(self, pipe: _Waiting) -> Iterator[tuple[U8, float]]:
        """Read pictures and their pixel aspect ratio until the pipe is closed. Raises ValueError for invalid data."""
        form, given = "yuv4mpegpipe", {"fpsprobesize": "0"}  # with the default, the first pictures would come late
        if self._options.rgb_size is not None:
            form, given = "rawvideo", {"pixel_format": "rgb24", "video_size": "{}x{}".format(*self._options.rgb_size)}
        try:
            with av.open(pipe, "r", format=form, options=given) as container:
                stream = container.streams.video[0]
                if stream.width * stream.height * 3 > FRAME_MAX_BYTES:
                    raise ValueError(f"pictures of {stream.width} x {stream.height} pixels cannot be shown")
                for frame in container.decode(stream):
                    yield rgb_of(frame), float(stream.sample_aspect_ratio or 1)
        except av.error.FFmpegError:
            if not pipe.is_at_end:
                problem = "is neither Y4M nor, by `rgb_size`, raw RGB; use `ffmpeg ... -f yuv4mpegpipe`"
                raise ValueError(problem) from None
