"""Photographs from a video device: taken by themselves when the camera is held still somewhere new."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.detect_marks import SeenMarks, find_marks
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.support.artifacts import write_png

STILL_SHARE = 0.002  # of the picture's width: marks that move less between two pictures are held still
NEW_SHARE = 0.02  # marks that moved more than this since every photograph: another place
WANTED = 12
PATIENCE = 3  # pictures held still before one is taken


def open_video(device: str) -> Any:
    """A video device by number, path or address. Raises InputError where it does not open."""
    log = cv2.utils.logging
    before = log.getLogLevel()
    log.setLogLevel(log.LOG_LEVEL_SILENT)  # its own lines say nothing that ours does not
    try:
        video = cv2.VideoCapture(int(device) if device.isdigit() else device)
        if video.isOpened() and device.isdigit():
            # As many pixels as it has: a camera's default is often its least.
            video.set(cv2.CAP_PROP_FRAME_WIDTH, 3840)
            video.set(cv2.CAP_PROP_FRAME_HEIGHT, 2160)
    finally:
        log.setLogLevel(before)
    if not video.isOpened():
        raise InputError("calibrate panels photo", "--device", f"{device} cannot be opened as a video device")
    return video


def one_picture(video: Any) -> U8:
    """(h, w) the next picture of an open device, grey. Raises InputError where there is none."""
    going, picture = video.read()
    if not going:
        raise InputError("calibrate", "--device", "the video device gives no more pictures")
    return np.asarray(picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))


@dataclass
class Taker:
    """Decides which pictures of a video become photographs. No clock, no device."""

    stack: PanelStack
    wanted: int = WANTED
    say: Callable[[str], None] = lambda text: None
    taken: list[SeenMarks] = field(default_factory=list)
    _last: dict[tuple[float, ...], Any] = field(default_factory=dict)
    _still: int = 0
    _told: str = ""

    @property
    def finished(self) -> bool:
        return len(self.taken) >= self.wanted

    def see(self, picture: U8) -> bool:
        """Take in a grey picture (h, w); True where it became a photograph."""
        seen = find_marks(picture, self.stack, name=f"photograph {len(self.taken) + 1}")
        places = _places(seen)
        if seen.fault:
            self._last, self._still = {}, 0
            self._tell(f"the picture {seen.fault}")
            return False
        moved = _moved(self._last, places) / seen.width_px
        self._last = places
        self._still = self._still + 1 if moved < STILL_SHARE else 0
        if self._still < PATIENCE:
            self._tell("hold still" if self._new(places, seen.width_px) else self._where())
            return False
        if not self._new(places, seen.width_px):
            self._tell(self._where())
            return False
        self.taken.append(seen)
        self._still = 0
        self._tell(f"taken: {len(self.taken)} of {self.wanted}, {len(seen.panel)} points")
        return True

    def _new(self, places: dict[tuple[float, ...], Any], width_px: int) -> bool:
        return all(_moved(_places(other), places) > NEW_SHARE * width_px for other in self.taken)

    def _where(self) -> str:
        return "go on to another place: left, right, above, below, the camera on its side"

    def _tell(self, text: str) -> None:
        if text != self._told:
            self._told = text
            self.say(text)


def _places(seen: SeenMarks) -> dict[tuple[float, ...], Any]:
    return {
        (float(panel), *point): place
        for panel, point, place in zip(seen.panel.tolist(), seen.panel_px.tolist(), seen.image_px, strict=True)
    }


def _moved(before: dict[tuple[float, ...], Any], now: dict[tuple[float, ...], Any]) -> float:
    """By how many pixels most of the saddles moved that both see; infinite where they share few."""
    common = before.keys() & now.keys()
    if len(common) < 8:
        return float("inf")
    return float(np.percentile([np.linalg.norm(before[key] - now[key]) for key in common], 70))


def take_live(
    device: str, stack: PanelStack, *, wanted: int, say: Callable[[str], None], stop: Callable[[], bool],
    keep: Path | None = None,
) -> list[SeenMarks]:  # fmt: skip
    """Photographs from a video device until there are enough, the video ends, or `stop` answers True.

    keep: a folder in which each photograph is left as PNG. Raises InputError.
    """
    video = open_video(device)
    taker = Taker(stack, wanted=wanted, say=say)
    try:
        while not taker.finished and not stop():
            going, picture = video.read()
            if not going:
                break
            grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
            if taker.see(np.asarray(grey)) and keep is not None:
                write_png(keep / f"photograph-{len(taker.taken):02d}.png", np.asarray(grey))
    finally:
        video.release()
    return taker.taken
