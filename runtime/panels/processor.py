"""Draw the panels' pictures on the processor, for display PCs without a GPU.

A software rasteriser runs the shader of `presentation` for one pixel after another and takes ten times as long. The
pictures are the same to within rounding, because both follow `runtime.optics.alignment.shown_layers`.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np

from runtime.config import PanelSettings
from runtime.kernels import CURVE_ENTRIES, CURVE_STEPS, ScaleShift, ShownPanel, library
from runtime.optics.alignment import scale_and_shift
from runtime.optics.malus import rest_code
from runtime.optics.relief import displacement
from runtime.panels import lut
from runtime.panels.geometry import layer_from_screen, panel_from_screen, permutes_pixels
from runtime.panels.presentation import shows_flat, shows_solved
from runtime.records import F32, F64, U8, PanelFrame

MOST_THREADS = 4  # more threads would be limited by the memory
IDENTITY = np.eye(3)
Array = TypeVar("Array", U8, F32)


@dataclass(frozen=True, slots=True)
class Mounting:
    """Mounting of a panel whose monitor shows the layer's pixels, mirrored or turned by quarters."""

    rotation_deg: int
    mirror: str
    layer_from_screen: F64  # (3, 3) map from monitor pixels to layer pixels

    @classmethod
    def of(cls, settings: PanelSettings, *, screen_px: tuple[int, int], layer_px: tuple[int, int]) -> Mounting | None:
        """Return a panel's mounting, or None if its pictures must be resampled for the monitor.

        Args:
            settings: The panel's settings.
            screen_px: The monitor's width and height.
            layer_px: Width and height of each of the stack's panels.
        """
        matrix = layer_from_screen(
            screen_width_px=screen_px[0], screen_height_px=screen_px[1],
            layer_width_px=layer_px[0], layer_height_px=layer_px[1],
            rotation_deg=settings.rotation_deg, mirror=settings.mirror, homography=settings.homography,
        )  # fmt: skip
        return cls(settings.rotation_deg, settings.mirror, matrix / matrix[2, 2]) if permutes_pixels(matrix) else None

    def screen_from_picture(self, size_px: tuple[int, int]) -> F64:
        """Return the (3, 3) map from a picture's pixels, as seen by the viewer, to its pixels on the monitor.

        Args:
            size_px: The picture's width and height. It may be coarser than the panel.
        """
        width, height = size_px[::-1] if self.rotation_deg in (90, 270) else size_px
        turn = panel_from_screen(
            screen_width_px=width, screen_height_px=height, rotation_deg=self.rotation_deg, mirror=self.mirror
        )
        back = turn[:2, :2].T  # the inverse of quarter turns and mirrorings
        return np.block([[back, -back @ turn[:2, 2:]], [np.array([[0.0, 0.0, 1.0]])]])

    def on_screen(self, picture: Array) -> Array:
        """Turn a picture, (h, w) or (h, w, 4), from how the viewer sees it to how the monitor shows it."""
        matrix = self.screen_from_picture((picture.shape[1], picture.shape[0]))
        if matrix[0, 0] == 0.0:
            picture, matrix = np.swapaxes(picture, 0, 1), matrix[:, [1, 0, 2]]
        return picture[:: int(matrix[1, 1]), :: int(matrix[0, 0])]


@dataclass(slots=True)
class _Pictures:
    """Pictures of one version, one for each panel, prepared for drawing."""

    version: int
    size_px: tuple[int, int]  # width and height as seen by the viewer
    border_px: int
    pictures: tuple[U8, ...]  # turned for the monitors, in the order of bytes that X expects
    reliefs: tuple[F32, ...] = ()


class ProcessorPainter:
    """Draws frames into pictures in memory, one for each panel."""

    def __init__(self, panels: Sequence[PanelSettings], mountings: Sequence[Mounting], screens: Sequence[U8]) -> None:
        """Prepare to draw.

        Args:
            panels: Panel settings, rear to front.
            mountings: Each panel's mounting.
            screens: For each panel, the (h, w, 4) picture to draw into, in BGRX order.

        Raises:
            InputError: A grey curve's file cannot be read or is invalid.
        """
        self._mountings, self._screens = mountings, screens
        self._curves = [_fine_curve(panel) if panel.lut or panel.gamma != 1 else None for panel in panels]
        self._solved: _Pictures | None = None
        self._flat: _Pictures | None = None
        self._drawn: list[object] = [None] * len(screens)  # what each picture shows
        self._threads = min(len(os.sched_getaffinity(0)), MOST_THREADS)

    def draw(self, frame: PanelFrame) -> list[int]:
        """Draw a frame, and return the numbers of the panels whose pictures have changed."""
        solved = self._prepared_solution(frame) if shows_solved(frame) else None
        flat = self._prepared_flat(frame) if shows_flat(frame) else None
        shown = [self._shown(panel, frame, solved, flat) for panel in range(len(self._screens))]
        changed = [panel for panel, (what, _) in enumerate(shown) if what != self._drawn[panel]]
        if changed:
            panels = (ShownPanel * len(changed))(*(shown[panel][1] for panel in changed))
            library().draw_panels(panels, len(changed), self._threads)
        for panel in changed:
            self._drawn[panel] = shown[panel][0]
        return changed

    def _prepared_solution(self, frame: PanelFrame) -> _Pictures:
        assert frame.solved is not None
        if self._solved is None or self._solved.version != frame.solved_version:
            height, width = frame.solved.shape[1:3]
            coarse = frame.size_px not in (None, (width, height))
            pictures = self._prepared(frame.solved, border_px=2 if coarse else 1, extended=coarse)
            reliefs = () if frame.relief is None else tuple(
                np.ascontiguousarray(mounting.on_screen(frame.relief)) for mounting in self._mountings
            )  # fmt: skip
            self._solved = _Pictures(frame.solved_version, (width, height), 1 + coarse, pictures, reliefs)
        return self._solved

    def _prepared_flat(self, frame: PanelFrame) -> _Pictures:
        assert frame.flat is not None
        if self._flat is None or self._flat.version != frame.flat_version:
            size_px = frame.flat.shape[2], frame.flat.shape[1]
            self._flat = _Pictures(frame.flat_version, size_px, 0, self._prepared(frame.flat, border_px=0))
        return self._flat

    def _prepared(self, layers: U8, *, border_px: int, extended: bool = False) -> tuple[U8, ...]:
        """Turn layers for the monitors, and surround them with the rest code.

        Args:
            layers: (N, h, w, 4) RGBA layers.
            border_px: Width of the border.
            extended: True to repeat the layers' edge pixels in the innermost pixel of the border.
        """
        rest = min(rest_code(len(layers)), 255)
        pictures: list[U8] = []
        for layer, mounting in zip(layers, self._mountings, strict=True):
            turned: U8 = np.ascontiguousarray(mounting.on_screen(layer))
            if not border_px:
                pictures.append(np.asarray(cv2.cvtColor(turned, cv2.COLOR_RGBA2BGRA), np.uint8))
                continue
            height, width = turned.shape[:2]
            picture = np.full((height + 2 * border_px, width + 2 * border_px, 4), rest, np.uint8)
            cv2.cvtColor(turned, cv2.COLOR_RGBA2BGRA, dst=picture[border_px:-border_px, border_px:-border_px])
            if extended:
                inner = picture[border_px - 1 : border_px + height + 1, border_px - 1 : border_px + width + 1]
                inner[0, 1:-1], inner[-1, 1:-1] = inner[1, 1:-1], inner[-2, 1:-1]
                inner[:, 0], inner[:, -1] = inner[:, 1], inner[:, -2]
            pictures.append(picture)
        return tuple(pictures)

    def _shown(
        self, panel: int, frame: PanelFrame, solved: _Pictures | None, flat: _Pictures | None
    ) -> tuple[object, ShownPanel]:
        """Return what a panel shows, for comparison, and the arguments that draw it."""
        screen, curve = self._screens[panel], self._curves[panel]
        shown = ShownPanel(
            screen=screen.ctypes.data, screen_stride=screen.strides[0], rows=screen.shape[0], columns=screen.shape[1]
        )
        if curve is not None:
            shown.curve = curve.ctypes.data
        source = solved if solved is not None else flat
        assert source is not None
        picture = source.pictures[panel]
        shown.source, shown.source_stride = picture.ctypes.data, picture.strides[0]
        shown.source_rows, shown.source_columns = picture.shape[:2]
        if solved is None:
            shown.source_from_screen = ScaleShift(1.0, 1.0, -0.5, -0.5)
            return ("flat", source.version), shown
        maps = self._maps(panel, frame, solved)
        shown.source_from_screen = ScaleShift(*maps[0])
        if maps[1:]:
            relief = solved.reliefs[panel]
            shown.relief, (shown.relief_rows, shown.relief_columns) = relief.ctypes.data, relief.shape
            shown.relief_from_screen, shown.push = ScaleShift(*maps[1]), ScaleShift(*maps[2])
        if flat is None:
            return (solved.version, *maps), shown
        other = flat.pictures[panel]
        shown.flat, shown.flat_stride, shown.flatness = other.ctypes.data, other.strides[0], frame.flatness
        return (solved.version, *maps, flat.version, frame.flatness), shown

    def _maps(self, panel: int, frame: PanelFrame, solved: _Pictures) -> list[tuple[float, float, float, float]]:
        """Return scales and shifts from a monitor's pixels: to positions in the source and, if the content's relief
        displaces them, to positions in the relief and to the displacement by a relief of 1.

        Positions count from the centre of a picture's top left pixel.
        """  # fmt: skip
        mounting = self._mountings[panel]
        size_px = frame.size_px or solved.size_px
        coarser = np.diag([solved.size_px[0] / size_px[0], solved.size_px[1] / size_px[1], 1.0])
        aligned = frame.solved_from_shown[panel] if frame.solved_from_shown else IDENTITY
        turned = mounting.screen_from_picture(solved.size_px)
        source = turned @ coarser @ aligned @ mounting.layer_from_screen
        source[:2, 2] += solved.border_px - 0.5
        moved = displacement(frame.relief, frame.parallax, panel)
        if moved is None:
            return [scale_and_shift(source)]
        rows, columns = moved.relief.shape
        middle = moved.middle_from_shown @ mounting.layer_from_screen
        to_relief = np.diag([columns / size_px[0], rows / size_px[1], 1.0])
        relief = mounting.screen_from_picture((columns, rows)) @ to_relief @ middle
        relief[:2, 2] -= 0.5
        push = IDENTITY.copy()
        push[:2] = moved.growth * middle[:2]
        push[:2, 2] += moved.drift_px
        push[:2] = moved.weight * turned[:2, :2] @ coarser[:2, :2] @ push[:2]
        return [scale_and_shift(matrix) for matrix in (source, relief, push)]


def _fine_curve(settings: PanelSettings) -> U8:
    """Return a panel's grey curve, (3, CURVE_ENTRIES) codes for blue, green and red, finer than its phases' codes."""
    coarse = lut.curve(lut=settings.lut, gamma=settings.gamma)
    codes = np.arange(CURVE_ENTRIES) / CURVE_STEPS
    greys = [np.interp(codes, np.arange(lut.ENTRIES), coarse[:, channel]) for channel in (2, 1, 0)]
    return np.ascontiguousarray(np.rint(255.0 * np.array(greys)), np.uint8)
