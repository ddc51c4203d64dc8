"""Implementation of `phasestack eyes`: find pupils in pictures, and draw overlays."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import closing, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from runtime.clock import NS_PER_S, MonotonicClock
from runtime.config import Settings
from runtime.errors import EndOfRecording, SensorTimeout
from runtime.eyes.detect import EyeFinder
from runtime.eyes.face_flow import RIGID
from runtime.eyes.pupils import Pupils
from runtime.records import U8, SensorFrame
from runtime.sensor.recording import Recording
from runtime.sensor.registry import open_sensor
from runtime.support.artifacts import OutputFolder, png_bytes
from runtime.support.picture_file import read_image
from runtime.support.picture_header import VIDEOS

if TYPE_CHECKING:
    from runtime.support.film import FilmWriter

RECORDING = ".mcap"
OVERLAY_MIN_PX = 640  # an overlay's longer side has at least this many pixels
PRIVATE = 0o600  # file mode for pictures that show faces
GREEN, RED, WHITE = (60, 220, 60), (230, 60, 60), (255, 255, 255)
MOST_PEOPLE = 4  # number of people to look for in a picture
Row = dict[str, Any]


class Watcher:
    """Finds eyes, and reports the result for each frame as a row of values."""

    def __init__(self, settings: Settings) -> None:
        cv2.setNumThreads(1)  # like the display loop
        self._finder = EyeFinder(settings, most_people=MOST_PEOPLE)
        self.forget = self._finder.forget

    def look(self, frame: SensorFrame, file: str, number: int | None = None) -> tuple[Row, list[Pupils]]:
        begin = time.perf_counter()
        people = frame.people if frame.colour is None else self._finder.find_all(frame, is_still=number is None)
        ms = 1e3 * (time.perf_counter() - begin)
        pupils, others, points = self._finder.pupils, self._finder.others_pupils, self._finder.points
        reason = self._finder.reason
        if frame.colour is None:
            pupils, others, points = None, [], frame.eyes
            reason = "this sensor delivers eye positions but no pictures" if people else "this sample contains no eyes"
        elif pupils is not None and frame.intrinsics is None:
            reason = ""  # distances cannot be measured without intrinsics
        row = {
            "file": file,
            "frame": number,
            "eyes_px": None if pupils is None else pupils.eyes_px.tolist(),
            "sigma_px": None if pupils is None else pupils.sigma_px,
            "seen": None if pupils is None else pupils.seen,
            "ms": ms,
            "eyes_m": None if points is None else points.eyes_m.tolist(),
            "reason": reason,
            "others_px": [other.eyes_px.tolist() for other in others],
        }
        return row, [*([] if pupils is None else [pupils]), *others]


def look_at_files(
    files: list[Path], settings: Settings, *, sequence: bool, rate_hz: float, out: Path | None
) -> list[Row]:
    """Find the eyes in every frame of pictures, films or recordings, in order, and return a row for each.
    `sequence` follows the viewer from one still picture to the next, at `rate_hz`. Overlays go to `out`, if given.
    Raises InputError, with `out` unchanged, if a file cannot be read or decoded.
    """
    watcher, rows, follows = Watcher(settings), [], False
    with OutputFolder(out) if out is not None else nullcontext() as folder:
        for place, path in enumerate(files):
            is_still = path.suffix.lower() not in (RECORDING, *VIDEOS)
            if not (sequence and is_still and follows):
                watcher.forget()
            follows = is_still
            target = None if folder is None else folder.staging / f"{place:03d}-{path.stem}"
            with _Overlays(target, is_still) as overlays:
                for number, frame in enumerate(_frames(path, place, rate_hz)):
                    row, people = watcher.look(frame, str(path), None if is_still else number)
                    rows.append(row)
                    overlays.add(frame, people, row)
    return rows


def _frames(path: Path, place: int, rate_hz: float) -> Iterator[SensorFrame]:
    """Yield all frames in a file; a still picture's time follows from its place in the sequence. Raises InputError."""
    kind = path.suffix.lower()
    if kind == RECORDING:
        for frame in Recording(path).samples():
            # Ignore the recorded eyes, and look for them in the pictures again.
            yield frame if frame.colour is None else replace(frame, eyes=None)
    elif kind in VIDEOS:
        from runtime.support.film import Film  # PyAV is in an extra

        with closing(Film(path)) as film:
            for number, (time_ns, frames) in enumerate(film.pictures()):
                yield SensorFrame(number, time_ns, colour=film.rgb(frames[:1]))
    else:
        yield SensorFrame(place, round(place * NS_PER_S / rate_hz), colour=read_image(path))


class _Overlays:
    """Writes overlays to a picture or film that only the owner can read. Without a path, does nothing."""

    def __init__(self, target: Path | None, is_still: bool) -> None:
        self._target, self._is_still = target, is_still
        self._film: FilmWriter | None = None

    def __enter__(self) -> _Overlays:
        return self

    def __exit__(self, *_: object) -> None:
        if self._film is not None:
            self._film.close()

    def add(self, frame: SensorFrame, people: list[Pupils], row: Row) -> None:
        if self._target is None or frame.colour is None:
            return
        picture = drawn(frame.colour, people, row)
        path = self._target.with_name(f"{self._target.name}.{'png' if self._is_still else 'mp4'}")
        path.touch(PRIVATE)
        if self._is_still:
            path.write_bytes(png_bytes(picture))
            return
        if self._film is None:
            from runtime.support.film import FilmWriter

            self._film = FilmWriter(path)
        self._film.write(picture, time_ns=frame.capture_ns)


def drawn(picture: U8, people: list[Pupils], row: Row) -> U8:
    """Return a copy of a picture, enlarged if small, with the pupils, face and figures drawn on it."""
    scale = max(1.0, OVERLAY_MIN_PX / max(picture.shape[:2]))
    canvas = np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)
    bits = 4  # number of fractional bits in a coordinate

    def place(point: Any) -> tuple[int, int]:
        x, y = np.rint((np.asarray(point) * scale - 0.5) * (1 << bits)).astype(int)
        return int(x), int(y)

    line = f"no viewer: {row['reason']}"
    for pupils in people:
        for point in pupils.mesh_px[RIGID, :2]:
            cv2.circle(canvas, place(point), 1 << bits, WHITE, -1, cv2.LINE_AA, bits)
        for eye in pupils.eyes_px:
            radius = round(pupils.iris_px / 2 * scale * (1 << bits))
            cv2.circle(canvas, place(eye), radius, GREEN, 1, cv2.LINE_AA, bits)
            for off in ((1, 0), (0, 1)):
                arm = np.array(off) * pupils.iris_px / 6
                cv2.line(canvas, place(eye - arm), place(eye + arm), GREEN, 1, cv2.LINE_AA, bits)
    if row["seen"] is not None:
        line = f"{row['seen']}, sigma {row['sigma_px']:.2f} px {row['reason']}"
    for colour, width in ((0, 0, 0), 3), (GREEN if people else RED, 1):
        cv2.putText(canvas, line, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv2.LINE_AA)
    return canvas


def look_at_sensor(
    settings: Settings, report: Callable[[Row], None], *, out: Path | None, seconds: float = np.inf
) -> None:
    """Find the eyes in a sensor's frames until the time is up, a recording ends or Ctrl-C is pressed.
    `report` gets each frame's row, and `out`, if given, the latest overlay. Raises InputError for the settings, and
    SensorLost if the sensor is missing or has failed.
    """
    watcher, driver = Watcher(settings), open_sensor(settings.sensor, MonotonicClock())
    end = time.monotonic() + seconds
    with OutputFolder(out) if out is not None else nullcontext() as folder, driver:
        target = None if folder is None else folder.staging / settings.sensor.driver
        overlays = _Overlays(target, True)
        with suppress(KeyboardInterrupt, EndOfRecording):
            while time.monotonic() < end:
                with suppress(SensorTimeout):
                    frame = driver.read_newest(settings.sensor.timeout_s)
                    row, people = watcher.look(frame, settings.sensor.driver, frame.sequence)
                    overlays.add(frame, people, row)
                    report(row)
