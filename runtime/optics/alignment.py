"""Align layers that were solved for earlier eyes to the current eyes.

Parallel planes seen from one point differ by a scale and a shift. Let m be the point midway between the eyes. Its ray
through a point c of the reference plane (x = r) meets the panel at x = a at c·k + m·(1 - k), k = (m_x - a) / (m_x - r).
When this midpoint moves from o to n, the ray from n through a point p of the panel is traced to the reference plane,
and from there back to the panel along the ray from o. Both steps are a scale and a shift, so they lead from p to
q = p·s + t. With d = n - o and D = o_x - a,

    s = 1 + d_x·(r - a) / ((D + d_x)·(o_x - r)),    t = (a - r) / (o_x - r) · (o·d_x - d·D) / (D + d_x).

In this form s = 1 and t = 0 without rounding error if the midpoint has not moved or the panel is the reference plane.
Rays from the midpoint map exactly. So do both eyes' rays if the head faces the panels and has moved parallel to them.
If the head has come nearer or moved away, the disparity remains the old one; no shift can change that.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from runtime.optics.malus import rest_code
from runtime.optics.relief import Displacement, displacement, parallax
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8, PanelFrame, Parallax

FARTHEST_M = 1e6  # coordinates beyond this are treated as not finite
NEAREST_M = 0.01  # least distance of an eye from the front panel
MOST_SHIFT = 0.5  # largest shift of a panel's middle, in panel widths or heights
MOST_SCALE = 2.0  # largest enlargement or reduction of a panel
ROWS = 32  # rows per resampled strip; a strip's float32 pixels fit in a core's cache


@dataclass(frozen=True, slots=True)
class Alignment:
    """Maps with which the layers are drawn for the current eyes."""

    solved_from_shown: tuple[F64, ...]  # per panel (3, 3), scale and shift from shown pixels to the solved layer's
    limited: str = ""  # why the alignment stopped short of the current eyes; empty if it did not
    parallax: Parallax | None = None  # motion of content off the middle panel; None: the eyes have not moved


def reference_x_m(stack: PanelStack) -> float:
    """Return x of the reference plane: the centre panel, or halfway between the two middle ones."""
    half = stack.count // 2
    return stack.x_m[half] if stack.count % 2 else (stack.x_m[half - 1] + stack.x_m[half]) / 2


def align(stack: PanelStack, *, solved_for_m: F64, eyes_m: F64) -> Alignment:
    """Align layers solved for eyes (2, 3) to eyes (2, 3) at another position, both in frame `stack`.

    The limits: each eye stays at least `NEAREST_M` in front of the front panel, no panel's middle moves by more than
    `MOST_SHIFT` of its size, and no panel is drawn `MOST_SCALE` times larger or smaller. Beyond a limit, the result is
    the alignment at the farthest allowed point on the straight line from the old eyes to the new ones, so it stays
    continuous. Eyes that are not finite leave the layers unchanged. Never raises.
    """
    if not (np.abs(solved_for_m).max() <= FARTHEST_M and np.abs(eyes_m).max() <= FARTHEST_M):  # nor NaN
        return Alignment(_as_they_are(stack), "the eyes' positions are not finite")
    old, new = _middle(solved_for_m), _middle(eyes_m)
    share, limited = 1.0, ""
    for most, least, why in _limits(stack, solved_for_m, eyes_m, old=old, new=new):
        # Every limit has the form share · most <= least, where `share` is the allowed part of the movement.
        reach = 0.0 if least < 0.0 else 1.0 if most <= least else least / most
        if reach < share:
            share, limited = reach, why
    if share == 0.0:
        return Alignment(_as_they_are(stack), limited)
    step = (new - old) * share
    maps = tuple(_solved_from_shown(stack, n, old=old, step=step) for n in range(stack.count))
    return Alignment(maps, limited, parallax(stack, old_m=old, new_m=old + step))


def scale_and_shift(matrix: F64) -> tuple[float, float, float, float]:
    """Return (scale_u, scale_v, shift_u, shift_v) of a 3x3 matrix.

    Raises ValueError if the matrix is not just a scale and a shift.
    """
    (su, a, tu), (b, sv, tv), last = matrix.tolist()
    if a or b or last != [0.0, 0.0, 1.0]:
        raise ValueError("an alignment must be a scale and a shift")
    return su, sv, tu, tv


def is_identity(matrix: F64) -> bool:
    """Return True if this alignment shows the solved pixels without resampling."""
    return scale_and_shift(matrix) == (1.0, 1.0, 0.0, 0.0)


def shown_layers(frame: PanelFrame) -> U8:
    """Return the (N, h, w, 4) layers exactly as shown, before each panel's curve, rotation and mirroring.

    This function is the reference for the presentation shader. It samples bilinearly with exact weights (for moved
    eyes, bicubic sampling was never better by more than 0.05 dB: docs/mathematics.md), enlarges a coarse solution in
    the same pass, fills pixels outside the layer with the rest code, and mixes in the flat picture before rounding. If
    the frame needs none of this, its own array is returned. Raises ValueError if the frame has nothing to show.
    """
    flatness = 1.0 if frame.solved is None else frame.flatness
    if flatness > 0.0 and frame.flat is None:
        raise ValueError("the frame has no flat picture")
    flat = None if flatness <= 0.0 else frame.flat
    if flatness >= 1.0 or frame.solved is None:
        assert flat is not None
        return flat
    solved = frame.solved
    maps = frame.solved_from_shown or (np.eye(3),) * len(solved)
    width, height = frame.size_px or (solved.shape[2], solved.shape[1])
    coarse = (height, width) != solved.shape[1:3]
    moved = [displacement(frame.relief, frame.parallax, n) for n in range(len(solved))]
    still = [is_identity(matrix) and moved[n] is None for n, matrix in enumerate(maps)]
    if flatness <= 0.0 and not coarse and all(still):
        return solved
    out = np.empty((len(solved), height, width, 4), np.uint8)
    for n, matrix in enumerate(maps):
        mixed = None if flat is None else flat[n]
        if mixed is None and not coarse and still[n]:
            out[n] = solved[n]
            continue
        where = moved[n]
        how = _resampled if where is None else partial(_displaced, where)
        for rows, codes in how(solved[n], matrix, rest_code(len(solved)), size=(height, width)):
            if mixed is not None:
                codes += (mixed[rows] - codes) * np.float32(flatness)
            codes += np.float32(0.5)
            np.copyto(out[n, rows], codes, casting="unsafe")
    return out


def _middle(eyes_m: F64) -> F64:
    middle: F64 = (eyes_m[0] + eyes_m[1]) / 2
    return middle


def _as_they_are(stack: PanelStack) -> tuple[F64, ...]:
    return tuple(np.eye(3) for _ in range(stack.count))


def _solved_from_shown(stack: PanelStack, index: int, *, old: F64, step: F64) -> F64:
    raster, reference_m = stack.panel(index), reference_x_m(stack)
    distance_m, height_m = old[0] - raster.x_m, old[0] - reference_m
    now_m = distance_m + step[0]
    magnified = step[0] * (reference_m - raster.x_m) / (now_m * height_m)
    shift_m = (raster.x_m - reference_m) / height_m * (old[1:] * step[0] - step[1:] * distance_m) / now_m
    matrix = np.eye(3)
    matrix[0, 0] = matrix[1, 1] = 1.0 + magnified
    # The pixels' origin is the top left corner, not the centre.
    matrix[0, 2] = (raster.left_m * magnified + shift_m[0]) / raster.pitch_u_m
    matrix[1, 2] = -(raster.top_m * magnified + shift_m[1]) / raster.pitch_v_m
    matrix += 0.0  # avoids negative zeros
    return matrix


def _limits(
    stack: PanelStack, solved_for_m: F64, eyes_m: F64, *, old: F64, new: F64
) -> Iterator[tuple[float, float, str]]:
    """Yield (most, least, why) per limit. A share of the movement is allowed if share · most <= least."""
    front_m = stack.x_m[-1]
    for name, before, after in zip(("left", "right"), solved_for_m, eyes_m, strict=True):
        room_m = before[0] - front_m - NEAREST_M
        why = f"the {name} eye is {after[0] - front_m:.3g} m from the front panel, but the minimum is {NEAREST_M} m"
        yield before[0] - after[0], room_m, why
        if room_m < 0.0:
            return
    reference_m, step = reference_x_m(stack), new - old
    moved_m = float(np.linalg.norm(step))
    for n, x_m in enumerate(stack.x_m):
        if x_m == reference_m:
            continue
        why = f"the eyes are {moved_m:.3g} m from where the layers were solved for, which is too far to align panel {n}"
        distance_m, weight = old[0] - x_m, (x_m - reference_m) / (old[0] - reference_m)
        for axis, size_m in ((1, stack.width_m), (2, stack.height_m)):
            shift = abs(weight * (old[axis] * step[0] - step[axis] * distance_m))
            yield shift - MOST_SHIFT * size_m * step[0], MOST_SHIFT * size_m * distance_m, why
        larger, smaller = MOST_SCALE - 1.0, 1.0 / MOST_SCALE - 1.0
        yield step[0] * (-weight - larger), larger * distance_m, why
        yield step[0] * (weight + smaller), -smaller * distance_m, why


def _places(count: int, shown: int, *, scale: float, shift: float) -> tuple[NDArray[np.intp], F32]:
    """Return the source pixel before each of `shown` pixels, and the distance past it.

    Indices are those of a source padded by one pixel, so 0 is its border.
    """
    place = np.clip((np.arange(shown) + 0.5) * scale + shift - 0.5, -1.0, count)
    first = np.minimum(np.floor(place), count - 1.0)
    return first.astype(np.intp) + 1, (place - first).astype(np.float32)


def _resampled(layer: U8, matrix: F64, rest: int, *, size: tuple[int, int]) -> Iterator[tuple[slice, F32]]:
    """Yield strips of rows of a shown layer of `size` (height, width), with unrounded codes (rows, w, 4).

    Each strip overwrites the codes of the one before. A coarse layer is extended by a pixel on every side, so that it
    does not fade at its edge.
    """
    su, sv, tu, tv = scale_and_shift(matrix)
    height, width = layer.shape[:2]
    if (height, width) != size:
        by_u, by_v = width / size[1], height / size[0]
        su, tu, sv, tv = su * by_u, tu * by_u + 1, sv * by_v, tv * by_v + 1
        layer = np.pad(layer, ((1, 1), (1, 1), (0, 0)), mode="edge")
        height, width = layer.shape[:2]
    columns, across = _places(width, size[1], scale=su, shift=tu)
    rows, down = _places(height, size[0], scale=sv, shift=tv)
    for begin in range(0, size[0], ROWS):
        strip = slice(begin, min(begin + ROWS, size[0]))
        first, weight = rows[strip], down[strip, None, None]
        low, high = int(first.min()), int(first.max()) + 2  # rows of the padded layer
        source = np.full((high - low, width + 2, 4), rest, np.float32)
        source[..., 3] = 255.0
        inside = slice(max(low, 1), min(high, height + 1))
        source[inside.start - low : max(inside.stop, inside.start) - low, 1:-1] = layer[
            inside.start - 1 : inside.stop - 1
        ]
        lines = _between(source.take(first - low, axis=0), source.take(first + 1 - low, axis=0), weight)
        # Gather each pixel of four floats as one number.
        pixels = lines.view(np.complex128)[..., 0]
        left, right = (
            pixels.take(columns + k, axis=1).view(np.float32).reshape(*pixels.shape[:1], size[1], 4) for k in (0, 1)
        )
        yield strip, _between(left, right, across[:, None])


def _displaced(
    displacement: Displacement, layer: U8, matrix: F64, rest: int, *, size: tuple[int, int]
) -> Iterator[tuple[slice, F32]]:
    """Yield strips like those of `_resampled`, with a separate displacement for every pixel."""
    su, sv, tu, tv = scale_and_shift(matrix)
    height, width = layer.shape[:2]
    by_u, by_v, extended = width / size[1], height / size[0], int((height, width) != size)
    # The rest code surrounds the layer. A coarse layer is first extended by one pixel of its edge.
    padded = np.pad(layer, ((extended, extended), (extended, extended), (0, 0)), mode="edge")
    padded = np.pad(padded, ((1, 1), (1, 1), (0, 0)), constant_values=rest).astype(np.float32)
    padded[..., 3] = 255.0
    pixels, stride = padded.view(np.complex128).ravel(), padded.shape[1]
    columns = np.arange(size[1]) + 0.5
    for begin in range(0, size[0], ROWS):
        strip = slice(begin, min(begin + ROWS, size[0]))
        rows = np.arange(strip.start, strip.stop) + 0.5
        right, down = displacement.at(columns, rows, size_px=size[::-1])
        u = (columns * su + tu + right) * by_u + (extended + 0.5)
        v = ((rows * sv + tv)[:, None] + down) * by_v + (extended + 0.5)
        u, v = np.clip(u, 0.0, stride - 1.0), np.clip(v, 0.0, len(padded) - 1.0)
        low_u, low_v = np.minimum(np.floor(u), stride - 2.0), np.minimum(np.floor(v), len(padded) - 2.0)
        first = (low_v * stride + low_u).astype(np.intp)
        across, along = (u - low_u).astype(np.float32)[..., None], (v - low_v).astype(np.float32)[..., None]
        corners = [
            pixels.take(first + step).view(np.float32).reshape(*first.shape, 4) for step in (0, 1, stride, stride + 1)
        ]
        above, below = _between(corners[0], corners[1], across), _between(corners[2], corners[3], across)
        yield strip, _between(above, below, along)


def _between(low: F32, high: F32, weight: F32) -> F32:
    """Return low · (1 - weight) + high · weight, computed in `low`; `high` is overwritten."""
    high -= low
    high *= weight
    low += high
    return low
