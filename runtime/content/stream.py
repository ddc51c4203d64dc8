"""Live pictures: a stream or a capture card, read and decoded alongside by PyAV.

The newest whole picture is shown, for both eyes the same one. What ends or sends nothing is opened again, in one line
of the log, and the last good picture stays.
"""

from __future__ import annotations

import logging
import re
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource
from runtime.content.pictures import Layout, ScreenSource, layout_of
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError, MissingPart, one_line, without_secrets
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.background import begin
from runtime.support.picture_header import check_size

log = logging.getLogger("phasestack.content")

PROTOCOLS = ("rtsp", "rtsps", "rtp", "rtmp", "http", "https", "udp", "tcp", "srt")
LISTENS = re.compile(r"[?&](?:listen|mode)=(?!0\b|caller\b)", re.IGNORECASE)  # of FFmpeg's tcp, rtmp, http; srt
STREAM_OPTIONS = {  # for FFmpeg: nothing is opened but what was named
    "fflags": "nobuffer",
    "analyzeduration": "1000000",  # microseconds before the first picture; it would look at five seconds
    "protocol_whitelist": "rtsp,rtsps,rtp,rtmp,http,https,udp,tcp,tls,srt,crypto,data",
    "rtsp_transport": "tcp",
    "overrun_nonfatal": "1",  # of UDP: a machine that is too slow loses packets, not the stream
}
OPEN_S, READ_S = 5.0, 5.0  # a source that does not answer for so long is opened anew
FIRST_PICTURE_S = 3.0  # that is waited for, where it comes soon
STALLED_S = 2.0  # without a new picture it is reported
AGAIN_S, AGAIN_MAX_S = 0.5, 8.0  # between attempts; doubles


class Reader:
    """The decoding thread, and the newest picture that it has. Holds no source: who forgets that ends this."""

    def __init__(self, settings: ContentSettings) -> None:
        """Raises MissingPart without PyAV."""
        try:
            import av
        except ImportError:
            raise MissingPart("live pictures need PyAV: pip install av") from None
        av.logging.set_level(av.logging.PANIC)
        self._url, self._options = settings.scene, settings.stream_options
        # A password must not be in the status, nor in a log.
        self.shown = without_secrets(self._url)
        self.ending, self.first = threading.Event(), threading.Event()
        self.newest: tuple[int, U8] | None = None  # number, (h, w, 4) RGBA
        self.arrived_ns = time.monotonic_ns()
        self.problem = "waiting for its first picture"
        self._reported = ""

    def run(self) -> None:
        wait_s = AGAIN_S
        while not self.ending.is_set():
            before = self.newest
            problem = self._played()
            if self.ending.is_set():
                return
            wait_s = AGAIN_S if self.newest is not before else min(2 * wait_s, AGAIN_MAX_S)
            self._report(problem or "it has ended")
            self.ending.wait(wait_s)

    def _played(self) -> str:
        """Read it to its end; why it ended, empty for its own end."""
        import av

        try:
            for picture in self.pictures():
                self.newest = (1 if self.newest is None else self.newest[0] + 1, picture)
                self.arrived_ns = time.monotonic_ns()
                self.problem = self._reported = ""
                self.first.set()
        except InputError as error:
            return error.problem
        except av.error.ExitError:  # a time limit has passed
            return f"nothing came for {READ_S:g} s"
        except (OSError, ValueError, av.error.FFmpegError) as error:
            return one_line(getattr(error, "strerror", None) or type(error).__name__, most=120)
        except Exception as error:  # a decoder's own: the loop goes on
            log.exception("%s: unexpected error", self.shown)
            return type(error).__name__
        return ""

    def pictures(self) -> Iterator[U8]:
        """The newest one, whenever there is one."""
        import av

        is_stream = "://" in self._url
        kind, options = None if is_stream else "v4l2", (STREAM_OPTIONS if is_stream else {}) | self._options
        with closing(av.open(self._url, format=kind, options=options, timeout=(OPEN_S, READ_S))) as container:
            yield from self.decoded(container)

    def decoded(self, container: Any) -> Iterator[U8]:
        """(h, w, 4) of an open `av` container. Raises InputError for too many pixels, or none."""
        from av.video.reformatter import VideoReformatter

        if not container.streams.video or container.streams.video[0].codec_context is None:
            raise InputError(self.shown, "", "holds no pictures that can be decoded")
        stream = container.streams.video[0]
        check_size(stream.codec_context.width, stream.codec_context.height, source=self.shown)
        # One for all pictures: made anew, with threads of its own, for each, it took longer than all the rest.
        reformatter = VideoReformatter()
        for frame in container.decode(stream):
            if self.ending.is_set():
                return
            check_size(frame.width, frame.height, source=self.shown)
            yield np.asarray(reformatter.reformat(frame, format="rgba", threads=1).to_ndarray(), np.uint8)

    def _report(self, problem: str) -> None:
        self.problem = f"{problem}; it is tried again"
        if problem != self._reported:
            self._reported = problem
            stays = "; the last picture stays" if self.newest is not None else ""
            log.warning("%s: %s%s", self.shown, problem, stays)


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Begin to read, and wait a moment for the first picture. Raises InputError, MissingPart."""
    url = file.settings.scene
    scheme = url.partition("://")[0].lower()
    if "://" in url and scheme not in PROTOCOLS:
        raise InputError("content", "scene", f"{untrusted_input.shown(scheme)}:// is none of {', '.join(PROTOCOLS)}")
    if LISTENS.search(url):
        raise InputError("content", "scene", "an address that others may send to is not opened (listen)")
    layout = layout_of(Path(re.sub(r"[?#].*", "", url)), file.settings)
    if layout.kind == "rgbd":
        raise InputError("content", "layout", "rgbd is not for live pictures")
    source = LiveSource(Reader(file.settings), layout=layout, file=file)
    source.reader.first.wait(FIRST_PICTURE_S)
    return lambda context: source


class LiveSource(ScreenSource):
    """The newest picture that a reader has, from when this is made until it is closed or forgotten."""

    def __init__(self, reader: Reader, *, layout: Layout, file: SceneFile) -> None:
        super().__init__(layout=layout, file=file)
        self.reader = reader
        self._number, self._newest = 0, np.empty((0, 0, 4), np.uint8)  # that is shown
        self._looked_ns: int | None = None
        self.info = ContentInfo(name=reader.shown, moving=True, background=file.background)
        begin("stream", reader.run)
        # A scene that was skipped while it was loaded is dropped, and its thread ends with it.
        weakref.finalize(self, reader.ending.set)

    @property
    def problem(self) -> str:
        if self.reader.problem:
            return f"{self.reader.shown}: {self.reader.problem}"
        silent_s = (time.monotonic_ns() - self.reader.arrived_ns) / NS_PER_S
        return f"{self.reader.shown}: no new picture for {silent_s:.0f} s" if silent_s > STALLED_S else ""

    def revision(self, *, time_ns: int) -> int:
        # Both eyes of one frame see one picture: two would be depth that isn't there.
        if time_ns != self._looked_ns:
            self._looked_ns = time_ns
            if self.reader.newest is not None:
                self._number, self._newest = self.reader.newest
        return self._number

    def picture(self, number: int) -> U8:
        if not number:
            raise ContentFailure(f"{self.reader.shown}: {self.reader.problem}")
        return self._newest

    def close(self) -> None:
        self.reader.ending.set()
