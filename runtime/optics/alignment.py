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

import numpy as np

from runtime.optics.relief import parallax
from runtime.optics.stack import PanelStack, Plane
from runtime.records import F64, Eyes, Parallax

FARTHEST_M = 1e6  # larger coordinates are treated as not finite
NEAREST_M = 0.01  # minimum distance between an eye and the front panel
MOST_SHIFT = 0.5  # maximum shift of a panel's centre, in panel widths or heights
MOST_SCALE = 2.0  # maximum factor for enlarging or reducing a panel


@dataclass(frozen=True, slots=True)
class Alignment:
    """Transformation that aligns solved layers with the viewer's current eye positions."""

    # For each panel, a (3, 3) scale and shift from shown pixels to the solved layer's pixels.
    solved_from_shown: tuple[F64, ...]
    limited: str = ""  # why the alignment stops short of the current eyes; empty if it reaches them
    # Motion of the content off the middle panel; None if the eyes have not moved or the number of panels is even.
    parallax: Parallax | None = None


def reference_plane(stack: PanelStack) -> Plane:
    """Return the plane where aligned content stays: the centre panel's, or between the middle two."""
    half = stack.count // 2
    return Plane(stack.x_m[half] if stack.count % 2 else (stack.x_m[half - 1] + stack.x_m[half]) / 2)


def midpoints(eyes_m: Eyes) -> F64:
    """Return the (P, 3) midpoints between the eyes of each person in (2P, 3)."""
    middles: F64 = (eyes_m[::2] + eyes_m[1::2]) / 2
    return middles


def common_movement_m(before_m: Eyes, after_m: Eyes) -> F64:
    """Return the (3,) movement that people share: along each axis the least, or 0 if they move apart.
    Layers that follow it are exact for the person who moves least. A person at rest keeps a picture at rest.
    """
    moved = midpoints(after_m) - midpoints(before_m)
    least, most = moved.min(axis=0), moved.max(axis=0)
    common: F64 = np.where(least > 0.0, least, np.where(most < 0.0, most, 0.0))
    return common


def align(stack: PanelStack, *, solved_for_m: Eyes, eyes_m: Eyes) -> Alignment:
    """Align layers that were solved for other eyes to the current eyes. Never raises an exception.

    At the limits `NEAREST_M`, `MOST_SHIFT` and `MOST_SCALE`, the layers are aligned to the farthest allowed point on
    the straight line from the old eyes to the current eyes, so that the alignment stays continuous. If a coordinate is
    not finite, the layers are left unchanged.
    """
    if not (np.abs(solved_for_m).max() <= FARTHEST_M and np.abs(eyes_m).max() <= FARTHEST_M):  # also catches NaN
        return Alignment(_as_they_are(stack), "the eye positions are not finite")
    if len(eyes_m) > 2:
        eyes_m = solved_for_m + common_movement_m(solved_for_m, eyes_m)
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


def _middle(eyes_m: Eyes) -> F64:
    middles = midpoints(eyes_m)
    return np.asarray(middles.mean(axis=0)) if len(middles) > 1 else middles[0]


def _as_they_are(stack: PanelStack) -> tuple[F64, ...]:
    return tuple(np.eye(3) for _ in range(stack.count))


def _limits(
    stack: PanelStack, solved_x_m: list[float], eyes_x_m: list[float], *, old: list[float], step: list[float]
) -> Iterator[tuple[float, float, str]]:
    """Yield (most, least, limit) for each limit: the share of the movement that satisfies share · most <= least is
    allowed. `limit` is `left` or `right` for an eye's distance, and a panel's number for its shift and scale.
    """
    front_m = stack.x_m[-1]
    names = ("left", "right") * (len(eyes_x_m) // 2)
    for name, before_m, after_m in zip(names, solved_x_m, eyes_x_m, strict=True):
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


def _reason(limit: str, stack: PanelStack, eyes_m: Eyes, *, moved_m: float) -> str:
    """Return the message for an exceeded limit, named as by `_limits`."""
    if limit in ("left", "right"):
        distance_m = eyes_m[("left", "right").index(limit), 0] - stack.x_m[-1]
        return f"the {limit} eye is {distance_m:.3g} m from the front panel, but the minimum is {NEAREST_M} m"
    return (
        f"the eyes are {moved_m:.3g} m from the position that the layers were solved for, which is too far "
        f"to align panel {limit}"
    )
