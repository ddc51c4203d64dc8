"""Live pictures: a stream, a capture card, or a file played as one; read and decoded alongside by PyAV.

The newest whole picture is shown, for both eyes the same one. What ends is opened again, what stalls or changes its
size is reported in one line, and the last good picture stays.
"""

from __future__ import annotations

import logging
import re
import threading
import time
import weakref
from collections.abc import Callable, Generator, Iterator
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from queue import Queue
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource
from runtime.content.pictures import CONTAINERS, Layout, ScreenSource, layout_of
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError, MissingPart, one_line
from runtime.records import U8
from runtime.support import untrusted_input
from runtime.support.live import LIVE
from runtime.support.picture_header import check_size

log = logging.getLogger("phasestack.content")

PROTOCOLS = ("rtsp", "rtsps", "rtp", "rtmp", "http", "https", "udp", "tcp", "srt")
CARRIED_BY = "rtsp,rtsps,rtp,rtmp,http,https,udp,tcp,tls,srt,crypto,data"
OPEN_S, READ_S = 5.0, 5.0  # a source that does not answer for so long is opened anew
ANALYSED_US = "1000000"  # of a stream, before its first picture; FFmpeg would look at five seconds
FIRST_PICTURE_S = 3.0  # that is waited for, where it comes soon
STALLED_S = 2.0  # without a new picture it is reported
AGAIN_S, AGAIN_MAX_S = 0.5, 8.0  # between attempts; doubles
RATES_HZ = (0.5, 240.0)  # of a file; beyond, it lies
USUAL_STEP_S = 1 / 30
BEHIND = 8  # packets that wait, from which on all before the newest key picture are left out
WAITING_MAX = 512  # packets; the oldest make way


class Target:
    """What a live scene's name stands for."""

    def __init__(self, name: str) -> None:
        """Raises InputError for a protocol that is not taken, or a file that is not there."""
        self.url = name.removeprefix(LIVE)
        scheme = self.url.partition("://")[0].lower() if "://" in self.url else ""
        if scheme and scheme not in PROTOCOLS:
            raise InputError(
                "content", "scene", f"{untrusted_input.shown(scheme)}:// is none of {', '.join(PROTOCOLS)}"
            )
        self.is_device = re.fullmatch(r"/dev/video\d+", self.url) is not None
        self.is_file = not scheme and not self.is_device
        # A password must not be in the status, nor in a log.
        self.shown = re.sub(r"//[^/@]*@", "//", self.url)
        self.path = Path(re.sub(r"[?#].*", "", self.url) if scheme else self.url)
        if self.is_file:
            with untrusted_input.open_regular(self.url):
                pass

    def options(self, given: dict[str, str]) -> dict[str, str]:
        """For FFmpeg: nothing is opened but what was named."""
        if self.is_device:
            return dict(given)
        if self.is_file:
            return {"protocol_whitelist": "file", "format_whitelist": CONTAINERS + ",mpegts,h264,hevc,mjpeg"}
        usual = {
            "fflags": "nobuffer",
            "analyzeduration": ANALYSED_US,
            "protocol_whitelist": CARRIED_BY,
            "rtsp_transport": "tcp",
        }
        return usual | given


class Feed:
    """A source that is being read, from when this is made until it is closed or forgotten."""

    def __init__(self, target: Target, settings: ContentSettings) -> None:
        """Raises MissingPart without PyAV."""
        try:
            import av
        except ImportError:
            raise MissingPart("live pictures need PyAV: pip install av") from None
        av.logging.set_level(av.logging.PANIC)
        self.reader = Reader(target, settings)
        threading.Thread(target=self.reader.run, name="stream", daemon=True).start()
        # A scene that was skipped while it was loaded is dropped, and its thread ends with it.
        self.close = weakref.finalize(self, self.reader.ending.set)


class Reader:
    """The decoding thread, and the newest picture that it has. Holds no Feed: who forgets that ends this."""

    def __init__(self, target: Target, settings: ContentSettings) -> None:
        self.shown = target.shown
        self.ending, self.first = threading.Event(), threading.Event()
        self.newest: tuple[int, U8] | None = None  # number, (h, w, 4) RGBA
        self.arrived_ns = time.monotonic_ns()
        self.problem = "waiting for its first picture"
        self._target = target
        self._options = dict(settings.stream_options)
        self._size: tuple[int, int] | None = None
        self._reported = ""

    def run(self) -> None:
        wait_s = AGAIN_S
        while not self.ending.is_set():
            before = self.newest
            problem = self._played()
            if self.ending.is_set():
                return
            came = self.newest is not before
            if self._target.is_file and came and not problem:
                continue
            wait_s = AGAIN_S if came else min(2 * wait_s, AGAIN_MAX_S)
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
        """Every picture of a file when it is due; of all else the newest."""
        import av
        from av.video.reformatter import VideoReformatter

        kind = "v4l2" if self._target.is_device else None
        options = self._target.options(self._options)
        with closing(av.open(self._target.url, format=kind, options=options, timeout=(OPEN_S, READ_S))) as container:
            if not container.streams.video or container.streams.video[0].codec_context is None:
                raise InputError(self.shown, "", "holds no pictures that can be decoded")
            stream = container.streams.video[0]
            self._check_size(stream.codec_context.width, stream.codec_context.height)
            # One for all pictures: made anew, with threads of its own, for each, it took longer than all the rest.
            reformatter = VideoReformatter()
            frames = self._when_due if self._target.is_file else self._as_they_come
            with closing(frames(container, stream)) as these:  # before the container: nobody reads from it any more
                for frame in these:
                    yield np.asarray(reformatter.reformat(frame, format="rgba", threads=1).to_ndarray(), np.uint8)

    def _when_due(self, container: Any, stream: Any) -> Generator[Any, None, None]:
        """A file's frames, at the pace that it says; a usual one where it says nonsense."""
        rate_hz = float(stream.average_rate or 0)
        step_s = 1 / rate_hz if RATES_HZ[0] <= rate_hz <= RATES_HZ[1] else USUAL_STEP_S
        due_s = time.monotonic()
        for frame in container.decode(stream):
            self._check_size(frame.width, frame.height)
            if self.ending.wait(max(0.0, due_s - time.monotonic())):
                return
            yield frame
            due_s = max(due_s, time.monotonic() - step_s) + step_s  # a machine that slept does not race

    def _as_they_come(self, container: Any, stream: Any) -> Generator[Any, None, None]:
        """The newest frame of a stream, whenever there is one."""
        with closing(_Packets(container, stream)) as arrived:
            for packets, broken in arrived.batches():
                if self.ending.is_set():
                    return
                if broken:
                    stream.codec_context.flush_buffers()
                newest = None
                for packet in packets:
                    for frame in packet.decode():
                        self._check_size(frame.width, frame.height)
                        newest = frame
                if newest is not None:
                    yield newest

    def _check_size(self, width_px: int, height_px: int) -> None:
        """Raises InputError for too many pixels; reports a change."""
        check_size(width_px, height_px, source=self.shown)
        if self._size not in (None, (width_px, height_px)) and width_px:
            now = f"{width_px} x {height_px}"
            log.warning("%s: its pictures changed from %d x %d to %s pixels", self.shown, *self._size, now)
        if width_px:
            self._size = (width_px, height_px)

    def _report(self, problem: str) -> None:
        self.problem = f"{problem}; it is tried again"
        if problem != self._reported:
            self._reported = problem
            stays = "; the last picture stays" if self.newest is not None else ""
            log.warning("%s: %s%s", self.shown, problem, stays)


class _Packets:
    """A stream's packets, taken in by a thread of their own: who decodes slowly knows that it is behind."""

    def __init__(self, container: Any, stream: Any) -> None:
        """container: an open `av` container, which nobody else reads."""
        self._waiting: Queue[Any] = Queue()  # packets, and at the end what ended them, an exception
        self._broken = False  # something was left out: what follows cannot be decoded on from what was before
        self._closing = False
        run = partial(self._run, container.demux(stream))
        self._thread = threading.Thread(target=run, name="stream packets", daemon=True)
        self._thread.start()

    def batches(self) -> Iterator[tuple[list[Any], bool]]:
        """All packets that wait, each time that some do, and whether some were left out before them.

        Ends with the stream. Raises what reading it raised.
        """
        end: Exception | None = None
        while end is None:
            packets = [self._waiting.get()] + [self._waiting.get() for _ in range(self._waiting.qsize())]
            broken, self._broken = self._broken, False
            if isinstance(packets[-1], Exception):
                end = packets.pop()
            if len(packets) >= BEHIND:
                newest_key = max((place for place, packet in enumerate(packets) if packet.is_keyframe), default=0)
                packets, broken = packets[newest_key:], broken or newest_key > 0
            if packets:
                yield packets, broken
        if not isinstance(end, EOFError):
            raise end

    def close(self) -> None:
        """No more is read. Waits for the read that is under way, which has a time limit of its own."""
        self._closing = True
        self._thread.join()

    def _run(self, packets: Iterator[Any]) -> None:
        try:
            for packet in packets:
                if self._closing:
                    return
                self._waiting.put(packet)
                if self._waiting.qsize() > WAITING_MAX:
                    self._waiting.get()
                    self._broken = True
            self._waiting.put(EOFError())
        except Exception as error:  # raised again by who takes
            self._waiting.put(error)


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Begin to read, and wait a moment for the first picture. Raises InputError, MissingPart."""
    target = Target(file.settings.scene)
    file = replace(file, path=target.path)
    layout = layout_of(file.path, file.settings)
    if layout.kind == "rgbd":
        raise InputError("content", "layout", "rgbd is not for live pictures")
    feed = Feed(target, file.settings)
    feed.reader.first.wait(FIRST_PICTURE_S)
    return lambda context: LiveSource(feed, layout=layout, file=file)


class LiveSource(ScreenSource):
    """The newest picture of a feed."""

    def __init__(self, feed: Feed, *, layout: Layout, file: SceneFile) -> None:
        super().__init__(layout=layout, file=file)
        self._feed, self._reader = feed, feed.reader
        self._number, self._newest = 0, np.empty((0, 0, 4), np.uint8)  # that is shown
        self._looked_ns: int | None = None
        self._stalled = False
        self.info = ContentInfo(name=feed.reader.shown, moving=True, background=file.background)

    @property
    def problem(self) -> str:
        if self._reader.problem:
            return f"{self._reader.shown}: {self._reader.problem}"
        silent_s = self._silent_s()
        return f"{self._reader.shown}: no new picture for {silent_s:.0f} s" if silent_s > STALLED_S else ""

    def revision(self, *, time_ns: int) -> int:
        # Both eyes of one frame see one picture: two would be depth that isn't there.
        if time_ns != self._looked_ns:
            self._looked_ns = time_ns
            self._look()
        return self._number

    def picture(self, number: int) -> U8:
        if not number:
            raise ContentFailure(f"{self._reader.shown}: {self._reader.problem}")
        return self._newest

    def close(self) -> None:
        self._feed.close()

    def _look(self) -> None:
        if self._reader.newest is not None:
            self._number, self._newest = self._reader.newest
        silent_s = self._silent_s()
        if (silent_s > STALLED_S) != self._stalled and self._number:  # once when it begins, once when it is over
            self._stalled = not self._stalled
            stays = f"no new picture for {silent_s:.0f} s; the last one stays"
            log.warning("%s: %s", self._reader.shown, stays if self._stalled else "pictures come again")

    def _silent_s(self) -> float:
        return (time.monotonic_ns() - self._reader.arrived_ns) / NS_PER_S
