"""Align layers that were solved for earlier eye positions to the current eye positions.

Seen from one point, two parallel planes are related by a scale and a shift. Let m be the midpoint between the eyes. The
ray from m through a point c on the reference plane (x = r) meets the panel at x = a at the point c·k + m·(1 - k), where
k = (m_x - a) / (m_x - r).

When the midpoint moves from o to n, a point p on the panel is projected onto the reference plane along the ray from n,
and back onto the panel along the ray from o. Each projection is a scale and a shift, so p maps to q = p·s + t. For d =
n - o and D = o_x - a, the coefficients are

    s = 1 + d_x·(r - a) / ((D + d_x)·(o_x - r)),    t = (a - r) / (o_x - r) · (o·d_x - d·D) / (D + d_x).

In this form, s = 1 and t = 0 without any rounding error if the midpoint has not moved or the panel is the reference
plane. The map is exact for rays from the midpoint. It is also exact for rays from both eyes if the head faces the
panels and has moved parallel to them. If the head has moved closer or farther away, the layers keep the disparity they
were solved with, because a shift cannot change it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from runtime.optics.malus import rest_code
from runtime.optics.relief import Displacement, displacement, parallax
from runtime.optics.stack import PanelStack, Plane
from runtime.records import F32, F64, U8, PanelFrame, Parallax

FARTHEST_M = 1e6  # larger coordinates are treated as not finite
NEAREST_M = 0.01  # minimum distance between an eye and the front panel
MOST_SHIFT = 0.5  # maximum shift of a panel's centre, in panel widths or heights
MOST_SCALE = 2.0  # maximum factor for enlarging or reducing a panel
ROWS = 32  # rows resampled at a time; a strip's float32 pixels fit in a core's cache


@dataclass(frozen=True, slots=True)
class Alignment:
    """Transformation that aligns solved layers with the viewer's current eye positions."""

    # For each panel, a (3, 3) scale and shift from shown pixels to the solved layer's pixels.
    solved_from_shown: tuple[F64, ...]
    limited: str = ""  # why the alignment stops short of the current eyes; empty if it reaches them
    # Motion of the content off the middle panel; None if the eyes have not moved or the number of panels is even.
    parallax: Parallax | None = None


def reference_plane(stack: PanelStack) -> Plane:
    """Return an alignment's reference plane.

    It is the centre panel's plane or, if the number of panels is even, the plane halfway between the two middle panels.
    """
    half = stack.count // 2
    return Plane(stack.x_m[half] if stack.count % 2 else (stack.x_m[half - 1] + stack.x_m[half]) / 2)


def align(stack: PanelStack, *, solved_for_m: F64, eyes_m: F64) -> Alignment:
    """Align layers that were solved for other eye positions to the current eyes.

    An alignment has three limits: each eye must be at least `NEAREST_M` in front of the front panel, a panel's centre
    may move by at most `MOST_SHIFT` of the panel's size, and a panel may be enlarged or reduced by at most a factor of
    `MOST_SCALE`. If the current eyes exceed a limit, the layers are aligned to the farthest allowed point on the
    straight line from the old eyes to the current eyes, which keeps the alignment continuous.

    Never raises an exception. If a coordinate is not finite, the layers are left unchanged.

    Args:
        solved_for_m: (2, 3) eyes that the layers were solved for, in frame `stack`.
        eyes_m: (2, 3) current eye positions in frame `stack`.
    """
    if not (np.abs(solved_for_m).max() <= FARTHEST_M and np.abs(eyes_m).max() <= FARTHEST_M):  # also catches NaN
        return Alignment(_as_they_are(stack), "the eye positions are not finite")
    old_m, new_m = _middle(solved_for_m), _middle(eyes_m)
    # This runs at every refresh, and plain floats are several times as fast as small arrays.
    old, moved = old_m.tolist(), (new_m - old_m).tolist()
    share, limit = 1.0, ""
    for most, least, name in _limits(stack, solved_for_m[:, 0].tolist(), eyes_m[:, 0].tolist(), old=old, step=moved):
        # Each limit allows a fraction `share` of the movement if share · most <= least.
        reach = 0.0 if least < 0.0 else 1.0 if most <= least else least / most
        if reach < share:
            share, limit = reach, name
    limited = _reason(limit, stack, eyes_m, moved_m=float(np.linalg.norm(new_m - old_m))) if limit else ""
    if share == 0.0:
        return Alignment(_as_they_are(stack), limited)
    step_m = (new_m - old_m) * share
    reference, step = reference_plane(stack), step_m.tolist()
    maps = tuple(stack.panel(n).to_and_back(reference, old_m=old, step_m=step) for n in range(stack.count))
    return Alignment(maps, limited, parallax(stack, old_m=old_m, new_m=old_m + step_m))


def scale_and_shift(matrix: F64) -> tuple[float, float, float, float]:
    """Split a 3x3 matrix that maps pixels to pixels into (scale_u, scale_v, shift_u, shift_v).

    Raises ValueError if the matrix does anything other than scale and shift.
    """
    (su, a, tu), (b, sv, tv), last = matrix.tolist()
    if a or b or last != [0.0, 0.0, 1.0]:
        raise ValueError("an alignment must be a scale and a shift")
    return su, sv, tu, tv


def is_identity(matrix: F64) -> bool:
    """Return True if a panel's alignment matrix leaves every pixel in place and needs no resampling."""
    return scale_and_shift(matrix) == (1.0, 1.0, 0.0, 0.0)


def shown_layers(frame: PanelFrame) -> U8:
    """Return a frame's (N, h, w, 4) layers before panel curves, rotation and mirroring are applied.

    Reference implementation for the presentation shader. Sampling is bilinear with exact weights; for moved eyes,
    bicubic sampling was never more than 0.05 dB better (docs/mathematics.md). A coarse solution is enlarged in the same
    pass. Pixels outside the layer are filled with the rest code, and the flat picture is mixed in before rounding. If
    the frame needs none of these operations, its array is returned without a copy.

    Raises ValueError if the frame needs a flat picture but has none.
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


def _limits(
    stack: PanelStack, solved_x_m: list[float], eyes_x_m: list[float], *, old: list[float], step: list[float]
) -> Iterator[tuple[float, float, str]]:
    """Yield (most, least, limit) for each of an alignment's limits.

    A fraction `share` of the movement is allowed if share · most <= least. `limit` is `left` or `right` for an eye's
    distance, and the panel's number for its shift and scale.

    Args:
        solved_x_m: x of the left and right eye that the layers were solved for.
        eyes_x_m: x of the current left and right eye.
        old: Midpoint between the eyes that the layers were solved for.
        step: Movement of the midpoint.
    """
    front_m = stack.x_m[-1]
    for name, before_m, after_m in zip(("left", "right"), solved_x_m, eyes_x_m, strict=True):
        room_m = before_m - front_m - NEAREST_M
        yield before_m - after_m, room_m, name
        if room_m < 0.0:
            return
    reference_m = reference_plane(stack).x_m
    for n, x_m in enumerate(stack.x_m):
        if x_m == reference_m:
            continue
        distance_m, weight = old[0] - x_m, (x_m - reference_m) / (old[0] - reference_m)
        for axis, size_m in ((1, stack.width_m), (2, stack.height_m)):
            shift = abs(weight * (old[axis] * step[0] - step[axis] * distance_m))
            yield shift - MOST_SHIFT * size_m * step[0], MOST_SHIFT * size_m * distance_m, str(n)
        larger, smaller = MOST_SCALE - 1.0, 1.0 / MOST_SCALE - 1.0
        yield step[0] * (-weight - larger), larger * distance_m, str(n)
        yield step[0] * (weight + smaller), -smaller * distance_m, str(n)


def _reason(limit: str, stack: PanelStack, eyes_m: F64, *, moved_m: float) -> str:
    """Return the message for an exceeded limit, named as by `_limits`."""
    if limit in ("left", "right"):
        distance_m = eyes_m[("left", "right").index(limit), 0] - stack.x_m[-1]
        return f"the {limit} eye is {distance_m:.3g} m from the front panel, but the minimum is {NEAREST_M} m"
    return (
        f"the eyes are {moved_m:.3g} m from the position that the layers were solved for, which is too far "
        f"to align panel {limit}"
    )


def _places(count: int, shown: int, *, scale: float, shift: float) -> tuple[NDArray[np.intp], F32]:
    """Return source pixels and weights for linear interpolation along one axis.

    Args:
        count: Number of source pixels.
        shown: Number of shown pixels.
        scale: Source pixels per shown pixel.
        shift: Position of the shown pixels' left or top edge, in source pixels.

    Returns:
        For each shown pixel, the index of the last source pixel before its position, and the distance from that pixel
        to the position, in pixels. The indices refer to a source that has been padded by one pixel at each end.
    """
    place = np.clip((np.arange(shown) + 0.5) * scale + shift - 0.5, -1.0, count)
    first = np.minimum(np.floor(place), count - 1.0)
    return first.astype(np.intp) + 1, (place - first).astype(np.float32)


def _resampled(layer: U8, matrix: F64, rest: int, *, size: tuple[int, int]) -> Iterator[tuple[slice, F32]]:
    """Resample a layer, yielding the result in strips of rows.

    Outside the layer, every pixel has the code `rest`. A coarse layer is first extended by one pixel on each side so
    that its edge does not fade into these surroundings.

    Args:
        matrix: (3, 3) scale and shift from shown pixels to full-size layer pixels.
        size: Height and width of the shown layer, in pixels.

    Yields:
        A strip's rows, as a slice, and their unrounded (rows, w, 4) codes.
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
        # View each pixel's four floats as a single number, because it can be gathered faster.
        pixels = lines.view(np.complex128)[..., 0]
        left, right = (
            pixels.take(columns + k, axis=1).view(np.float32).reshape(*pixels.shape[:1], size[1], 4) for k in (0, 1)
        )
        yield strip, _between(left, right, across[:, None])


def _displaced(
    displacement: Displacement, layer: U8, matrix: F64, rest: int, *, size: tuple[int, int]
) -> Iterator[tuple[slice, F32]]:
    """Resample a layer as `_resampled` does, but also displace each pixel individually."""
    su, sv, tu, tv = scale_and_shift(matrix)
    height, width = layer.shape[:2]
    by_u, by_v, extended = width / size[1], height / size[0], int((height, width) != size)
    # Surround the layer with the rest code, after extending a coarse layer by repeating its edge pixels.
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
    """Return low · (1 - weight) + high · weight, computed in place in `low`. Overwrites `high`."""
    high -= low
    high *= weight
    low += high
    return low
