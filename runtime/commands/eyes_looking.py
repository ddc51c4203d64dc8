"""What `phasestack eyes` does: pictures from files or the sensor through the finder, to rows, overlays, a table."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_S, MonotonicClock
from runtime.config import LimitSettings, Settings
from runtime.errors import EndOfRecording, InputError, SensorTimeout
from runtime.eyes.detect import EyeFinder
from runtime.eyes.face_flow import RIGID
from runtime.eyes.pupils import Pupils
from runtime.records import U8, EyePoints, SensorFrame
from runtime.support import foreign
from runtime.support.artifacts import OutputFolder, png_bytes, read_image
from runtime.support.library_lines import held_back

FILMS = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")
RECORDING = ".mcap"
OVERLAY_MIN_PX = 640  # longer side of an overlay, at least
PRIVATE = 0o600  # a face is its owner's
GREEN, RED, WHITE = (60, 220, 60), (230, 60, 60), (255, 255, 255)
Row = dict[str, Any]


class Watcher:
    """The finder with its clock: a row for every frame."""

    def __init__(self, settings: Settings) -> None:
        cv2.setNumThreads(1)  # as beside the display's loop
        self._finder = EyeFinder(settings)
        self.forget = self._finder.forget

    def look(self, frame: SensorFrame, file: str, number: int | None = None) -> tuple[Row, Pupils | None]:
        begin = time.perf_counter()
        found = frame.eyes if frame.colour is None else self._finder.find(frame)
        ms = 1e3 * (time.perf_counter() - begin)
        pupils, reason = self._finder.pupils, self._finder.reason
        if pupils is not None and frame.intrinsics is None:
            reason = ""  # nobody asks a picture how far away its people are
        if frame.colour is None:
            pupils, reason = None, "this sensor delivers eyes and no pictures" if found else "no eyes in this sample"
        row = {
            "file": file,
            "frame": number,
            "eyes_px": None if pupils is None else pupils.eyes_px.tolist(),
            "sigma_px": None if pupils is None else pupils.sigma_px,
            "seen": None if pupils is None else pupils.seen,
            "ms": ms,
            "eyes_m": None if found is None else found.eyes_m.tolist(),
            "sigma_mm": _sigma_mm(found),
            "reason": reason,
        }
        return row, pupils


def _sigma_mm(found: EyePoints | None) -> list[float] | None:
    """Of the eyes' middle along the axes of the sensor."""
    if found is None or found.covariance_m2 is None:
        return None
    return [float(1e3 * sigma) for sigma in np.sqrt(np.diag(found.covariance_m2))]


def look_at_files(
    files: list[Path], settings: Settings, *, sequence: bool, rate_hz: float, out: Path | None
) -> list[Row]:
    """Rows in the order of the files and their frames. Raises InputError, and then leaves nothing in `out`."""
    watcher, rows = Watcher(settings), []
    with ExitStack() as cleanup:
        folder = cleanup.enter_context(OutputFolder(out)).staging if out is not None else None
        for number, path in enumerate(files):
            kind = path.suffix.lower()
            overlay = None if folder is None else folder / f"{number:03d}-{path.stem}"
            if kind not in (RECORDING, *FILMS):
                if not sequence:
                    watcher.forget()
                picture = SensorFrame(number, round(number * NS_PER_S / rate_hz), colour=read_image(path))
                rows.append(_looked(watcher, picture, str(path), None, overlay))
                continue
            watcher.forget()
            source = _recorded(path, settings.limits) if kind == RECORDING else _filmed(path, rate_hz)
            with Film(overlay, rate_hz) as film:
                for index, frame in enumerate(source):
                    row, pupils = watcher.look(frame, str(path), index)
                    rows.append(row)
                    if frame.colour is not None:
                        film.add(drawn(frame.colour, pupils, row))
            watcher.forget()
    return rows


def _looked(watcher: Watcher, frame: SensorFrame, file: str, number: int | None, overlay: Path | None) -> Row:
    row, pupils = watcher.look(frame, file, number)
    if overlay is not None and frame.colour is not None:
        path = overlay.with_name(f"{overlay.name}.png")
        path.touch(PRIVATE)
        path.write_bytes(png_bytes(drawn(frame.colour, pupils, row)))
    return row


def _recorded(path: Path, limits: LimitSettings) -> Iterator[SensorFrame]:
    from runtime.sensor.recording import Recording

    for frame in Recording(path, limits=limits).samples():
        # What was found when it was recorded is not asked: the pictures are looked at anew.
        yield frame if frame.colour is None else replace(frame, eyes=None)


def _filmed(path: Path, rate_hz: float) -> Iterator[SensorFrame]:
    """Raises InputError for what is no film."""
    foreign.open_regular(path).close()
    with held_back():  # what FFmpeg and OpenCV say of it is one line of ours
        capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        rate = capture.get(cv2.CAP_PROP_FPS)
        rate = rate if 0.1 <= rate <= 1000 else rate_hz
        number = 0
        while True:
            done, bgr = capture.read()
            if not done:
                break
            yield SensorFrame(number, round(number * NS_PER_S / rate), colour=np.ascontiguousarray(bgr[..., ::-1]))
            number += 1
    finally:
        capture.release()
    if not number:
        raise InputError(path, "", "is not a film that can be decoded")


class Film:
    """Overlays as a film, begun with the first; without a place, nothing."""

    def __init__(self, overlay: Path | None, rate_hz: float) -> None:
        self._path = None if overlay is None else overlay.with_name(f"{overlay.name}.mp4")
        self._rate_hz = rate_hz
        self._writer: Any = None

    def __enter__(self) -> Film:
        return self

    def __exit__(self, *_: object) -> None:
        if self._writer is not None:
            self._writer.release()

    def add(self, picture: U8) -> None:
        if self._path is None:
            return
        height, width = picture.shape[0] // 2 * 2, picture.shape[1] // 2 * 2
        if self._writer is None:
            self._path.touch(PRIVATE)
            code = cv2.VideoWriter.fourcc(*"mp4v")
            self._writer = cv2.VideoWriter(str(self._path), cv2.CAP_FFMPEG, code, self._rate_hz, (width, height))
        self._writer.write(np.ascontiguousarray(picture[:height, :width, ::-1]))


def drawn(picture: U8, pupils: Pupils | None, row: Row) -> U8:
    """The picture with pupils, face and what is known of them."""
    scale = max(1.0, OVERLAY_MIN_PX / max(picture.shape[:2]))
    canvas = np.asarray(cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)
    bits = 4  # of a coordinate behind the point

    def place(point: Any) -> tuple[int, int]:
        x, y = np.rint((np.asarray(point) * scale - 0.5) * (1 << bits)).astype(int)
        return int(x), int(y)

    lines = [f"nobody: {row['reason']}"]
    if pupils is not None:
        for point in pupils.mesh_px[RIGID, :2]:
            cv2.circle(canvas, place(point), 1 << bits, WHITE, -1, cv2.LINE_AA, bits)
        for eye in pupils.eyes_px:
            radius = round(pupils.iris_px / 2 * scale * (1 << bits))
            cv2.circle(canvas, place(eye), radius, GREEN, 1, cv2.LINE_AA, bits)
            for off in ((1, 0), (0, 1)):
                arm = np.array(off) * pupils.iris_px / 6
                cv2.line(canvas, place(eye - arm), place(eye + arm), GREEN, 1, cv2.LINE_AA, bits)
        hidden = f" ({pupils.hidden} eye)" if pupils.hidden else ""
        lines = [f"{row['seen']}{hidden}, sigma {row['sigma_px']:.2f} px"]
        if row["eyes_m"] is not None and row["sigma_mm"] is not None:
            lines.append(f"{np.mean(row['eyes_m'], axis=0)[2]:.3f} m, sigma {np.round(row['sigma_mm'], 1)} mm")
        elif row["reason"]:
            lines.append(row["reason"])
    lines.append(f"{row['ms']:.1f} ms")
    for number, line in enumerate(lines):
        for colour, width in ((0, 0, 0), 3), (RED if pupils is None else GREEN, 1):
            cv2.putText(canvas, line, (8, 20 + 18 * number), cv2.FONT_HERSHEY_SIMPLEX, 0.5, colour, width, cv2.LINE_AA)
    return canvas


def look_at_sensor(settings: Settings, *, out: Path | None, seconds: float | None) -> list[Row]:
    """What the configured sensor shows, live in the terminal until Ctrl-C; seconds: silent, and for so long.

    The last overlay is left in `out`. Raises InputError, SensorLost.
    """
    from rich.live import Live

    from runtime.sensor.registry import open_sensor

    watcher, rows, newest = Watcher(settings), [], None
    driver = open_sensor(settings.sensor, MonotonicClock(), limits=settings.limits)
    with ExitStack() as cleanup:
        folder = cleanup.enter_context(OutputFolder(out)).staging if out is not None else None
        cleanup.enter_context(driver)
        live = cleanup.enter_context(Live(transient=False)) if seconds is None else None
        end = time.monotonic() + (seconds or np.inf)
        with suppress(KeyboardInterrupt, EndOfRecording):
            while time.monotonic() < end:
                try:
                    frame = driver.read_newest(settings.sensor.timeout_s)
                except SensorTimeout:
                    if live is not None:
                        live.update(f"nothing from {settings.sensor.driver} for {settings.sensor.timeout_s:g} s")
                    continue
                row, pupils = watcher.look(frame, settings.sensor.driver, frame.sequence)
                if frame.colour is not None:
                    newest = frame.colour, pupils, row
                if live is None:
                    rows.append(row)
                else:
                    live.update(_table(row, frame))
        if folder is not None and newest is not None:
            path = folder / f"{settings.sensor.driver}.png"
            path.touch(PRIVATE)
            path.write_bytes(png_bytes(drawn(*newest)))
    return rows


def _table(row: Row, frame: SensorFrame) -> Any:
    """A frame for the technician who wonders whether the camera sees him: figures, and the picture in letters."""
    from rich.console import Group
    from rich.table import Table

    table = Table(show_header=False)
    table.add_row("frame", str(row["frame"]))
    table.add_row("viewer", str(row["seen"] or ("seen by the sensor" if row["eyes_m"] else "nobody")))
    if row["reason"]:
        table.add_row("", row["reason"])
    if row["eyes_m"] is not None:
        for side, eye in zip(("left eye", "right eye"), row["eyes_m"], strict=True):
            table.add_row(side, " ".join(f"{1e3 * x:7.1f}" for x in eye) + " mm, frame of the sensor")
    if row["sigma_mm"] is not None:
        table.add_row("sigma", " ".join(f"{x:7.1f}" for x in row["sigma_mm"]) + " mm")
    if frame.colour is None:
        return table
    table.add_row("time", f"{row['ms']:.1f} ms")
    return Group(table, _in_letters(frame.colour, row["eyes_px"]))


def _in_letters(picture: U8, eyes_px: list[list[float]] | None) -> str:
    """The picture, mirrored as one sees oneself, in 64 x 20 letters from dark to light; the eyes are O."""
    columns, lines, ramp = 64, 20, " .:-=+*#"
    grey = cv2.resize(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), (columns, lines), interpolation=cv2.INTER_AREA)
    letters = [[ramp[value * len(ramp) // 256] for value in line] for line in grey.tolist()]
    for x, y in eyes_px or ():
        column, line = int(x * columns / picture.shape[1]), int(y * lines / picture.shape[0])
        letters[min(max(line, 0), lines - 1)][min(max(column, 0), columns - 1)] = "O"
    return "\n".join("".join(reversed(line)) for line in letters)
