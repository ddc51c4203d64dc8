"""The reverse perspective uniform at grazing angles and for panels of every size (EyeReal supplement, (40)-(47))."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from runtime.optics.retina import panel_positions
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS32, EPS64, Answer, Trial

STAGE = "RPU"
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
FOV_DEG = 40.0
PROBES = [(a, b) for a in (0.1, 0.5, 0.9) for b in (0.2, 0.8)]  # places on a panel, as fractions of its size


def at_angle(degrees: float, distance_m: float = 0.6) -> list[float]:
    """An eye off the +x axis towards +y."""
    return [distance_m * math.cos(math.radians(degrees)), distance_m * math.sin(math.radians(degrees)), 0.0]


def place(stack: PanelStack, index: int, a: float, b: float) -> Any:
    """A point of a panel, exactly."""
    return (
        exact.mpf(stack.x_m[index]),
        (exact.mpf(a) - exact.mpf(1) / 2) * exact.mpf(stack.width_m),
        (exact.mpf(1) / 2 - exact.mpf(b)) * exact.mpf(stack.height_m),
    )


def traced(eye: Any, stack: PanelStack, index: int, u: float, v: float) -> tuple[Any, Any]:
    """Where the ray of an image position meets a panel, pixels, to 50 digits."""
    size: Any = {"width_px": stack.width_px, "height_px": stack.height_px}
    return exact.on_panel(eye, exact.ray(eye, exact.mpf(u), exact.mpf(v), **size, fov_deg=FOV_DEG), stack, index)


def mapped(m: F64, u: float, v: float) -> F64:
    """(2,) where a homography (3, 3) puts a pixel position."""
    weighted = m @ [u, v, 1.0]
    return np.asarray(weighted[:2] / weighted[2])


def followed(eye: Sequence[float], *, index: int, stack: PanelStack = STACK) -> Answer:
    """M_RPU of image pixels whose rays meet the panel, against ray tracing with 50 digits.

    Its condition is that of the mapping: how far a relative change of 1 of an image position, or of the eye's
    own place, moves the position on the panel, in panel widths.
    """
    view: exact.Image = {"width_px": stack.width_px, "height_px": stack.height_px, "fov_deg": FOV_DEG}
    projection = image_from_stack(eye, **view)
    raster = stack.panel(index)
    m = panel_from_image(projection, raster)
    e = exact.vector(eye)
    error, condition = 0.0, 1.0
    for a, b in PROBES:
        seen = exact.image_position(e, place(stack, index, a, b), **view)
        u, v = float(seen[0]), float(seen[1])
        truth = traced(e, stack, index, u, v)
        found = mapped(m, u, v)
        error = max(error, exact.distance(found[0], truth[0]), exact.distance(found[1], truth[1]))
        step = 1e-20 * max(abs(u), abs(v), stack.width_px)
        for du, dv in ((step, 0), (0, step)):
            moved = traced(e, stack, index, exact.mpf(u) + du, exact.mpf(v) + dv)
            slope = float(max(abs(moved[0] - truth[0]), abs(moved[1] - truth[1]))) / 1e-20
            condition = max(condition, slope / stack.width_px)
    condition = max(condition, math.hypot(*eye) / abs(eye[0] - stack.x_m[index]))
    relative = error / stack.width_px
    return Answer(relative, 64 * EPS64 * condition, condition, relative / condition)


def single_precision(width_px: int, height_px: int, degrees: float) -> Answer:
    """The float32 maps that retinas and warps sample with, in panel pixels."""
    stack = PanelStack(0.5184, 0.2916, STACK.x_m, width_px, height_px)
    eye = at_angle(degrees)
    u, v = panel_positions(eye, stack, index=2, width_px=width_px, height_px=height_px, fov_deg=FOV_DEG)
    e, error, counted = exact.vector(eye), 0.0, 0
    for row in range(7, height_px, height_px // 5):
        for column in range(11, width_px, width_px // 7):
            truth = traced(e, stack, 2, column + 0.5, row + 0.5)
            if 0 <= truth[0] <= width_px and 0 <= truth[1] <= height_px:
                counted += 1
                error = max(error, exact.distance(u[row, column], truth[0]), exact.distance(v[row, column], truth[1]))
    if not counted:
        raise AssertionError("no ray of this case meets the panel")
    return Answer(error, EPS32 * width_px / 2, note=f"{counted} rays")


def trials() -> Iterator[Trial]:
    """Every RPU case."""
    for degrees in (0.0, 45.0, 70.0, 80.0, 85.0):
        for index in (0, 2):
            run = partial(followed, at_angle(degrees), index=index)
            yield Trial(STAGE, f"{degrees:g} degrees off axis, panel {index}", run, measure="of the width")
    for degrees in (89.0, 89.9, 89.99):
        # Far enough that the eye is still before the front panel; its near edge may be behind the image plane.
        run = partial(followed, at_angle(degrees, 1000.0), index=2)
        yield Trial(STAGE, f"{degrees:g} degrees off axis at 1 km", run, measure="of the width")
    for power in (1, 3, 5, 7, 9, 11):
        run = partial(followed, [0.06 + 10.0**-power, 0.4, 0.0], index=2)
        yield Trial(STAGE, f"1e-{power} m before the front panel's plane", run, measure="of the width")
    for name, eye in (("3 cm before an edge", [0.09, 0.2, 0.0]), ("1 mm before a corner", [0.061, 0.25, 0.14])):
        run = partial(followed, eye, index=2)
        yield Trial(STAGE, f"corners behind the eye, {name}", run, measure="of the width")
    for width_m in (1e-6, 1e-3, 1e3, 1e6):
        stack = PanelStack(width_m, width_m * 9 / 16, (-width_m / 9, 0.0, width_m / 9), 1920, 1080)
        run = partial(followed, [1.2 * width_m, 0.3 * width_m, 0.2 * width_m], index=2, stack=stack)
        yield Trial(STAGE, f"panels {width_m:g} m wide", run, measure="of the width")
    for width_px, height_px in ((64, 36), (1920, 1080), (3840, 2160)):
        for degrees in (0.0, 70.0):
            run = partial(single_precision, width_px, height_px, degrees)
            yield Trial(STAGE, f"float32 maps, {width_px}x{height_px}, {degrees:g} degrees", run, measure="px")
