"""Eye poses on and near their singularities (EyeReal supplement, (10)-(14))."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np

from runtime.optics.views import image_from_stack, relative_scale_shift, stack_from_eye
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS64, Answer, Trial

STAGE = "eye pose"


def pose(eye: Sequence[float]) -> Answer:
    """The rotation against 50 digits. Its condition is how fast the head turns as the eye nears the axis."""
    truth = np.array(exact.axes(exact.vector(eye)), dtype=object).T
    rotation = stack_from_eye(eye)[:3, :3]
    error = max(exact.distance(rotation[i, j], truth[i, j]) for i in range(3) for j in range(3))
    scale = max(map(abs, eye))
    ground = math.hypot(eye[0] / scale, eye[1] / scale)
    condition = math.hypot(*(c / scale for c in eye)) / ground if ground else math.inf
    return Answer(error, 4 * EPS64, condition, backward_error=error / max(condition, 1.0))


def gaze(eye: Sequence[float]) -> Answer:
    """The stack's origin in the middle of the picture, and a point aside of it where 50 digits put it."""
    view: exact.Image = {"width_px": 1920, "height_px": 1080, "fov_deg": 40.0}
    projection = image_from_stack(eye, **view)
    size, error = max(map(abs, eye)), 0.0
    for point in ((0.0, 0.0, 0.0), (0.125 * size, -0.25 * size, 0.0625 * size)):
        seen = projection @ [*point, 1.0]
        truth = exact.image_position(exact.vector(eye), exact.vector(point), **view)
        error = max(error, exact.distance(seen[0] / seen[2], truth[0]), exact.distance(seen[1] / seen[2], truth[1]))
    return Answer(error / 1920, 8 * EPS64)


def scale_shift(eye: Sequence[float], to_x_m: float) -> Answer:
    """From the centre panel to another along an eye's ray."""
    scale, shift = relative_scale_shift(eye, from_x_m=0.0, to_x_m=to_x_m)
    e = exact.vector(eye)
    point = (exact.mpf(0), exact.mpf(0.125), exact.mpf(-0.0625))
    truth = exact.hit(e, exact.combine(point, -1, e), to_x_m)
    found = [0.125 * scale + shift[0], -0.0625 * scale + shift[1]]
    size = float(max(abs(truth[1]), abs(truth[2]), abs(e[1]) * abs(to_x_m) / abs(e[0])))
    error = max(exact.distance(found[0], truth[1]), exact.distance(found[1], truth[2])) / size
    condition = max(1.0, abs(eye[0]) / abs(eye[0] - to_x_m)) if eye[0] != to_x_m else math.inf
    return Answer(error, 8 * EPS64 * condition, condition)


def trials() -> Iterator[Trial]:
    """Every pose case."""
    for power in [*range(1, 13), 100, 300]:
        angle = 10.0**-power
        eye = [0.6 * math.sin(angle) * math.cos(0.7), 0.6 * math.sin(angle) * math.sin(0.7), 0.6 * math.cos(angle)]
        yield Trial(STAGE, f"1e-{power} rad from the vertical axis", partial(pose, eye))
    yield Trial(STAGE, "on the vertical axis, above", partial(pose, [0.0, 0.0, 0.6]))
    yield Trial(STAGE, "on the vertical axis, below", partial(pose, [0.0, 0.0, -0.6]))
    yield Trial(STAGE, "subnormal off the axis", partial(pose, [5e-324, 5e-324, 0.6]))
    for distance_m in (1e-200, 1e-6, 1e-3, 1.0, 1e3, 1e6, 1e200):
        eye = [0.8 * distance_m, 0.36 * distance_m, 0.48 * distance_m]
        yield Trial(STAGE, f"{distance_m:g} m away", partial(pose, eye))
    for distance_m in (1e-6, 1.0, 1e6):
        eye = [0.8 * distance_m, 0.36 * distance_m, 0.48 * distance_m]
        yield Trial(STAGE, f"gaze from {distance_m:g} m", partial(gaze, eye), measure="of the width")
        yield Trial(STAGE, f"panel to panel from {distance_m:g} m", partial(scale_shift, eye, -0.06))
    yield Trial(STAGE, "panel to panel, 1e-9 m before it", partial(scale_shift, [0.06 + 1e-9, 0.2, 0.1], 0.06))
    yield Trial(STAGE, "at the front panel's centre: a pose", partial(pose, [0.06, 0.0, 0.0]))
