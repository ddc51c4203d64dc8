"""The golden table of frames that all implementations of the presentation law must show alike."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from runtime.config import PanelSettings
from runtime.optics.alignment import align
from runtime.optics.presentation import Interpolation, Mount, panel_draws, shown_picture
from runtime.optics.stack import PanelStack, Tilt
from runtime.panels.presentation import mount_of
from runtime.records import U8, PanelFrame

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.05), 320, 180)
HEAD = np.array([[0.6, -0.031, 0.02], [0.6, 0.031, 0.02]])
KEYSTONE = ((1.01, 0.02, -2.3), (-0.015, 0.99, 1.6), (2e-5, -1e-5, 1.0))
STILL, MOVED, FAR, FARTHEST = (0.0, 0.0, 0.0), (0.02, 0.016, -0.01), (-0.1, -0.2, 0.05), (0.0, 9.0, 0.0)


@dataclass(frozen=True)
class Row:
    """One row of the table."""

    move_m: tuple[float, float, float] = MOVED  # of both eyes
    relief: bool = True
    flatness: float = 0.0
    coarser: int = 1
    settings: PanelSettings = field(default_factory=PanelSettings)
    stack: PanelStack = STACK
    each: tuple[PanelSettings, ...] = ()  # a panel's own, in place of `settings`; its mounting is the same

    def frame(self) -> PanelFrame:
        size = self.stack.height_px // self.coarser, self.stack.width_px // self.coarser
        moved = align(self.stack, solved_for_m=HEAD, eyes_m=HEAD + self.move_m)
        return PanelFrame(
            1, picture(self.stack.count, *size, seed=1), 1, moved.solved_from_shown,
            picture(self.stack.count, self.stack.height_px, self.stack.width_px, seed=2), 1, self.flatness,
            (self.stack.width_px, self.stack.height_px), hills(90, 160) if self.relief else None, moved.parallax,
        )  # fmt: skip

    @property
    def panels(self) -> tuple[PanelSettings, ...]:
        return self.each or (self.settings,) * self.stack.count

    @property
    def screen_px(self) -> tuple[int, int]:
        size_px = self.stack.width_px, self.stack.height_px
        return size_px[::-1] if self.settings.rotation_deg in (90, 270) else size_px

    def mounts(self) -> tuple[Mount, ...]:
        layer_px = self.stack.width_px, self.stack.height_px
        return tuple(mount_of(panel, screen_px=self.screen_px, layer_px=layer_px) for panel in self.panels)

    def reference(self, between: Interpolation, frame: PanelFrame | None = None) -> U8:
        """(N, h, w, 3) what the monitors show, by default of the row's own frame."""
        frame = frame or self.frame()
        assert frame.solved is not None and frame.flat is not None
        draws = panel_draws(frame, self.mounts(), between=between)
        pictures = [shown_picture(*one) for one in zip(draws, frame.solved, frame.flat, strict=True)]
        return np.stack(pictures)[..., :3]


TILTED = PanelStack(0.5184, 0.2916, STACK.x_m, 320, 180, Tilt(((0.0, 0.01, -0.02),) * 3, (0.5, 0.0, 0.0)))
ROWS: dict[str, Row] = {
    "still": Row(STILL),
    "flat": Row(flatness=1.0),
    "aligned": Row(relief=False),
    "reprojected": Row(),
    "mixed": Row(flatness=0.3),
    "off the edge": Row(FAR),
    "at the limit": Row(FARTHEST, relief=False),
    "coarse": Row(STILL, relief=False, coarser=2),
    "coarse, aligned": Row(relief=False, coarser=4),
    "coarse, moved": Row(coarser=3),
    "coarse, mixed": Row(coarser=2, flatness=0.6),
    "tilted": Row(stack=TILTED),
    "two panels": Row(stack=PanelStack(0.5184, 0.2916, (-0.03, 0.03), 320, 180)),
    "curve": Row(settings=PanelSettings(gamma=1.8)),
    "turned, mirrored": Row(settings=PanelSettings(rotation_deg=90, mirror="horizontal")),
    "homography": Row(settings=PanelSettings(homography=KEYSTONE)),
    "homography, still": Row(STILL, settings=PanelSettings(homography=KEYSTONE)),
    "homography, flat": Row(flatness=1.0, settings=PanelSettings(homography=KEYSTONE)),
    "homography, mixed": Row(flatness=0.3, settings=PanelSettings(homography=KEYSTONE, gamma=1.2)),
    "homography, coarse": Row(coarser=2, relief=False, settings=PanelSettings(homography=KEYSTONE)),
    "homography, turned, mirrored": Row(
        settings=PanelSettings(homography=KEYSTONE, rotation_deg=180, mirror="vertical")
    ),
}  # fmt: skip
UNMOUNTED = [name for name, row in ROWS.items() if row.settings == PanelSettings()]  # the browser has no monitors

# The stated tolerance. Drivers may filter the relief and the grey curve with weights of 1/256, and the processor
# computes in fixed point and resamples the flat picture in steps of 1/32 pixel. Without these, no value is off by more
# than one code.
MOST_CODES, MOST_SHARE = 3, 1e-3


def agrees(shown: U8, expected: U8) -> bool:
    """True if pictures are equal to within the tolerance."""
    off = np.abs(shown.astype(int) - expected)
    return bool(off.max() <= MOST_CODES and (off > 1).mean() <= MOST_SHARE)


def picture(count: int, rows: int, columns: int, *, seed: int) -> U8:
    """(n, h, w, 4) codes that change over some pixels, with a hard edge."""
    coarse = np.random.default_rng(seed).integers(0, 256, (count, rows // 6, columns // 6, 4), np.uint8)
    layers = np.stack([cv2.resize(one, (columns, rows), interpolation=cv2.INTER_CUBIC) for one in coarse])
    layers[:, rows // 3 : rows // 2, columns // 4 : columns // 3] = 230
    layers[..., 3] = 255
    return np.asarray(np.maximum(layers, 1), np.uint8)  # 0 is outside


def hills(rows: int, columns: int) -> np.ndarray:
    """A relief with an outline: content in front of, on and behind the middle panel."""
    v, u = np.mgrid[0:rows, 0:columns] / max(rows, columns)
    return (
        np.where(np.hypot(u - 0.5, v - 0.3) < 0.2, 0.2 + 0.1 * u, -0.15 * np.sin(9 * v)).astype(np.float16).astype("f4")
    )
