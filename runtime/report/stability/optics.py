"""Cases for poses, projections and Malus' law at singularities (supplement, (1)-(14), (40)-(47)).

The references use different formulas, evaluated in extended precision (`np.longdouble`, whose significand has 64 bits
or more on the supported machines). The tolerances are multiples of a double's rounding error.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Literal

import numpy as np

from runtime.optics.malus import intensity_from_phase, phase_from_intensity
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.report.stability.trial import EPS64, Answer, Trial

POSE, RPU, PHASE, JONES = "eye pose", "RPU", "phase", "Jones optics"
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
FOV_DEG = 40.0
PROBES = [(a, b) for a in (0.1, 0.5, 0.9) for b in (0.2, 0.8)]  # positions on a panel, as fractions of its size
STEP = 1e-10  # relative step for the finite differences used to estimate condition numbers
INTENSITIES = (0.0, 5e-324, 1e-300, 1e-16, 1e-8, 1 / 255, 0.5, 254 / 255, 1 - 1e-8, 1 - 1e-12, 1 - EPS64 / 2, 1.0)


def extended(values: Any) -> Any:
    """Return numbers in extended precision."""
    return np.asarray(values, np.longdouble)


PI = 4 * np.arctan(extended(1))


def farthest(values: Any, reference: Any) -> float:
    """Return the largest absolute difference between values and a reference, in extended precision."""
    return float(np.abs(extended(values) - reference).max())


def axes(eye: Any) -> Any:
    """Return an eye pose's right, up and back axes as rows, in extended precision ((10)-(13)). For an eye
    on the vertical axis, the result is the limit when approached from +x.
    """
    back = eye / np.abs(eye).max()
    back = back / np.sqrt(back @ back)
    ground = extended([-eye[1], eye[0], 0]) / max(abs(eye[0]), abs(eye[1]), np.finfo(np.longdouble).tiny)
    right = ground / np.sqrt(ground @ ground) if ground.any() else extended([0, 1, 0])
    return np.stack([right, np.cross(back, right), back])


def focal_px(width_px: int) -> Any:
    """Return an eye image's focal length in pixels, in extended precision."""
    return width_px / 2 / np.tan(PI * FOV_DEG / 360)


def image_position(eye: Any, point: Any, stack: PanelStack) -> Any:
    """Return a point's pixel position (u, v) in an eye's image. Eye and point are in the `stack` frame."""
    right, up, back = axes(eye) @ (point - eye)
    return focal_px(stack.width_px) / -back * extended([right, -up]) + extended([stack.width_px, stack.height_px]) / 2


def panel_position(eye: Any, image: Any, stack: PanelStack, index: int) -> Any:
    """Trace the ray through a pixel position in an eye's image to its pixel position (u, v) on a panel."""
    u, v = (image - extended([stack.width_px, stack.height_px]) / 2) / focal_px(stack.width_px)
    direction = extended([u, -v, -1]) @ axes(eye)
    _, right, up = eye + (stack.x_m[index] - eye[0]) / direction[0] * direction
    return extended([right / stack.width_m + 0.5, 0.5 - up / stack.height_m]) * [stack.width_px, stack.height_px]


def pose(eye: Sequence[float]) -> Answer:
    """Compare an eye pose's rotation, whose condition grows near the vertical axis, with the reference."""
    error = farthest(stack_from_eye(eye)[:3, :3].T, axes(extended(eye)))
    scale = max(map(abs, eye))
    ground = math.hypot(eye[0] / scale, eye[1] / scale)
    condition = math.hypot(*(c / scale for c in eye)) / ground if ground else math.inf
    return Answer(error, 4 * EPS64, condition, backward_error=error / max(condition, 1.0))


def followed(eye: Sequence[float], *, index: int = 2, stack: PanelStack = STACK) -> Answer:
    """Compare the homography M_RPU (47) with ray tracing, at image positions whose rays cross the panel.
    The condition number says how fast the position on the panel changes, in panel widths, for relative changes in the
    image position or the eye's position.
    """
    view: Any = {"width_px": stack.width_px, "height_px": stack.height_px, "fov_deg": FOV_DEG}
    m = panel_from_image(image_from_stack(eye, **view), stack.panel(index))
    e, error = extended(eye), 0.0
    condition = max(1.0, math.hypot(*eye) / abs(eye[0] - stack.x_m[index]))
    for a, b in PROBES:
        place = extended([stack.x_m[index], (a - 0.5) * stack.width_m, (0.5 - b) * stack.height_m])
        image = np.asarray(image_position(e, place, stack), float)
        truth, position = panel_position(e, extended(image), stack, index), m @ [*image, 1.0]
        error = max(error, farthest(position[:2] / position[2], truth) / stack.width_px)
        step = STEP * max(*np.abs(image), stack.width_px)
        for move in ((step, 0), (0, step)):
            slope = farthest(panel_position(e, extended(image) + move, stack, index), truth) / STEP
            condition = max(condition, slope / stack.width_px)
    return Answer(error, 64 * EPS64 * condition, condition, error / condition)


def of_intensity(intensity: float, branch: Literal[1, 2]) -> Answer:
    """Compare the phase of an intensity, infinitely ill-conditioned near 1, with the reference."""
    root = np.arcsin(np.sqrt(extended(intensity))) * 2 / PI
    truth = root if branch == 1 else 2 - root
    phase = phase_from_intensity(np.array(intensity), branch)
    # Relative condition number of asin(sqrt(I)). Near an intensity of 1, it is bounded by the spacing of doubles.
    away = max(1 - intensity, EPS64)
    condition = max(1.0, math.sqrt(intensity / away) / math.pi / max(float(truth), 1e-30))
    back = abs(float(intensity_from_phase(phase)) - intensity)
    return Answer(farthest(phase, truth), 4 * EPS64 * condition, condition, back)


def product(values: Sequence[float]) -> Answer:
    """Compare the intensity of the phase along a ray with a product of Jones matrices ((5), (7))."""
    field = extended([1, 0])
    for angle in extended(values) * PI / 2:
        c, s = np.cos(angle), np.sin(angle)
        field = np.array([[c, -s], [s, c]]) @ field
    by_sum = intensity_from_phase(np.array(math.fsum(values)))
    return Answer(farthest(by_sum, field[1] ** 2), 1e-12, max(1.0, math.fsum(values) * math.pi / 2))


def trials() -> Iterator[Trial]:
    """Yield all trials for the optics."""
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

    # At 1 km, the eye is still in front of the front panel. The panel's near edge may be behind the image plane.
    eyes: dict[str, list[float]] = {
        f"{degrees:g} degrees off axis" + " at 1 km" * (distance_m > 1):
            [distance_m * math.cos(math.radians(degrees)), distance_m * math.sin(math.radians(degrees)), 0.0]
        for distance_m, angles in ((0.6, (0.0, 45.0, 70.0, 80.0, 85.0)), (1e3, (89.0, 89.9, 89.99)))
        for degrees in angles
    }  # fmt: skip
    eyes |= {f"1e-{p} m before the front panel's plane": [0.06 + 10.0**-p, 0.4, 0.0] for p in (1, 3, 5, 7, 9)}
    eyes["corners behind the eye, 3 cm before an edge"] = [0.09, 0.2, 0.0]
    eyes["corners behind the eye, 1 mm before a corner"] = [0.061, 0.25, 0.14]
    for name, eye in eyes.items():
        yield Trial(RPU, name, partial(followed, eye), measure="of the width")
    for width_m in (1e-6, 1e-3, 1e3, 1e6):
        stack = PanelStack(width_m, width_m * 9 / 16, (-width_m / 9, 0.0, width_m / 9), 1920, 1080)
        eye = [1.2 * width_m, 0.3 * width_m, 0.2 * width_m]
        yield Trial(RPU, f"panels {width_m:g} m wide", partial(followed, eye, stack=stack), measure="of the width")
    branches: tuple[Literal[1, 2], ...] = (1, 2)
    for branch in branches:
        for intensity in INTENSITIES:
            run = partial(of_intensity, intensity, branch)
            yield Trial(PHASE, f"branch {branch}, intensity {intensity!r}", run, measure="phase")
    rng = np.random.default_rng(5)
    sums = {f"{panels} panels": rng.random(panels).tolist() for panels in range(1, 9)}
    sums |= {"8 panels, all dark": [0.0] * 8, "8 panels, all at their limit": [1.0] * 8, "8 panels at 1e-9": [1e-9] * 8}
    sums |= {"limits and 1e-12 in turn": [1.0, 1e-12] * 4, "sum just below 2": [0.5, 0.5, 1 - EPS64]}
    for name, values in sums.items():
        yield Trial(JONES, name, partial(product, values), measure="intensity")
