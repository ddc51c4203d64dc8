"""Live pictures: a stream, a capture card, or a file played as one; read and decoded alongside by PyAV.

The newest whole picture is shown, for both eyes the same one. What ends is opened again, what stalls, changes its size
or lies about its rate is told in one line, and the last good picture stays.
"""

from __future__ import annotations

import logging
import re
import threading
import time
import weakref
from collections.abc import Generator, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings, LimitSettings
from runtime.content.arrivals import Arrivals
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.images import WarpedPicture
from runtime.content.pictures import CONTAINERS, layout_of, pixel_aspect, quilt_size, screen, split
from runtime.errors import ContentFailure, InputError, MissingPart, one_line
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import U8
from runtime.support import foreign
from runtime.support.live import LIVE
from runtime.support.picture_header import check_size

log = logging.getLogger("phasestack.content")

PROTOCOLS = ("rtsp", "rtsps", "rtp", "rtmp", "http", "https", "udp", "tcp", "srt")
CARRIED_BY = "rtsp,rtsps,rtp,rtmp,http,https,udp,tcp,tls,srt,crypto,data"
OPEN_S, READ_S = 5.0, 5.0  # a source that does not answer for so long is opened anew
ANALYSED_US = "1000000"  # of a stream, before its first picture; FFmpeg would look at five seconds
FIRST_PICTURE_S = 3.0  # that is waited for, where it comes soon
STALLED_S = 2.0  # without a new picture it is told
AGAIN_S, AGAIN_MOST_S = 0.5, 8.0  # between attempts; doubles
LONGEST_STEP_S = 2.0  # between two pictures of a file; a longer one is a lie
USUAL_STEP_S = 1 / 30
COUNTED = 50  # pictures over which a rate is measured
RATE_DIFFERS = 1.5  # times, until it is told


class Target:
    """What a live scene's name stands for."""

    def __init__(self, name: str) -> None:
        """Raises InputError for a protocol that is not taken, or a file that is not there."""
        self.url = name.removeprefix(LIVE)
        scheme = self.url.partition("://")[0].lower() if "://" in self.url else ""
        if scheme and scheme not in PROTOCOLS:
            raise InputError("content", "scene", f"{foreign.shown(scheme)}:// is none of {', '.join(PROTOCOLS)}")
        self.is_device = re.fullmatch(r"/dev/video\d+", self.url) is not None
        self.is_file = not scheme and not self.is_device
        # A password must not be in the status, nor in a log.
        self.shown = re.sub(r"//[^/@]*@", "//", self.url)
        self.path = Path(re.sub(r"[?#].*", "", self.url) if scheme else self.url)
        if self.is_file:
            with foreign.open_regular(self.url):
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


class _Shared:
    """What the decoding thread and the source share; the newest wins."""

    def __init__(self) -> None:
        self.ending = threading.Event()
        self.first = threading.Event()
        self.newest: tuple[int, U8] | None = None  # number, (h, w, 4) RGBA
        self.arrived_ns = time.monotonic_ns()
        self.problem = "waiting for its first picture"

    def put(self, picture: U8) -> None:
        self.newest = (1 if self.newest is None else self.newest[0] + 1, picture)
        self.arrived_ns = time.monotonic_ns()
        self.problem = ""
        self.first.set()


class Feed:
    """A source that is being read, from when this is made until it is closed or forgotten."""

    def __init__(self, target: Target, settings: ContentSettings, limits: LimitSettings) -> None:
        """Raises MissingPart without PyAV."""
        try:
            import av
        except ImportError:
            raise MissingPart("live pictures need PyAV: pip install 'phasestack[stream]'") from None
        av.logging.set_level(av.logging.PANIC)
        self.target, self.shared = target, _Shared()
        reader = _Reader(target, settings, limits, self.shared)
        threading.Thread(target=reader.run, name="stream", daemon=True).start()
        # A scene that was overtaken while it was loaded is dropped, and its thread ends with it.
        self.close = weakref.finalize(self, self.shared.ending.set)

    def wait(self) -> None:
        """Until the first picture is there, or too long."""
        self.shared.first.wait(FIRST_PICTURE_S)


class _Reader:
    """The decoding thread. Holds no Feed: who forgets that ends this."""

    def __init__(self, target: Target, settings: ContentSettings, limits: LimitSettings, shared: _Shared) -> None:
        self._target, self._limits, self._shared = target, limits, shared
        self._options = dict(settings.stream_options)
        self._repeat = settings.at_end == "repeat"
        self._size: tuple[int, int] | None = None
        self._told = ""

    def run(self) -> None:
        wait_s = AGAIN_S
        while not self._shared.ending.is_set():
            before = self._shared.newest
            problem = self._played()
            if self._shared.ending.is_set():
                return
            came = self._shared.newest is not before
            if self._target.is_file and came and not problem:
                if not self._repeat:
                    return
                continue
            wait_s = AGAIN_S if came else min(2 * wait_s, AGAIN_MOST_S)
            self._tell(problem or "it has ended")
            self._shared.ending.wait(wait_s)

    def _played(self) -> str:
        """Read it to its end; why it ended, empty for its own end."""
        import av

        try:
            for picture in self._pictures():
                self._shared.put(picture)
                self._told = ""
        except InputError as error:
            return error.problem
        except av.error.ExitError:  # a time limit has passed
            return f"nothing came for {READ_S:g} s"
        except (OSError, ValueError, av.error.FFmpegError) as error:
            return one_line(getattr(error, "strerror", None) or type(error).__name__, most=120)
        except Exception as error:  # a decoder's own: the loop goes on
            log.exception("%s: unexpected error", self._target.shown)
            return type(error).__name__
        return ""

    def _pictures(self) -> Iterator[U8]:
        """Every picture of a file when it is due; of all else the newest."""
        import av
        from av.video.reformatter import VideoReformatter

        kind = "v4l2" if self._target.is_device else None
        options = self._target.options(self._options)
        with closing(av.open(self._target.url, format=kind, options=options, timeout=(OPEN_S, READ_S))) as container:
            if not container.streams.video:
                raise InputError(self._target.shown, "", "holds no pictures")
            stream = container.streams.video[0]
            if stream.codec_context is None:  # a codec that FFmpeg does not know
                raise InputError(self._target.shown, "", "holds pictures that cannot be decoded")
            self._check_size(stream.codec_context.width, stream.codec_context.height)
            # One for all pictures: made anew, with threads of its own, for each, it took longer than all the rest.
            reformatter = VideoReformatter()
            frames = self._when_due if self._target.is_file else self._as_they_come
            with closing(frames(container, stream)) as these:  # before the container: nobody reads from it any more
                for frame in these:
                    yield np.asarray(reformatter.reformat(frame, format="rgba", threads=1).to_ndarray(), np.uint8)

    def _when_due(self, container: Any, stream: Any) -> Generator[Any, None, None]:
        """A file's frames, each at its time."""
        due_s, before_s = time.monotonic(), None
        for frame in container.decode(stream):
            self._check_size(frame.width, frame.height)
            due_s += _step_s(before_s, frame.time)
            before_s = frame.time
            due_s = max(due_s, time.monotonic() - LONGEST_STEP_S)  # a machine that slept does not race
            if self._shared.ending.wait(max(0.0, due_s - time.monotonic())):
                return
            yield frame

    def _as_they_come(self, container: Any, stream: Any) -> Generator[Any, None, None]:
        """The newest frame of a stream, whenever there is one."""
        rate = _RateCheck(float(stream.average_rate or 0), self._target.shown)
        with closing(Arrivals(container, stream, arrived=rate.count)) as arrivals:
            for packets, broken in arrivals.batches():
                if self._shared.ending.is_set():
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
        """Raises InputError for too many pixels; tells a change."""
        check_size(width_px, height_px, source=self._target.shown, limits=self._limits)
        if self._size not in (None, (width_px, height_px)) and width_px:
            now = f"{width_px} x {height_px}"
            log.warning("%s: its pictures changed from %d x %d to %s pixels", self._target.shown, *self._size, now)
        if width_px:
            self._size = (width_px, height_px)

    def _tell(self, problem: str) -> None:
        self._shared.problem = f"{problem}; it is tried again"
        if problem != self._told:
            self._told = problem
            stays = "; the last picture stays" if self._shared.newest is not None else ""
            log.warning("%s: %s%s", self._target.shown, problem, stays)


class _RateCheck:
    """Pictures that come much faster or slower than the source says: told once, and shown as they come."""

    def __init__(self, told_hz: float, name: str) -> None:
        """told_hz: 0 where it says nothing."""
        self._told_hz, self._name = told_hz, name
        self._times_s: list[float] = []

    def count(self) -> None:
        if self._told_hz <= 0 or len(self._times_s) > COUNTED:
            return
        self._times_s.append(time.monotonic())
        if len(self._times_s) <= COUNTED:
            return
        steps = sorted(b - a for a, b in zip(self._times_s, self._times_s[1:], strict=False))
        hz = 1 / max(steps[len(steps) // 2], 1e-4)
        if not self._told_hz / RATE_DIFFERS <= hz <= self._told_hz * RATE_DIFFERS:
            log.warning(
                "%s: says %.4g pictures a second and gives %.3g: shown as they come", self._name, self._told_hz, hz
            )


def _step_s(before_s: float | None, now_s: float | None) -> float:
    """From one picture of a file to the next; a usual one where the file tells nonsense."""
    if before_s is None:
        return 0.0
    step_s = (now_s or 0.0) - before_s
    return step_s if 0 < step_s <= LONGEST_STEP_S else USUAL_STEP_S


class LiveSource(ContentSource):
    """The newest picture of a feed, hanging in the plane of the display's centre."""

    def __init__(
        self, feed: Feed, *, layout: str, quilt: tuple[int, int], stack: PanelStack, settings: ContentSettings
    ):
        self._feed, self._layout, self._quilt = feed, layout, quilt
        self._stack, self._background = stack, settings.background
        self._number = 0  # of the picture that is shown
        self._views: list[U8] = []
        self._screen: PlaneRaster | None = None
        self._shown: dict[int, WarpedPicture] = {}
        self._looked_ns: int | None = None
        self._stalled = False
        self._own_problem = ""
        self.info = ContentInfo(name=feed.target.shown, moving=True, background=settings.background)

    @property
    def problem(self) -> str:
        shared = self._feed.shared
        silent_s = (time.monotonic_ns() - shared.arrived_ns) / NS_PER_S
        if self._own_problem:
            return f"{self._feed.target.shown}: {self._own_problem}"
        if shared.problem:
            return f"{self._feed.target.shown}: {shared.problem}"
        if silent_s > STALLED_S and not self._has_ended:
            return f"{self._feed.target.shown}: no new picture for {silent_s:.0f} s"
        return ""

    @property
    def _has_ended(self) -> bool:
        """A file that holds its last picture."""
        return self._feed.target.is_file

    def revision(self, *, time_ns: int) -> int:
        self._take(time_ns)
        return self._number

    def render(self, view: View, *, time_ns: int) -> U8:
        # Both eyes of one frame see one picture: two would be depth that isn't there.
        if time_ns != self._looked_ns:
            self._take(time_ns)
        if self._screen is None:
            raise ContentFailure(self.problem or f"{self._feed.target.shown}: waiting for its first picture")
        which = min(view.side, len(self._views) - 1)
        if which not in self._shown:
            self._shown[which] = WarpedPicture(self._views[which], background=self._background)
        matrix = panel_from_image(view.pixels_from_stack, self._screen)
        return self._shown[which].warped(matrix, width_px=view.width_px, height_px=view.height_px, side=view.side)

    def close(self) -> None:
        self._feed.close()

    def _take(self, time_ns: int) -> None:
        self._looked_ns = time_ns
        newest = self._feed.shared.newest
        self._tell_stall()
        if newest is None or newest[0] == self._number:
            return
        number, picture = newest
        self._number = number
        try:
            views = split(picture, self._layout, self._quilt)
        except ValueError as error:
            self._own_problem = str(error)
            return
        self._own_problem = ""
        # Of a quilt the two views in its middle.
        middle = len(views) // 2
        self._views = views if len(views) <= 2 else views[middle - 1 : middle + 1]
        height, width = self._views[0].shape[:2]
        aspect = pixel_aspect(self._feed.target.path, self._layout, width_px=width, height_px=height)
        self._screen = screen(self._stack, width_px=width, height_px=height, pixel_aspect=aspect)
        self._shown = {}

    def _tell_stall(self) -> None:
        """Once when it begins, once when it is over."""
        silent_s = (time.monotonic_ns() - self._feed.shared.arrived_ns) / NS_PER_S
        stalled = silent_s > STALLED_S and self._number > 0 and not self._has_ended
        if stalled != self._stalled:
            self._stalled = stalled
            told = f"no new picture for {silent_s:.0f} s; the last one stays" if stalled else "pictures come again"
            log.warning("%s: %s", self._feed.target.shown, told)


def open_feed(name: str, settings: ContentSettings, limits: LimitSettings) -> tuple[Feed, str, tuple[int, int]]:
    """A feed that has begun, its layout, and its quilt. Raises InputError, MissingPart."""
    target = Target(name)
    layout = layout_of(target.path, settings)
    if layout == "rgbd":
        raise InputError("content", "layout", "rgbd is not for live pictures")
    quilt = quilt_size(target.path, settings) if layout == "quilt" else (1, 1)
    feed = Feed(target, settings, limits)
    feed.wait()
    return feed, layout, quilt
