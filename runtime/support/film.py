"""Decode and write films with PyAV (FFmpeg), which may open only the named file."""

from __future__ import annotations

import re
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from fractions import Fraction
from heapq import heappop, heappush
from itertools import chain
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
from av.sidedata.sidedata import Type as SideData
from numpy.typing import NDArray

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.errors import InputError, SensorLost
from runtime.records import U8
from runtime.support import progress, untrusted_input
from runtime.support.coded_colours import BRIGHT, Colour, composed, srgb_from

CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
COVER = 1024  # FFmpeg's AV_DISPOSITION_ATTACHED_PIC
EARLIER_S = 1, 10, 100  # seek so much earlier if an index names frames that cannot be decoded alone
FRAMES_MAX = 10_000_000  # most frames in a film: four days at 30 per second
SCANNED_BYTES = 1 << 30  # in larger files, frames at a constant rate are not looked up one by one
WITH_ALPHA = {"vp8": "libvpx", "vp9": "libvpx-vp9"}  # decoders of the transparency in WebM, which FFmpeg's own ignore
STEREO = {1: "side-by-side", 2: "top-bottom"}  # FFmpeg's AVStereo3DType
# FFmpeg's AVStereo3DType from 3 to 8
UNSEEN = "alternating frames", "checkerboard", "quincunx", "alternating rows", "alternating columns", "MV-HEVC"
VIEW_ID, RIGHT = "29", 2  # FFmpeg's AV_FRAME_DATA_VIEW_ID, which PyAV does not name, and AVStereo3DView
BT709, UNSPECIFIED = 1, 2  # AVColorSpace
RECTILINEAR = 4  # AVSphericalProjection

# The camera may answer with a playlist (HLS), but not make FFmpeg open local files.
STREAM_OPTIONS = {
    "protocol_whitelist": "http,https,httpproxy,tcp,tls,udp,rtp,srtp,rtsp,rtsps,crypto",
    "rtsp_flags": "prefer_tcp",
    "fflags": "nobuffer",
}
ANSWERS_IN_S = 5.0  # longest wait for a network camera's answer or next picture
REASONS = {  # why a network camera cannot be opened
    av.error.HTTPUnauthorizedError: "asks for a password; write user:password@ before the host in sensor.source",
    av.error.HTTPForbiddenError: "refuses this user; correct the user name and password in sensor.source",
    av.error.HTTPNotFoundError: "has no stream of this name (404); correct the path in sensor.source",
    av.error.ConnectionRefusedError: "refuses connections; switch the camera on, or correct sensor.source",
    av.error.ExitError: f"does not answer within {ANSWERS_IN_S:g} s",
    av.error.OSError: "cannot be reached or sends no pictures; correct sensor.source",
    av.error.InvalidDataError: "does not answer or sends no pictures; correct sensor.source",
}

Picture = tuple[int, tuple[av.VideoFrame, ...]]  # time in ns from the start; a frame, or the left and right view's


@dataclass(frozen=True, slots=True)
class FilmHeader:
    """The arrangement that a film file declares. Fields it does not declare have their defaults."""

    layout: str = ""  # in the syntax of `content.layout`
    is_around: bool = False  # True if the pictures show a half or a full sphere
    left_out: str = ""  # description of a view that is declared but not supported
    pixel_aspect: float = 1.0  # pixel width divided by pixel height
    views: int = 1  # 2 if the left and right view are separate streams, or MV-HEVC
    right_first: bool = False  # True if the right eye's view comes first


class Film:
    """A film file's frames and their times. An audio file's cover is a film of one frame. Two streams of
    equal pictures, such as Fuji's 3D films, are the left and right view.
    """

    def __init__(self, path: Path, *, times_ns: NDArray[np.int64] | None = None) -> None:
        """Open a film, with the times (n + 1,) of its frames if known. Raises InputError."""
        self.path, self._start_ns = path, 0
        self._container: Any = None
        first = next(self.pictures(), None)
        if first is None:
            raise InputError(path, "frames", "the first frame cannot be decoded")
        self._start_ns = first[0]
        self.header = _header(first[1], self._streams[0])
        # (n + 1,) times at which each frame begins and the last one ends, in ns from the first frame
        self.times_ns = self._times() if times_ns is None else times_ns

    def _open(self) -> None:
        """Open the file and choose the streams to show. Raises InputError if it is not a regular file or not a film.
        FFmpeg is restricted to local files and video containers. Otherwise, a playlist or script with a film's suffix,
        or a name that looks like a URL, could make FFmpeg open other files and network connections.
        """
        untrusted_input.open_regular(self.path).close()
        options = {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
        self.close()
        try:
            self._container = av.open(f"file:{self.path.absolute()}", options=options)
        except (av.error.FFmpegError, UnicodeError):
            raise InputError(self.path, "", "cannot be decoded as a film") from None
        self._choose()

    def _choose(self) -> None:
        """Choose the streams to show, and their decoders."""
        videos = [stream for stream in self._container.streams.video if stream.codec_context is not None]
        streams = [stream for stream in videos if not stream.disposition & COVER] or videos[:1]
        if not streams:
            raise InputError(self.path, "", "cannot be decoded as a film: it has no pictures")
        views = {(s.codec_context.name, s.codec_context.width, s.codec_context.height) for s in streams}
        self._streams = streams if len(streams) == 2 and len(views) == 1 else streams[:1]
        # AVI files state when frames are decoded, and only some codecs when they are shown.
        self._has_no_times = self._container.format.name == "avi" and streams[0].codec_context.name in ("h264", "hevc")
        self._decoders: dict[int, Any] = {}
        for stream in self._streams:
            decoder, name = stream.codec_context, WITH_ALPHA.get(stream.codec_context.name, "")
            if stream.metadata.get("alpha_mode") == "1" and name in av.codecs_available:
                decoder = av.CodecContext.create(name, "r")
                decoder.extradata = stream.codec_context.extradata
            if decoder.name == "hevc":
                decoder.options = {"view_ids": "-1"}  # all views of MV-HEVC
            decoder.thread_type = "AUTO"
            self._decoders[stream.index] = decoder

    def _times(self) -> NDArray[np.int64]:
        self._open()
        stream = self._streams[0]
        rate, size = float(stream.average_rate or 0), self.path.stat().st_size
        length_s = (self._container.duration or 0) / av.time_base
        if size > SCANNED_BYTES and rate and length_s and abs(float(stream.guessed_rate or 0) / rate - 1) < 1e-3:
            count = min(max(round(length_s * rate), 1), FRAMES_MAX)
            return np.asarray(np.rint(np.arange(count + 1) * (NS_PER_S / rate)), np.int64)
        stamps, last = [], 0
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(stream):
                if packet.size and not packet.is_discard:
                    stamps.append(self._stamp(packet))
                    last = packet.duration or last
                if len(stamps) % 4096 == 1:
                    untrusted_input.within(len(stamps), FRAMES_MAX, source=self.path, field="frames")
                    progress.tell(f"{self.path.name}: frames", len(stamps))
        ticks = np.unique(np.array([stamp for stamp in stamps if stamp is not None] or [0], np.int64))
        gap = int(np.median(np.diff(ticks))) if len(ticks) > 1 else 0
        times_ns = np.append(ticks, ticks[-1] + max(last or gap, 1)) * (NS_PER_S * float(stream.time_base or 1))
        times_ns = np.rint(times_ns - self._start_ns)
        times_ns = np.append(0, times_ns[times_ns > 1])  # without frames before the first that can be decoded
        if times_ns[-2] < length_s * NS_PER_S < times_ns[-1]:  # a rate that varies makes the last duration a guess
            times_ns[-1] = length_s * NS_PER_S
        return np.asarray(times_ns, np.int64)

    def _stamp(self, coded: Any) -> Any:
        return coded.dts if coded.pts is None or self._has_no_times else coded.pts

    def pictures(self, since_ns: int = 0) -> Iterator[Picture]:
        """Decode the pictures in order of time, from a given time or earlier, without damaged ones. Another
        iterator must not be in use.
        """
        pictures, first = self._pictures(since_ns), None
        for earlier_s in EARLIER_S if since_ns > 0 else ():
            first = next(pictures, None)
            if first is not None and first[0] <= since_ns + NS_PER_MS:
                break
            pictures = self._pictures(since_ns - earlier_s * NS_PER_S)
        yield from pictures if first is None else chain([first], pictures)

    def _pictures(self, since_ns: int) -> Iterator[Picture]:
        """Decode the pictures from where the file's index places a time, which may be too late."""
        if since_ns > 0:
            stream = self._streams[0]
            try:
                tick = int((since_ns + self._start_ns) / NS_PER_S / float(stream.time_base or 1))
                self._container.seek(tick, stream=stream)
                for decoder in self._decoders.values():
                    decoder.flush_buffers()
            except av.error.FFmpegError:
                since_ns = 0
        if since_ns <= 0:
            self._open()
        for frames in self._grouped():
            stamp, base = frames[0].dts if frames[0].pts is None else frames[0].pts, frames[0].time_base
            yield 0 if stamp is None else round(stamp * float(base or 1) * NS_PER_S) - self._start_ns, frames

    def _grouped(self) -> Iterator[tuple[av.VideoFrame, ...]]:
        """Yield the frames of each picture. The views of MV-HEVC follow each other, with the same time. If one is
        missing, the other one is for both eyes.
        """
        waiting: dict[int, deque[av.VideoFrame]] = {stream.index: deque() for stream in self._streams}
        view: av.VideoFrame | None = None
        for index, frame in self._decoded():
            if VIEW_ID in _side_data(frame):
                is_second = view is not None and view.pts == frame.pts
                if view is not None:
                    yield view, frame if is_second else view
                view = None if is_second else frame
                continue
            waiting[index].append(frame)
            while all(waiting.values()):
                yield tuple(queue.popleft() for queue in waiting.values())
        if view is not None:
            yield view, view

    def _decoded(self) -> Iterator[tuple[int, av.VideoFrame]]:
        """Yield decoded frames with their stream's number. Interlaced frames are converted to progressive ones."""
        graphs: dict[int, Any] = {}
        stamps: dict[int, list[int]] = {index: [] for index in self._decoders}
        with suppress(av.error.FFmpegError):
            for packet in self._container.demux(self._streams):
                index, frames = packet.stream.index, list[av.VideoFrame | None]()
                if self._has_no_times and packet.dts is not None:
                    heappush(stamps[index], packet.dts)
                with suppress(av.error.InvalidDataError):  # the next packet may be intact
                    frames += self._decoders[index].decode(packet)
                for frame in frames if packet.size else [*frames, None]:
                    if frame is not None and stamps[index]:
                        frame.pts = heappop(stamps[index])
                    if frame is not None and frame.interlaced_frame and index not in graphs:
                        graphs[index] = _progressive(frame)
                    if index in graphs:
                        with suppress(av.error.BlockingIOError, av.error.EOFError):
                            graphs[index].vpush(frame)
                            while True:
                                yield index, graphs[index].vpull()
                    elif frame is not None:
                        yield index, frame

    def rgb(self, frames: tuple[av.VideoFrame, ...], *, background: Colour = (0.0, 0.0, 0.0)) -> U8:
        """Convert frames to an upright (h, w, 3) picture over a background, with two views side by side."""
        views = [rgb_of(frame, background) for frame in frames]
        return views[0] if len(views) == 1 else np.concatenate(views, axis=1)

    def close(self) -> None:
        if self._container is not None:
            self._container.close()


class NetworkStream(Film):
    """A network camera's pictures, which cannot be repeated."""

    def __init__(self, url: str) -> None:
        self._url, self._container, self._start_ns = url, None, 0

    def _open(self) -> None:
        """Connect. Raises SensorLost with the reason if the camera sends no pictures. Messages contain no password."""
        shown = without_password(self._url)
        try:
            self._container = av.open(self._url, options=STREAM_OPTIONS, timeout=ANSWERS_IN_S)
        except (av.error.FFmpegError, UnicodeError) as error:
            told = getattr(error, "strerror", "") or "not a URL"  # the error itself contains the password
            why = next((why for kind, why in REASONS.items() if isinstance(error, kind)), f"cannot be read: {told}")
            raise SensorLost(f"{shown} {why}") from None
        if not self._container.streams.video:
            raise SensorLost(f"{shown} sends no pictures; correct sensor.source")
        self._choose()


def without_password(url: str) -> str:
    """Return a URL without its user name and password."""
    return re.sub(r"(?<=://)[^/@]*@", "", url)


class FilmWriter:
    """Writes pictures of one size to an MP4 file, each with its own time."""

    def __init__(self, path: Path) -> None:
        self._container = av.open(str(path), "w")
        self._stream: Any = None
        self._begin_ns = 0
        self._last_ms = -1

    def write(self, picture: U8, *, time_ns: int) -> None:
        """Add a picture (h, w, 3). An odd last row or column is left out. Times are on any clock, and ascend."""
        height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
        if self._stream is None:
            self._stream, self._begin_ns = self._container.add_stream("mpeg4", rate=1000), time_ns
            self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"
            self._stream.codec_context.time_base = Fraction(1, 1000)
            self._stream.bit_rate = 8 * width * height  # as much as keeps thin marks sharp
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
        self._last_ms = max(round((time_ns - self._begin_ns) / NS_PER_MS), self._last_ms + 1)
        frame.pts, frame.time_base = self._last_ms, Fraction(1, 1000)
        self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        if self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()


def _unnamed(kinds: type[SideData], value: int) -> Any:
    """Return a kind of side data that PyAV does not name, for which it would refuse all side data of the frame."""
    kind: Any = object.__new__(kinds)
    kind._name_, kind._value_ = str(value), value
    return kind


SideData._missing_ = classmethod(_unnamed)  # type: ignore[assignment, method-assign]


def _side_data(frame: av.VideoFrame) -> dict[str, bytes]:
    """Return what FFmpeg reports with a frame, by the names of AVFrameSideDataType."""
    return {item.type.name: bytes(item) for item in cast(Any, frame.side_data)}


def _header(frames: tuple[av.VideoFrame, ...], stream: Any) -> FilmHeader:
    """Return a film's declarations, as FFmpeg reports them with the first picture."""
    frame, views = frames[0], len(frames)
    side = _side_data(frame)
    kind, flags, view = struct.unpack_from("<3i", side.get("STEREO3D", bytes(12)))
    layout = STEREO.get(kind, "")
    if stream.metadata.get("stereo_mode", "").startswith("anaglyph_cyan"):
        layout = "anaglyph"
    is_unseen = views == 1 and 3 <= kind <= 8
    left_out = f"its second view ({UNSEEN[kind - 3]}); convert it to side by side" if is_unseen else ""
    right_first = view == RIGHT or bool((layout or views == 2) and flags & 1)
    aspect = float(stream.sample_aspect_ratio or 1) or 1.0
    aspect = aspect if frame.rotation % 180 == 0 else 1 / aspect
    projection = struct.unpack_from("<i", side.get("SPHERICAL", RECTILINEAR.to_bytes(4, "little")))[0]
    return FilmHeader(layout, projection != RECTILINEAR, left_out, aspect, views, right_first)


def _progressive(frame: av.VideoFrame) -> Any:
    """Return a filter that interpolates the lines of interlaced frames like the given one."""
    graph = av.filter.Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
    graph.link_nodes(source, graph.add("bwdif", "mode=send_frame:deint=interlaced"), graph.add("buffersink"))
    graph.configure()
    return graph


def rgb_of(frame: av.VideoFrame, background: Colour = (0.0, 0.0, 0.0)) -> U8:
    """Convert a frame to an upright picture (h, w, 3) in sRGB, over a background."""
    if frame.colorspace == UNSPECIFIED and (frame.width >= 1280 or frame.height > 576):  # as players do
        frame.colorspace = BT709
    if any(component.is_alpha for component in frame.format.components):
        rgba = np.asarray(frame.to_ndarray(format="rgba"), np.uint8)
        picture = composed(rgba[..., :3], rgba[..., 3:], background)
    else:
        picture = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
    if frame.color_trc in BRIGHT:
        picture = srgb_from(picture, primaries=frame.color_primaries, transfer=frame.color_trc)
    a, b, c, d = struct.unpack_from("<2i4x2i", _side_data(frame).get("DISPLAYMATRIX", bytes(36)))
    upright = picture[::-1] if a * d < b * c else picture  # mirrored, as some phones record their front camera
    return np.ascontiguousarray(np.rot90(upright, round(frame.rotation / 90) % 4))
