"""Poses, projections and Malus' law at their singularities (supplement, (1)-(14), (40)-(47))."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from runtime.optics.malus import intensity_from_phase, jones_intensity, phase_from_intensity
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, relative_scale_shift, stack_from_eye
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS64, Answer, Trial

POSE, RPU, PHASE, JONES = "eye pose", "RPU", "phase", "Jones optics"
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
FOV_DEG = 40.0
PROBES = [(a, b) for a in (0.1, 0.5, 0.9) for b in (0.2, 0.8)]  # places on a panel, as fractions of its size
INTENSITIES = {
    "0": 0.0, "the least subnormal": 5e-324, "1e-300": 1e-300, "1e-16": 1e-16, "1e-8": 1e-8, "1/255": 1 / 255,
    "1/2": 0.5, "254/255": 254 / 255, "1 - 1e-8": 1 - 1e-8, "1 - 1e-12": 1 - 1e-12,
    "1 - eps/2": 1 - EPS64 / 2, "1": 1.0,
}  # fmt: skip


def pose(eye: Sequence[float]) -> Answer:
    """The rotation against 50 digits; its condition grows as the eye nears the vertical axis."""
    truth = np.array(exact.axes(exact.vector(eye)), dtype=object).T
    rotation = stack_from_eye(eye)[:3, :3]
    error = max(map(exact.distance, rotation.flat, truth.flat))
    scale = max(map(abs, eye))
    ground = math.hypot(eye[0] / scale, eye[1] / scale)
    condition = math.hypot(*(c / scale for c in eye)) / ground if ground else math.inf
    return Answer(error, 4 * EPS64, condition, backward_error=error / max(condition, 1.0))


def gaze(eye: Sequence[float]) -> Answer:
    """The stack's origin in the middle of the picture, and a point beside it where 50 digits put it."""
    view: Any = {"width_px": 1920, "height_px": 1080, "fov_deg": FOV_DEG}
    projection = image_from_stack(eye, **view)
    size, error = max(map(abs, eye)), 0.0
    for point in ((0.0, 0.0, 0.0), (0.125 * size, -0.25 * size, 0.0625 * size)):
        seen = projection @ [*point, 1.0]
        truth = exact.image_position(exact.vector(eye), exact.vector(point), **view)
        error = max(error, *map(exact.distance, seen[:2] / seen[2], truth))
    return Answer(error / 1920, 8 * EPS64)


def scale_shift(eye: Sequence[float], to_x_m: float) -> Answer:
    """From the centre panel to another along an eye's ray."""
    scale, shift = relative_scale_shift(eye, from_x_m=0.0, to_x_m=to_x_m)
    e = exact.vector(eye)
    truth = exact.hit(e, exact.vector([0, 0.125, -0.0625]) - e, to_x_m)
    found = np.array([0.125, -0.0625]) * scale + shift
    size = float(max(abs(truth[1]), abs(truth[2]), abs(e[1]) * abs(to_x_m) / abs(e[0])))
    condition = max(1.0, abs(eye[0]) / abs(eye[0] - to_x_m))
    return Answer(max(map(exact.distance, found, truth[1:])) / size, 8 * EPS64 * condition, condition)


def at_angle(degrees: float, distance_m: float = 0.6) -> list[float]:
    """An eye off the +x axis towards +y."""
    return [distance_m * math.cos(math.radians(degrees)), distance_m * math.sin(math.radians(degrees)), 0.0]


def followed(eye: Sequence[float], *, index: int, stack: PanelStack = STACK) -> Answer:
    """M_RPU of image pixels whose rays meet the panel, against ray tracing with 50 digits.

    Its condition is that of the mapping: how far a relative change of 1 of an image position, or of the eye's
    own place, moves the position on the panel, in panel widths.
    """
    view: Any = {"width_px": stack.width_px, "height_px": stack.height_px, "fov_deg": FOV_DEG}
    m = panel_from_image(image_from_stack(eye, **view), stack.panel(index))
    e, half, error, condition = exact.vector(eye), exact.mpf("0.5"), 0.0, 1.0

    def traced(u: Any, v: Any) -> Any:
        return np.array(exact.on_panel(e, exact.ray(e, exact.mpf(u), exact.mpf(v), **view), stack, index))

    for a, b in PROBES:
        right, up = (exact.mpf(a) - half) * exact.mpf(stack.width_m), (half - exact.mpf(b)) * exact.mpf(stack.height_m)
        place = np.array([exact.mpf(stack.x_m[index]), right, up])
        u, v = map(float, exact.image_position(e, place, **view))
        truth, found = traced(u, v), m @ [u, v, 1.0]
        error = max(error, *map(exact.distance, found[:2] / found[2], truth))
        step = 1e-20 * max(abs(u), abs(v), stack.width_px)
        for du, dv in ((step, 0), (0, step)):
            slope = float(abs(traced(exact.mpf(u) + du, exact.mpf(v) + dv) - truth).max()) / 1e-20
            condition = max(condition, slope / stack.width_px)
    condition = max(condition, math.hypot(*eye) / abs(eye[0] - stack.x_m[index]))
    relative = error / stack.width_px
    return Answer(relative, 64 * EPS64 * condition, condition, relative / condition)


def of_intensity(intensity: float, branch: Literal[1, 2]) -> Answer:
    """The phase of an intensity; its condition goes to infinity towards 1."""
    root = exact.mp.asin(exact.mp.sqrt(exact.mpf(intensity))) * 2 / exact.mp.pi
    truth = root if branch == 1 else 2 - root
    found = phase_from_intensity(np.array(intensity), branch)
    # Relative condition of asin(sqrt(I)); a double spaced eps from 1 bounds it there.
    away = max(1 - intensity, EPS64)
    condition = max(1.0, math.sqrt(intensity / away) / math.pi / float(max(truth, exact.mpf("1e-30"))))
    back = abs(float(intensity_from_phase(found)) - intensity)
    return Answer(exact.distance(found, truth), 4 * EPS64 * condition, condition, back)


def product(values: Sequence[float]) -> Answer:
    """sin² of the summed phase, and the product of the panels' Jones matrices, both against 50 digits."""
    truth = exact.mp.sin(exact.mp.pi / 2 * sum(exact.mpf(value) for value in values)) ** 2
    by_sum = float(intensity_from_phase(np.array(math.fsum(values))))
    by_product = jones_intensity([value * math.pi / 2 for value in values])
    error = max(exact.distance(by_sum, truth), exact.distance(by_product, truth))
    return Answer(error, 1e-12, max(1.0, math.fsum(values) * math.pi / 2))


def trials() -> Iterator[Trial]:
    """Every case of the optics."""
    for power in [*range(1, 13), 100, 300]:
        angle = 10.0**-power
        eye = [0.6 * math.sin(angle) * math.cos(0.7), 0.6 * math.sin(angle) * math.sin(0.7), 0.6 * math.cos(angle)]
        yield Trial(POSE, f"1e-{power} rad from the vertical axis", partial(pose, eye))
    yield Trial(POSE, "on the vertical axis, above", partial(pose, [0.0, 0.0, 0.6]))
    yield Trial(POSE, "on the vertical axis, below", partial(pose, [0.0, 0.0, -0.6]))
    yield Trial(POSE, "subnormal off the axis", partial(pose, [5e-324, 5e-324, 0.6]))
    for distance_m in (1e-200, 1e-6, 1.0, 1e6, 1e200):
        eye = [0.8 * distance_m, 0.36 * distance_m, 0.48 * distance_m]
        yield Trial(POSE, f"{distance_m:g} m away", partial(pose, eye))
        if 1e-6 <= distance_m <= 1e6:
            yield Trial(POSE, f"gaze from {distance_m:g} m", partial(gaze, eye), measure="of the width")
            yield Trial(POSE, f"panel to panel from {distance_m:g} m", partial(scale_shift, eye, -0.06))
    yield Trial(POSE, "panel to panel, 1e-9 m before it", partial(scale_shift, [0.06 + 1e-9, 0.2, 0.1], 0.06))
    cases = {
        **{f"{angle:g} degrees off axis": followed_at(at_angle(angle)) for angle in (0.0, 45.0, 70.0, 80.0, 85.0)},
        # Far enough that the eye is still before the front panel; its near edge may be behind the image plane.
        **{f"{angle:g} degrees off axis at 1 km": followed_at(at_angle(angle, 1e3)) for angle in (89.0, 89.9, 89.99)},
        **{f"1e-{p} m before the front panel's plane": followed_at([0.06 + 10.0**-p, 0.4, 0]) for p in (1, 3, 5, 7, 9)},
        "corners behind the eye, 3 cm before an edge": followed_at([0.09, 0.2, 0.0]),
        "corners behind the eye, 1 mm before a corner": followed_at([0.061, 0.25, 0.14]),
    }
    for width_m in (1e-6, 1e-3, 1e3, 1e6):
        stack = PanelStack(width_m, width_m * 9 / 16, (-width_m / 9, 0.0, width_m / 9), 1920, 1080)
        eye = [1.2 * width_m, 0.3 * width_m, 0.2 * width_m]
        cases[f"panels {width_m:g} m wide"] = partial(followed, eye, index=2, stack=stack)
    for name, run in cases.items():
        yield Trial(RPU, name, run, measure="of the width")
    branches: tuple[Literal[1, 2], ...] = (1, 2)
    for branch in branches:
        for name, intensity in INTENSITIES.items():
            run = partial(of_intensity, intensity, branch)
            yield Trial(PHASE, f"branch {branch}, intensity {name}", run, measure="phase")
    rng = np.random.default_rng(5)
    sums = {f"{panels} panels": rng.random(panels).tolist() for panels in range(1, 9)}
    sums |= {"8 panels, all dark": [0.0] * 8, "8 panels, all at their limit": [1.0] * 8, "8 panels at 1e-9": [1e-9] * 8}
    sums |= {"limits and 1e-12 in turn": [1.0, 1e-12] * 4, "sum just below 2": [0.5, 0.5, 1 - EPS64]}
    for name, values in sums.items():
        yield Trial(JONES, name, partial(product, values), measure="intensity")


def followed_at(eye: Sequence[float]) -> Any:
    """The front panel's case from there."""
    return partial(followed, eye, index=2)
