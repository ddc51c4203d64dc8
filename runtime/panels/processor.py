"""Draw the panels' pictures on the processor, for display PCs without a GPU.

A software rasteriser runs the shader of `presentation` for one pixel after another and takes seven to twenty times as
long. Both follow the records of `runtime.optics.presentation`. Here, solutions are interpolated linearly on registered
panels, and most coarse solutions are sampled at every other pixel (`COARSE`).

This runs on the presenter's thread. At a refresh, it leaves no work to OpenCV's threads, which have a lower priority,
and takes Python's global lock as rarely as possible.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.config import PanelSettings
from runtime.kernels import CURVE_ENTRIES, CURVE_STEPS, library
from runtime.optics.malus import rest_code
from runtime.optics.presentation import Interpolation, Mount, PanelDraw, PixelMap, on_layer, panel_draws
from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import between_pixel_centres
from runtime.panels.geometry import layer_from_screen, panel_from_screen
from runtime.panels.shown_part import Map, ShownPicture, filled_part, limited
from runtime.records import F32, F64, U8, PanelFrame

# If solutions coarser than the panels by this factor are moved by the alignment, they are sampled at every other pixel.
# The pixels between are averages. On the demo scene, this costs 0.05 to 0.3 dB of light.
COARSE = 1.5
MOST_THREADS = 4  # more threads would be limited by the memory
Array = TypeVar("Array", U8, F32)


Line = tuple[float, float]  # scale, and shift in pixels, of a map along one axis
BETWEEN = Interpolation.LINEAR  # how to read solutions on registered panels


class Axis(NamedTuple):
    """A monitor's axis, where layer pixel = sign · monitor pixel + offset_px along `layer_axis`."""

    layer_axis: int  # 0: to the right, 1: down
    sign: int
    offset_px: float

    def turned(self, line: Line, size_px: tuple[int, int]) -> Line:
        """Turn a map from layer to picture pixels into one from monitor to turned picture's, of `size_px`
        seen.
        """
        scale, shift = line
        edge = 0.0 if self.sign > 0 else float(size_px[self.layer_axis])
        return scale, self.sign * (scale * self.offset_px + shift) + edge


class Mounting(NamedTuple):
    """Position of a panel's layer on its monitor: mirrored, turned, and moved by a homography."""

    across: Axis  # axes of the turned layer
    down: Axis
    turned_px: tuple[int, int]  # width and height of the turned layer
    turned_from_screen: F64 | None  # 3x3 homography from the monitor's pixels, or None if they coincide
    screen_from_turned: F64 | None  # its inverse

    @classmethod
    def of(cls, settings: PanelSettings, *, screen_px: tuple[int, int], layer_px: tuple[int, int]) -> Mounting:
        """Return a panel's mounting. Raises ValueError if the homography is singular or not finite."""
        mounted: dict[str, Any] = {"rotation_deg": settings.rotation_deg, "mirror": settings.mirror}
        layer_from_monitor = layer_from_screen(
            screen_width_px=screen_px[0], screen_height_px=screen_px[1],
            layer_width_px=layer_px[0], layer_height_px=layer_px[1],
            homography=settings.homography, **mounted,
        )  # fmt: skip
        turned_px = layer_px[::-1] if settings.rotation_deg in (90, 270) else layer_px
        turn = panel_from_screen(screen_width_px=turned_px[0], screen_height_px=turned_px[1], **mounted)
        axes = []
        for column in (0, 1):
            layer_axis = round(abs(turn[1, column]))
            axes.append(Axis(layer_axis, round(turn[layer_axis, column]), float(turn[layer_axis, 2])))
        turned = np.asarray(np.linalg.solve(turn, layer_from_monitor), np.float64)
        turned /= turned[2] @ np.array([screen_px[0] / 2, screen_px[1] / 2, 1.0])  # its sign is arbitrary
        coincides = turned_px == screen_px and np.allclose(turned, np.eye(3), rtol=0.0, atol=1e-9)
        if coincides:
            return cls(axes[0], axes[1], turned_px, None, None)
        return cls(axes[0], axes[1], turned_px, turned, np.asarray(np.linalg.inv(turned), np.float64))

    def on_screen(self, picture: Array) -> Array:
        """Turn a picture, (h, w) or (h, w, 4), from how the viewer sees it to how the monitor shows it."""
        if self.across.layer_axis == 1:
            picture = np.swapaxes(picture, 0, 1)
        return picture[:: self.down.sign, :: self.across.sign]


@dataclass(slots=True)
class _Pictures:
    """Pictures of one version, one for each panel, prepared for drawing."""

    version: int
    pictures: tuple[U8, ...]  # RGBA, turned for the monitors


@dataclass(slots=True)
class _Solution(_Pictures):
    """Pictures of a solution, which are moved, and surrounded by the rest code."""

    size_px: tuple[int, int]  # width and height as seen by the viewer
    border_px: int
    boxes: tuple[PixelRect, ...]  # in each picture, what differs from the rest code
    reliefs: tuple[F32, ...] = ()
    rises: tuple[float, ...] = ()  # each relief's largest absolute value


class _PictureMemory:
    """Memory for a picture of any size for each panel, filled when created, because first use is slow."""

    def __init__(self, mountings: Sequence[Mounting]) -> None:
        self._rest = min(rest_code(len(mountings)), 255)
        self._memory = [np.full(0, self._rest, np.uint8)] * len(mountings)
        self._pictures: tuple[U8, ...] = ()
        self._made_for: object = None
        self.pictures([mounting.turned_px for mounting in mountings], border_px=1)

    def pictures(self, sizes_px: list[tuple[int, int]], *, border_px: int) -> tuple[U8, ...]:
        """Return a picture for each panel, with a border of the rest code around a picture to be filled in."""
        if self._made_for != (sizes_px, border_px):
            self._made_for = sizes_px, border_px
            self._pictures = tuple(
                self._picture(panel, width + 2 * border_px, height + 2 * border_px, border_px)
                for panel, (width, height) in enumerate(sizes_px)
            )
        return self._pictures

    def _picture(self, panel: int, width: int, height: int, border_px: int) -> U8:
        count = 4 * width * height
        if count > self._memory[panel].size:
            self._memory[panel] = np.full(count, self._rest, np.uint8)
        picture = self._memory[panel][:count].reshape(height, width, 4)
        for lines in (picture, picture.swapaxes(0, 1)):
            lines[:border_px] = lines[len(lines) - border_px :] = self._rest
        return picture


class ProcessorPainter:
    """Draws frames into pictures in memory, one for each panel."""

    def __init__(self, mounts: Sequence[Mount], mountings: Sequence[Mounting], screens: Sequence[U8]) -> None:
        """Prepare to draw into each panel's (h, w, 4) picture, in BGRX order."""
        self._mounts, self._mountings, self._screens = mounts, mountings, screens
        self._curves = [None if mount.curve is None else _curve_table(mount.curve) for mount in mounts]
        self._solved: _Solution | None = None
        self._flat: _Pictures | None = None
        self._solved_memory, self._flat_memory = _PictureMemory(mountings), _PictureMemory(mountings)
        self._drawn: list[object] = [None] * len(screens)  # key of each picture's content
        self._filled = [_whole(screen) for screen in screens]  # outside, a picture shows the rest code
        self._threads = min(len(os.sched_getaffinity(0)), MOST_THREADS)

    def draw(self, frame: PanelFrame) -> dict[int, PixelRect]:
        """Draw a frame, and return the part of each panel's picture that has changed, by the panel's number."""
        draws = panel_draws(frame, self._mounts, between=BETWEEN)
        solved = self._prepared_solution(frame, draws) if draws[0].shows_solved else None
        flat = self._prepared_flat(frame) if draws[0].shows_flat else None
        is_moved = any(draw.moves_solved for draw in draws)
        drawn, filled, parts, to_draw = list(self._drawn), list(self._filled), {}, []
        for panel in range(len(self._screens)):
            drawn[panel], shown = self._shown(panel, draws[panel], solved, flat, is_moved=is_moved)
            if drawn[panel] == self._drawn[panel]:
                continue
            filled[panel] = self._filled_by(panel, shown, solved if flat is None else None)
            part = union((filled[panel], self._filled[panel]))
            if part.width_px:
                to_draw.append((shown if flat is not None else limited(shown, part)).checked())
                parts[panel] = part
        if to_draw:
            library().draw_panels(to_draw, self._threads)
        self._drawn, self._filled = drawn, filled
        return parts

    def _filled_by(self, panel: int, shown: ShownPicture, solved: _Solution | None) -> PixelRect:
        """Return the part of a picture outside which it shows the rest code; `solved` may be None."""
        if solved is None:
            return _whole(self._screens[panel])
        mounting, rise = self._mountings[panel], 0.0 if shown.relief is None else solved.rises[panel]
        return filled_part(shown, solved.boxes[panel], rise=rise, screen_from_panel=mounting.screen_from_turned)

    def _prepared_solution(self, frame: PanelFrame, draws: Sequence[PanelDraw]) -> _Solution:
        assert frame.solved is not None
        if self._solved is None or self._solved.version != frame.solved_version:
            height, width = frame.solved.shape[1:3]
            memory, extended_px = self._solved_memory, [draw.extended_px for draw in draws]
            border_px = 1 + max(extended_px)
            pictures, boxes = self._prepared(frame.solved, memory, border_px=border_px, extended_px=extended_px)
            reliefs: tuple[F32, ...] = ()
            rises: tuple[float, ...] = ()
            if frame.relief is not None:
                reliefs = tuple(np.ascontiguousarray(mounting.on_screen(frame.relief)) for mounting in self._mountings)
                rises = tuple(float(np.abs(relief).max()) for relief in reliefs)
            self._solved = _Solution(frame.solved_version, pictures, (width, height), border_px, boxes, reliefs, rises)
        return self._solved

    def _prepared_flat(self, frame: PanelFrame) -> _Pictures:
        assert frame.flat is not None
        if self._flat is None or self._flat.version != frame.flat_version:
            size_px = frame.flat.shape[2], frame.flat.shape[1]
            turned = self._prepared(frame.flat, self._flat_memory, border_px=0)[0]
            pictures = tuple(map(_registered, turned, self._mountings, self._mounts, [size_px] * len(turned)))
            self._flat = _Pictures(frame.flat_version, pictures)
        return self._flat

    def _prepared(
        self, layers: U8, memory: _PictureMemory, *, border_px: int, extended_px: Sequence[int] = ()
    ) -> tuple[tuple[U8, ...], tuple[PixelRect, ...]]:
        """Turn layers for the monitors, and surround them with the rest code; return them with the boxes that differ
        from it. They replace those last prepared in `memory`. In the innermost `extended_px` of the border, edges are
        repeated.
        """
        turned = [mounting.on_screen(layer) for layer, mounting in zip(layers, self._mountings, strict=True)]
        pictures, boxes = memory.pictures([_size_px(layer) for layer in turned], border_px=border_px), []
        for picture, layer, extended in zip(pictures, turned, extended_px or [0] * len(turned), strict=True):
            boxes.append(PixelRect(*library().frame_picture(layer, picture, border_px, extended)))
        return pictures, tuple(boxes)

    def _shown(
        self, panel: int, draw: PanelDraw, solved: _Solution | None, flat: _Pictures | None, *, is_moved: bool
    ) -> tuple[object, ShownPicture]:
        """Return a key that identifies the panel's picture, and how to draw it."""
        screen, curve, mounting = self._screens[panel], self._curves[panel], self._mountings[panel]
        if solved is None:
            assert flat is not None
            flat_from_screen = (1.0, 1.0, -0.5, -0.5)
            return ("flat", flat.version), ShownPicture(flat.pictures[panel], screen, flat_from_screen, curve=curve)
        maps = self._maps(panel, draw, solved)
        shown = ShownPicture(
            solved.pictures[panel],
            screen,
            maps[0],
            panel_from_screen=mounting.turned_from_screen,
            panel_px=mounting.turned_px[::-1],
            curve=curve,
        )
        if maps[1:]:
            shown = replace(shown, relief=solved.reliefs[panel], relief_from_screen=maps[1], push=maps[2])
        if flat is None:
            every = 2 if is_moved and draw.size_px[0] >= COARSE * draw.solved_px[0] else 1
            return (solved.version, *maps), replace(shown, every=every)
        shown = replace(shown, flat=flat.pictures[panel], flatness=draw.flatness)
        return (solved.version, *maps, flat.version, draw.flatness), shown

    def _maps(self, panel: int, draw: PanelDraw, solved: _Solution) -> list[Map]:
        """Return a record's maps for the turned layer's pixels. The first leads to
        positions in the source. If the content's relief displaces them, two follow: to positions in the relief, and to
        the displacement by a relief of 1. Positions count from the centre of a picture's top left pixel.
        """
        along: list[list[Line]] = [[], [], []]  # for each map, across and down; plain floats, because arrays are slow
        mounting = self._mountings[panel]
        for axis in (mounting.across, mounting.down):
            to = axis.layer_axis
            scale, shift = axis.turned(_along(draw.solved_from_shown, to), solved.size_px)
            along[0].append((scale, shift + solved.border_px - 0.5))
            if draw.relief is None:
                continue
            scale, shift = axis.turned(_along(draw.relief_from_shown, to), (draw.relief.shape[1], draw.relief.shape[0]))
            along[1].append((scale, shift - 0.5))
            scale, shift = _along(draw.push, to)
            along[2].append((scale, axis.sign * (scale * axis.offset_px + shift)))
        return [(across[0], down[0], across[1], down[1]) for across, down in filter(None, along)]


def _along(by: PixelMap, axis: int) -> Line:
    """Return a map's scale and shift along an axis of the layer."""
    return by[axis], by[2 + axis]


def _whole(picture: U8) -> PixelRect:
    return PixelRect(0, 0, *_size_px(picture))


def _size_px(picture: U8 | F32) -> tuple[int, int]:
    """Return a picture's width and height."""
    return picture.shape[1], picture.shape[0]


def _registered(picture: U8, mounting: Mounting, mount: Mount, layer_px: tuple[int, int]) -> U8:
    """Resample a turned (h, w, 4) picture for a monitor, if the monitor's pixels do not coincide with the picture's."""
    picture = np.ascontiguousarray(picture)
    if mounting.turned_from_screen is None:
        return picture
    matrix, flags = between_pixel_centres(mounting.turned_from_screen), cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(picture, matrix, mount.screen_px, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    columns, rows = (np.arange(count) + 0.5 for count in mount.screen_px)
    warped[~on_layer(mount, columns[None], rows[:, None], layer_px)[2]] = 0
    return np.asarray(warped, np.uint8)


def _curve_table(coarse: F32) -> NDArray[np.uint32]:
    """Return a curve as (3, CURVE_ENTRIES) pixels of one byte, by channel (blue, green, red) and quarters of a code.
    The sum of one for each channel is a pixel to display.
    """
    codes = np.arange(CURVE_ENTRIES) / CURVE_STEPS
    greys = np.array([np.interp(codes, np.arange(len(coarse)), coarse[:, channel]) for channel in (2, 1, 0)])
    return np.asarray(np.rint(255.0 * greys), np.uint32) << np.array([[0], [8], [16]], np.uint32)
