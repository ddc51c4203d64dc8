"""The presentation law: which grey levels a monitor shows for a frame.

`panel_draws` turns a frame into a record for each panel. Everything that draws panels samples by these records and
decides nothing itself: `shown_picture` (the reference), the shader (panels/presentation.py), the processor
(panels/processor.py, kernels/panels.cpp) and the browser (browser/assets/display.js). A table of frames tests all four,
the browser without panels' own settings, which it does not have (tests/panels/test_presentation_table.py).

The monitor's pixel with centre s shows the layer's point p = layer_from_screen·s, or the value 0 if p is outside the
layer. There, the solution is read at

    solved_from_shown·p + b(relief_from_shown·p)·push(p)                                                        (P1)

where b is the relief, bilinear and clamped to its edge, and `push` is the displacement by a relief of 1. Pixels outside
the solution have the rest code. Before that, a coarse solution is extended by one pixel, so that its edge does not
fade, and so is one on a monitor whose pixels do not coincide with the layer's. The flat picture is read at p, bilinear
and clamped to its edge, and mixed in before rounding. Last, the grey curve applies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from runtime.optics.malus import rest_code
from runtime.optics.sampling import Pixels, bilinear, projected
from runtime.records import F32, F64, U8, PanelFrame, Parallax

ROWS = 32  # rows resampled at a time; a strip's float32 pixels fit in a core's cache


class PixelMap(NamedTuple):
    """Map of pixel positions (u, v), or from these to displacements."""

    scale_u: float
    scale_v: float
    shift_u: float
    shift_v: float

    def at(self, u: Pixels, v: Pixels) -> tuple[Pixels, Pixels]:
        return u * self.scale_u + self.shift_u, v * self.scale_v + self.shift_v

    def then(self, other: PixelMap) -> PixelMap:
        """Return the map that applies this map first, then another."""
        (su, sv, tu, tv), (by_u, by_v, right, down) = self, other
        return PixelMap(su * by_u, sv * by_v, tu * by_u + right, tv * by_v + down)


def scale_and_shift(matrix: F64) -> PixelMap:
    """Return the scale and shift that a 3x3 matrix consists of. Raises ValueError for anything else."""
    (su, a, tu), (b, sv, tv), last = matrix.tolist()
    if a or b or last != [0.0, 0.0, 1.0]:
        raise ValueError("an alignment must be a scale and a shift")
    return PixelMap(su, sv, tu, tv)


UNMOVED = PixelMap(1.0, 1.0, 0.0, 0.0)


class Interpolation(StrEnum):
    """Method of reading the solution between its pixels' centres."""

    COPY = "copy"  # every position is a pixel's centre
    LINEAR = "linear"  # bilinear, with weights of full precision
    CUBIC = "cubic"  # OpenCV's bicubic weights (a = -3/4); 0.15 dB better than bilinear ones for registered panels


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """Position of a layer on its monitor, and the monitor's grey curve."""

    screen_px: tuple[int, int]  # width and height
    layer_from_screen: F64  # 3x3 homography of pixels; the third coordinate is positive at the monitor's centre
    is_exact: bool  # True if the monitor's pixel centres coincide with the layer's, so that no pixel is interpolated
    curve: F32 | None = None  # (256, 3) grey level in 0..1 by code and channel, linear in between; None: the identity


@dataclass(frozen=True, slots=True, eq=False)
class PanelDraw:
    """Record of one panel's picture for a frame. Pixels of layers count from their corners."""

    size_px: tuple[int, int]  # the panel's columns and rows
    solved_px: tuple[int, int]  # the solution's; the panel's without a solution
    rest: int  # code outside the solution
    extended_px: int  # pixels by which the solution's edge is repeated, 0 or 1
    flatness: float  # weight of the flat picture; 1: the solution is not read, 0: the flat picture is not
    interpolation: Interpolation
    solved_from_shown: PixelMap  # from the panel's pixels to the solution's, as are all maps here
    relief: F32 | None = None  # (h, w); None: the content does not move
    relief_from_shown: PixelMap = UNMOVED
    push: PixelMap = UNMOVED  # displacement by a relief of 1
    mount: Mount | None = None  # None: the monitor's pixels are the panel's

    @property
    def shows_solved(self) -> bool:
        return self.flatness < 1.0

    @property
    def shows_flat(self) -> bool:
        return self.flatness > 0.0

    @property
    def moves_solved(self) -> bool:
        """True if the solution is not only enlarged."""
        by = self.solved_px[0] / self.size_px[0], self.solved_px[1] / self.size_px[1]
        return self.solved_from_shown != (*by, 0.0, 0.0)

    @property
    def copies_solved(self) -> bool:
        """True if the panel shows the solution's pixels as they are."""
        return self.interpolation is Interpolation.COPY and not self.shows_flat and self.mount is None

    def solved_at(self, u: Pixels, v: Pixels) -> tuple[Pixels, Pixels]:
        """Return the solution's pixel positions (P1) for panel pixels. u and v are broadcast."""
        x, y = self.solved_from_shown.at(u, v)
        if self.relief is None:
            return x, y
        right, down = _pushed(self.relief, self.relief_from_shown, self.push, u, v)
        return x + right, y + down


def flatness_of(frame: PanelFrame) -> float:
    """Return the flat picture's weight: 0 shows only the solution, 1 only the flat picture."""
    return 1.0 if frame.solved is None else min(max(frame.flatness, 0.0), 1.0)


def panel_draws(
    frame: PanelFrame, mounts: Sequence[Mount] = (), *, between: Interpolation = Interpolation.CUBIC
) -> tuple[PanelDraw, ...]:
    """Return each panel's draw record for a frame on its monitor, by default one that has the panel's own
    pixels. `between` is how to read the solution where a monitor's pixels do not coincide with the layer's. Raises
    ValueError if the frame has no flat picture, but needs one.
    """
    flatness, pictures = flatness_of(frame), frame.flat if frame.solved is None else frame.solved
    if pictures is None or (flatness > 0.0 and frame.flat is None):
        raise ValueError("the frame has no flat picture")
    solved_px = pictures.shape[2], pictures.shape[1]
    size_px = frame.size_px or solved_px
    coarse, rest, draws = solved_px != size_px, min(rest_code(len(pictures)), 255), []
    by = PixelMap(solved_px[0] / size_px[0], solved_px[1] / size_px[1], 0.0, 0.0)
    for n in range(len(pictures)):
        mount = mounts[n] if mounts else None
        matrix, parallax = frame.solved_from_shown[n] if frame.solved_from_shown else None, frame.parallax
        if mounts and frame.on_monitors:
            matrix, parallax = frame.on_monitors[n]
        aligned = UNMOVED if matrix is None else scale_and_shift(matrix)
        relief, moves = None, (UNMOVED, UNMOVED)
        if frame.relief is not None and parallax is not None:
            relief, moves = frame.relief, _moves(parallax, n, frame.relief, size_px, by)
        is_exact, to_solved = mount is None or mount.is_exact, aligned.then(by)
        extended_px = int(coarse or not is_exact)
        still = aligned == UNMOVED and relief is None and not extended_px
        interpolation = Interpolation.COPY if still else Interpolation.LINEAR if is_exact else between
        draws.append(
            PanelDraw(size_px, solved_px, rest, extended_px, flatness, interpolation, to_solved, relief, *moves, mount)
        )
    return tuple(draws)


def displacement(
    motion: Parallax, panel: int, relief: F32, size_px: tuple[int, int], u: Pixels, v: Pixels
) -> tuple[Pixels, Pixels]:
    """Return how far content seen at a panel's pixels has moved there, in these pixels, right and down."""
    return _pushed(relief, *_moves(motion, panel, relief, size_px, UNMOVED), u, v)


def _pushed(relief: F32, relief_from_shown: PixelMap, push: PixelMap, u: Pixels, v: Pixels) -> tuple[Pixels, Pixels]:
    b = bilinear(relief, *relief_from_shown.at(u, v))
    right, down = push.at(u, v)
    return b * right, b * down


def _moves(
    motion: Parallax, panel: int, relief: F32, size_px: tuple[int, int], by: PixelMap
) -> tuple[PixelMap, PixelMap]:
    """Return `relief_from_shown` and `push` for a panel, whose solution is enlarged from pixels `by` as large."""
    middle = scale_and_shift(motion.middle_from_shown[panel])
    push = PixelMap(motion.growth, motion.growth, *motion.drift_px)  # in the middle panel's pixels
    weight = motion.weights[panel]
    weighted = PixelMap(weight * by.scale_u, weight * by.scale_v, 0.0, 0.0)
    to_relief = PixelMap(relief.shape[1] / size_px[0], relief.shape[0] / size_px[1], 0.0, 0.0)
    return middle.then(to_relief), middle.then(push).then(weighted)


def shown_layers(frame: PanelFrame) -> U8:
    """Return a frame's (N, h, w, 4) layers as shown, before curves, rotation and mirroring, without a
    copy if possible. Raises ValueError if the frame needs a flat picture but has none.
    """
    draws = panel_draws(frame)
    if frame.solved is None or not draws[0].shows_solved:
        assert frame.flat is not None
        return frame.flat
    if all(draw.copies_solved for draw in draws):
        return frame.solved
    flat: Sequence[U8 | None] = (None,) * len(draws) if frame.flat is None else list(frame.flat)
    return np.stack([shown_picture(draw, *pair) for draw, *pair in zip(draws, frame.solved, flat, strict=True)])


def shown_picture(draw: PanelDraw, solved: U8 | None, flat: U8 | None) -> U8:
    """Return the (h, w, 4) picture that a monitor shows: the reference for all other implementations.
    Only the pictures that `draw` shows are needed.
    """
    if draw.copies_solved:
        assert solved is not None
        return solved
    width, height = draw.size_px if draw.mount is None else draw.mount.screen_px
    out = np.empty((height, width, 4), np.uint8)
    texels = _surrounded(solved, draw) if draw.shows_solved and solved is not None else None
    for first in range(0, height, ROWS):
        rows = slice(first, min(first + ROWS, height))
        u, v = np.arange(width)[None] + 0.5, np.arange(rows.start, rows.stop)[:, None] + 0.5
        inside: NDArray[np.bool_] | None = None
        if draw.mount is not None:
            u, v, inside = on_layer(draw.mount, u, v, draw.size_px)
        codes: F32 = np.zeros((1, 1, 4), np.float32)
        if texels is not None:
            codes = _read(texels, *draw.solved_at(u, v), draw)
        if draw.shows_flat:
            assert flat is not None
            mixed = bilinear(flat, u, v)
            codes = np.asarray(codes + (mixed - codes) * np.float32(draw.flatness), np.float32)
        if inside is not None:
            codes = np.where(inside[..., None], codes, np.float32(0))
        if draw.mount is not None and draw.mount.curve is not None:
            entries, curve = np.arange(256), draw.mount.curve
            for channel in range(3):
                codes[..., channel] = 255 * np.interp(codes[..., channel], entries, curve[:, channel])
        np.copyto(out[rows], codes + np.float32(0.5), casting="unsafe")
    return out


def on_layer(mount: Mount, u: Pixels, v: Pixels, size_px: tuple[int, int]) -> tuple[Pixels, Pixels, NDArray[np.bool_]]:
    """Return the layer's positions for monitor pixels, and a mask of those inside the layer."""
    x, y, w = projected(mount.layer_from_screen, u, v)
    inside = (w > 0) & (x >= 0) & (y >= 0) & (x < size_px[0]) & (y < size_px[1])
    return np.where(inside, x, 0.0), np.where(inside, y, 0.0), inside


def _surrounded(solved: U8, draw: PanelDraw) -> F32:
    """Return a layer's codes as float32, extended by `extended_px` and then by one pixel of the rest code."""
    by = draw.extended_px
    extended = np.pad(solved, ((by, by), (by, by), (0, 0)), mode="edge") if by else solved
    padded = np.asarray(np.pad(extended, ((1, 1), (1, 1), (0, 0)), constant_values=draw.rest), np.float32)
    padded[..., 3] = 255.0
    return padded


def _read(texels: F32, u: Pixels, v: Pixels, draw: PanelDraw) -> F32:
    """Return (h, w, 4) codes at positions in the solution, given its `_surrounded` pixels."""
    reach = draw.extended_px + (1, 2)[draw.interpolation is Interpolation.CUBIC]  # farther out, everything is at rest
    x = np.clip(u - 0.5, -float(reach), draw.solved_px[0] + reach - 1.0)
    y = np.clip(v - 0.5, -float(reach), draw.solved_px[1] + reach - 1.0)
    if draw.interpolation is Interpolation.COPY:
        return _taken(texels, np.rint(x), np.rint(y), draw)
    low_x, low_y = np.floor(x), np.floor(y)
    right, down = (x - low_x).astype(np.float32)[..., None], (y - low_y).astype(np.float32)[..., None]
    if draw.interpolation is Interpolation.LINEAR:
        above, below = (
            _between(_taken(texels, low_x, low_y + k, draw), _taken(texels, low_x + 1, low_y + k, draw), right)
            for k in (0, 1)
        )
        return _between(above, below, down)
    across, along = _cubic(right), _cubic(down)
    total: Any = np.float32(0)
    for j in range(4):
        for i in range(4):
            total = total + across[i] * along[j] * _taken(texels, low_x + (i - 1), low_y + (j - 1), draw)
    return np.asarray(np.clip(total, 0.0, 255.0), np.float32)


def _taken(texels: F32, x: Pixels, y: Pixels, draw: PanelDraw) -> F32:
    """Return the pixels in columns x and rows y of the solution."""
    height, width = texels.shape[:2]
    by = draw.extended_px + 1
    columns = np.clip(x.astype(np.intp) + by, 0, width - 1)
    rows = np.clip(y.astype(np.intp) + by, 0, height - 1)
    # A pixel's four floats are gathered as a single number, which is faster.
    found: Any = texels.view(np.complex128).ravel().take(rows * width + columns)
    return np.asarray(found.view(np.float32).reshape(*found.shape, 4), np.float32)


def _cubic(t: F32) -> tuple[F32, F32, F32, F32]:
    """Return the weights of four neighbours for a position t in 0..1 between the middle two."""

    def near(d: F32) -> F32:
        return (np.float32(1.25) * d - np.float32(2.25)) * d * d + np.float32(1)

    def far(d: F32) -> F32:
        return ((np.float32(-0.75) * d + np.float32(3.75)) * d - np.float32(6)) * d + np.float32(3)

    return far(1 + t), near(t), near(1 - t), far(2 - t)


def _between(low: F32, high: F32, weight: F32) -> F32:
    """Return low · (1 - weight) + high · weight, computed in place in `low`. Overwrites `high`."""
    high -= low
    high *= weight
    low += high
    return low
