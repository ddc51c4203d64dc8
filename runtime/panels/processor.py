"""Draw the panels' pictures on the processor, for display PCs without a GPU.

A software rasteriser runs the shader of `presentation` for one pixel after another and takes ten times as long. Both
follow `runtime.optics.alignment.shown_layers`. The pictures are equal to within rounding, except those of coarse
solutions and of panels with a homography. The latter are interpolated linearly here, where the shader uses cubic
weights, which are 0.15 dB better.

This runs on the presenter's thread. At a refresh, it leaves no work to OpenCV's threads, which have a lower priority,
and takes Python's global lock as rarely as possible.
"""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.config import PanelSettings
from runtime.kernels import CURVE_ENTRIES, CURVE_STEPS, ScaleShift, ShownPanel, library
from runtime.optics.alignment import is_identity, scale_and_shift
from runtime.optics.malus import rest_code
from runtime.optics.rect import PixelRect, union
from runtime.optics.relief import displacement
from runtime.optics.stack import between_pixel_centres
from runtime.panels import lut
from runtime.panels.geometry import layer_from_screen, panel_from_screen
from runtime.panels.presentation import shows_flat, shows_solved
from runtime.panels.shown_part import filled_part, limit
from runtime.records import F32, F64, U8, PanelFrame

# If solutions coarser than the panels by this factor are moved by the alignment, they are sampled at every other pixel.
# The pixels between are averages. On the demo scene, this costs 0.05 to 0.3 dB of light.
COARSE = 1.5
MOST_THREADS = 4  # more threads would be limited by the memory
Array = TypeVar("Array", U8, F32)


Line = tuple[float, float]  # scale, and shift in pixels, of a map along one axis


class Axis(NamedTuple):
    """A monitor's axis, where layer pixel = sign · monitor pixel + offset_px along `layer_axis`."""

    layer_axis: int  # 0: to the right, 1: down
    sign: int
    offset_px: float

    def turned(self, line: Line, size_px: tuple[int, int]) -> Line:
        """Turn a map from layer to picture pixels into one from monitor pixels to the turned picture's.

        Args:
            line: Scale and shift of the map along `layer_axis`.
            size_px: The picture's width and height, as seen by the viewer.
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
        """Return a panel's mounting.

        Args:
            settings: The panel's settings.
            screen_px: The monitor's width and height.
            layer_px: Width and height of each of the stack's panels.

        Raises:
            ValueError: The homography is singular or not finite.
        """
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
            layer_axis = int(abs(turn[1, column]) > 0.5)
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
    size_px: tuple[int, int]  # width and height as seen by the viewer
    border_px: int
    pictures: tuple[U8, ...]  # RGBA, turned for the monitors
    boxes: tuple[PixelRect, ...]  # in each picture, what differs from the rest code
    reliefs: tuple[F32, ...] = ()
    rises: tuple[float, ...] = ()  # each relief's largest absolute value


class _PictureMemory:
    """Memory for a picture of any size for each panel.

    It is filled when created, because memory is slow when first used, which would delay a refresh.
    """

    def __init__(self, mountings: Sequence[Mounting]) -> None:
        self._rest = min(rest_code(len(mountings)), 255)
        self._memory = [np.full(0, self._rest, np.uint8)] * len(mountings)
        self._pictures: tuple[U8, ...] = ()
        self._made_for: object = None
        self.pictures([mounting.turned_px for mounting in mountings], border_px=1)

    def pictures(self, sizes_px: list[tuple[int, int]], *, border_px: int) -> tuple[U8, ...]:
        """Return a picture for each panel, with a border of the rest code around a picture to be filled in.

        Args:
            sizes_px: Width and height of each panel's picture, without the border.
            border_px: Width of the border.
        """
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
        self._curves = [_curve_table(panel) if panel.lut or panel.gamma != 1 else None for panel in panels]
        self._solved: _Pictures | None = None
        self._flat: _Pictures | None = None
        self._solved_memory, self._flat_memory = _PictureMemory(mountings), _PictureMemory(mountings)
        self._drawn: list[object] = [None] * len(screens)  # key of each picture's content
        self._filled = [_whole(screen) for screen in screens]  # outside, a picture shows the rest code
        self._threads = min(len(os.sched_getaffinity(0)), MOST_THREADS)

    def draw(self, frame: PanelFrame) -> dict[int, PixelRect]:
        """Draw a frame, and return the part of each panel's picture that has changed, by the panel's number."""
        solved = self._prepared_solution(frame) if shows_solved(frame) else None
        flat = self._prepared_flat(frame) if shows_flat(frame) else None
        is_moved = not all(map(is_identity, frame.solved_from_shown))
        drawn, filled, parts, to_draw = list(self._drawn), list(self._filled), {}, []
        for panel in range(len(self._screens)):
            drawn[panel], shown = self._shown(panel, frame, solved, flat, is_moved=is_moved)
            if drawn[panel] == self._drawn[panel]:
                continue
            filled[panel] = self._filled_by(panel, shown, solved if flat is None else None)
            part = union((filled[panel], self._filled[panel]))
            if part.width_px:
                limit(shown, part)
                to_draw.append(shown)
                parts[panel] = part
        if to_draw:
            library().draw_panels((ShownPanel * len(to_draw))(*to_draw), len(to_draw), self._threads)
        self._drawn, self._filled = drawn, filled
        return parts

    def _filled_by(self, panel: int, shown: ShownPanel, solved: _Pictures | None) -> PixelRect:
        """Return the part of a panel's picture outside which it shows the rest code.

        Args:
            panel: The panel's number.
            shown: Arguments that draw the whole picture.
            solved: The solution, or None if the flat picture is shown or mixed in.
        """
        if solved is None:
            return _whole(self._screens[panel])
        mounting, rise = self._mountings[panel], solved.rises[panel] if shown.relief else 0.0
        return filled_part(shown, solved.boxes[panel], rise=rise, screen_from_panel=mounting.screen_from_turned)

    def _prepared_solution(self, frame: PanelFrame) -> _Pictures:
        assert frame.solved is not None
        if self._solved is None or self._solved.version != frame.solved_version:
            height, width = frame.solved.shape[1:3]
            coarse = frame.size_px not in (None, (width, height))
            memory, border_px = self._solved_memory, 2 if coarse else 1
            pictures, boxes = self._prepared(frame.solved, memory, border_px=border_px, extended=coarse)
            reliefs: tuple[F32, ...] = ()
            rises: tuple[float, ...] = ()
            if frame.relief is not None:
                reliefs = tuple(
                    _registered(mounting.on_screen(frame.relief), mounting, screen_px=_size_px(screen), reduced=True)
                    for mounting, screen in zip(self._mountings, self._screens, strict=True)
                )
                rises = tuple(float(np.abs(relief).max()) for relief in reliefs)
            self._solved = _Pictures(frame.solved_version, (width, height), border_px, pictures, boxes, reliefs, rises)
        return self._solved

    def _prepared_flat(self, frame: PanelFrame) -> _Pictures:
        assert frame.flat is not None
        if self._flat is None or self._flat.version != frame.flat_version:
            size_px = frame.flat.shape[2], frame.flat.shape[1]
            pictures = tuple(
                _registered(picture, mounting, screen_px=_size_px(screen))
                for picture, mounting, screen in zip(
                    self._prepared(frame.flat, self._flat_memory, border_px=0)[0],
                    self._mountings,
                    self._screens,
                    strict=True,
                )
            )
            self._flat = _Pictures(frame.flat_version, size_px, 0, pictures, tuple(map(_whole, pictures)))
        return self._flat

    def _prepared(
        self, layers: U8, memory: _PictureMemory, *, border_px: int, extended: bool = False
    ) -> tuple[tuple[U8, ...], tuple[PixelRect, ...]]:
        """Turn layers for the monitors, and surround them with the rest code.

        Args:
            layers: (N, h, w, 4) RGBA layers.
            memory: Memory for the pictures, which replace those last prepared there.
            border_px: Width of the border.
            extended: True to repeat the layers' edge pixels in the innermost pixel of the border.

        Returns:
            The pictures, and in each the box of the pixels that differ from the rest code.
        """
        turned = [mounting.on_screen(layer) for layer, mounting in zip(layers, self._mountings, strict=True)]
        pictures, boxes = memory.pictures([_size_px(layer) for layer in turned], border_px=border_px), []
        for picture, layer in zip(pictures, turned, strict=True):
            rows, columns = layer.shape[:2]
            box = (ctypes.c_int32 * 4)()
            library().frame_picture(
                layer.ctypes.data, *layer.strides[:2], rows, columns, picture.ctypes.data, border_px, extended, box
            )
            boxes.append(PixelRect(*box))
        return pictures, tuple(boxes)

    def _shown(
        self, panel: int, frame: PanelFrame, solved: _Pictures | None, flat: _Pictures | None, *, is_moved: bool
    ) -> tuple[object, ShownPanel]:
        """Return a key that identifies the panel's picture, and the arguments that draw it."""
        screen, curve = self._screens[panel], self._curves[panel]
        shown = ShownPanel(
            screen=screen.ctypes.data,
            screen_stride=screen.strides[0],
            rows=screen.shape[0],
            columns=screen.shape[1],
            every=1,
        )
        if curve is not None:
            shown.curve = curve.ctypes.data
        source = solved if solved is not None else flat
        assert source is not None
        picture = source.pictures[panel]
        shown.source, shown.source_stride = picture.ctypes.data, picture.strides[0]
        shown.source_rows, shown.source_columns = picture.shape[:2]
        if solved is None:
            shown.source_from_panel = ScaleShift(1.0, 1.0, -0.5, -0.5)
            return ("flat", source.version), shown
        maps = self._maps(panel, frame, solved)
        shown.source_from_panel = ScaleShift(*maps[0])
        mounting = self._mountings[panel]
        if mounting.turned_from_screen is not None:
            shown.registered, (shown.panel_columns, shown.panel_rows) = 1, mounting.turned_px
            shown.panel_from_screen[:] = mounting.turned_from_screen.ravel().tolist()
        if maps[1:]:
            relief = solved.reliefs[panel]
            shown.relief, (shown.relief_rows, shown.relief_columns) = relief.ctypes.data, relief.shape
            shown.relief_from_screen, shown.push = ScaleShift(*maps[1]), ScaleShift(*maps[2])
        if flat is None:
            coarse = (frame.size_px or solved.size_px)[0] >= COARSE * solved.size_px[0]
            if coarse and is_moved:
                shown.every = 2
            return (solved.version, *maps), shown
        other = flat.pictures[panel]
        shown.flat, shown.flat_stride, shown.flatness = other.ctypes.data, other.strides[0], frame.flatness
        return (solved.version, *maps, flat.version, frame.flatness), shown

    def _maps(self, panel: int, frame: PanelFrame, solved: _Pictures) -> list[tuple[float, float, float, float]]:
        """Return scales and shifts (scale_u, scale_v, shift_u, shift_v) from the turned layer's pixels.

        The first leads to positions in the source. If the content's relief displaces them, two follow: from the
        monitor's pixels to positions in the relief, and to the displacement by a relief of 1. Positions count from the
        centre of a picture's top left pixel.
        """
        size_px = frame.size_px or solved.size_px
        aligned = scale_and_shift(frame.solved_from_shown[panel]) if frame.solved_from_shown else (1.0, 1.0, 0.0, 0.0)
        moved = displacement(frame.relief, frame.parallax, panel)
        along: list[list[Line]] = [[], [], []]  # for each map, across and down; plain floats, because arrays are slow
        mounting, screen_px = self._mountings[panel], _size_px(self._screens[panel])
        for n, axis in enumerate((mounting.across, mounting.down)):
            to = axis.layer_axis
            coarser = solved.size_px[to] / size_px[to]
            scale, shift = axis.turned((coarser * aligned[to], coarser * aligned[2 + to]), solved.size_px)
            along[0].append((scale, shift + solved.border_px - 0.5))
            if moved is None:
                continue
            middle = scale_and_shift(moved.middle_from_shown)
            relief_px = moved.relief.shape[1], moved.relief.shape[0]
            share = relief_px[to] / size_px[to]
            scale, shift = axis.turned((share * middle[to], share * middle[2 + to]), relief_px)
            along[1].append((scale * mounting.turned_px[n] / screen_px[n], shift - 0.5))
            by = moved.weight * coarser
            at_edge = moved.drift_px[to] + moved.growth * (middle[to] * axis.offset_px + middle[2 + to])
            along[2].append((by * moved.growth * middle[to], axis.sign * by * at_edge))
        return [(across[0], down[0], across[1], down[1]) for across, down in filter(None, along)]


def _whole(picture: U8) -> PixelRect:
    return PixelRect(0, 0, *_size_px(picture))


def _size_px(picture: U8 | F32) -> tuple[int, int]:
    """Return a picture's width and height."""
    return picture.shape[1], picture.shape[0]


def _registered(picture: Array, mounting: Mounting, *, screen_px: tuple[int, int], reduced: bool = False) -> Array:
    """Resample a turned picture for a monitor, if the monitor's pixels do not coincide with the picture's.

    Args:
        picture: Picture (h, w) or (h, w, 4), of the turned layer's size unless it is reduced.
        mounting: The panel's mounting.
        screen_px: The monitor's width and height.
        reduced: True if the picture is smaller than the layer. It keeps its size, and its edge is repeated outwards.
    """
    if mounting.turned_from_screen is None:
        return np.ascontiguousarray(picture)
    matrix, (width, height), border = mounting.turned_from_screen, screen_px, cv2.BORDER_CONSTANT
    if reduced:
        (width, height), border = _size_px(picture), cv2.BORDER_REPLICATE
        reduced_from_turned = np.diag(np.array([width / mounting.turned_px[0], height / mounting.turned_px[1], 1.0]))
        screen_from_reduced = np.diag(np.array([screen_px[0] / width, screen_px[1] / height, 1.0]))
        matrix = reduced_from_turned @ matrix @ screen_from_reduced
    matrix, picture = between_pixel_centres(matrix), np.ascontiguousarray(picture)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpPerspective(picture, matrix, (width, height), flags=flags, borderMode=border)
    return np.asarray(warped, picture.dtype)


def _curve_table(settings: PanelSettings) -> NDArray[np.uint32]:
    """Return a panel's grey curve, (3, CURVE_ENTRIES) pixels, by channel (blue, green, red) and quarters of a code.

    Each pixel has only the channel's byte. The sum of one for each channel is a pixel to display.
    """
    coarse = lut.curve(lut=settings.lut, gamma=settings.gamma)
    codes = np.arange(CURVE_ENTRIES) / CURVE_STEPS
    greys = np.array([np.interp(codes, np.arange(lut.ENTRIES), coarse[:, channel]) for channel in (2, 1, 0)])
    return np.asarray(np.rint(255.0 * greys), np.uint32) << np.array([[0], [8], [16]], np.uint32)
