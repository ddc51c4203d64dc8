"""The shipped networks on extreme pictures, poses and sizes: the result is a picture or a refusal."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial

import numpy as np

from runtime.config import ModelSettings
from runtime.evaluation.displayed import displayed
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8
from runtime.report.pairs import eyes_at
from runtime.report.stability.solve import Method, Problem
from runtime.report.stability.trial import Answer, Trial, refusal

STAGE = "network"
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)
FOV_DEG = 40.0
MODELS = ("fast", "balanced", "best")
FLOOR = 0.0005  # an eighth of a code: what another processor's rounding may move


@lru_cache(maxsize=4)
def ready(model: str, stack: PanelStack) -> Predictor:
    """A model's predictor, kept: most cases are about the same panels."""
    return load_predictor(model, stack, ModelSettings(threads=1))


def predicted(model: str, images: Sequence[U8], eyes_m: F64, stack: PanelStack, *, fov_deg: float = FOV_DEG) -> U8:
    """(N, h, w, 3) layers, copied out of the predictor."""
    done = solve_still(images[0], images[1], eyes_m=eyes_m, fov_deg=fov_deg, predictor=ready(model, stack))
    return np.array(done.layers[..., :3])


def pictures(kind: str) -> list[U8]:
    """(h, w, 3) for each eye: two pictures that solvers dislike."""
    height, width = STACK.height_px, STACK.width_px
    left = np.zeros((height, width, 3), np.uint8)
    right = left.copy()
    if kind == "all white":
        left[:] = right[:] = 255
    elif kind == "lines one pixel wide":
        left[:, ::9], right[:, 4::9] = 255, 255
    elif kind == "black for one eye, white for the other":
        right[:] = 255
    elif kind == "noise, another for each eye":
        rng = np.random.default_rng(4)
        left, right = (rng.integers(0, 256, left.shape, dtype=np.uint8) for _ in range(2))
    elif kind == "coloured stripes, shifted by a third":
        for c, colour in enumerate((230, 60, 140)):
            left[:, :, c] = np.where(np.arange(width) % 24 < 12, colour, 128)
        right = np.roll(left, 8, axis=1)
    return [left, right]


# Each is seen from straight ahead, and from a distance (metres) and an off-axis angle (degrees).
KINDS = {
    "all black": (0.7, 15.0), "all white": (0.9, -25.0), "lines one pixel wide": (1.5, -35.0),
    "black for one eye, white for the other": (0.7, 15.0), "noise, another for each eye": (0.9, -25.0),
    "coloured stripes, shifted by a third": (0.7, 15.0),
}  # fmt: skip


def stressed(model: str, images: Sequence[U8], eyes_m: F64, stack: PanelStack = STACK) -> Answer:
    """RMS displayed error; no closed form exists, so it is held to the recorded error."""
    layers = predicted(model, images, eyes_m, stack)
    if layers.shape != (3, stack.height_px, stack.width_px, 3) or layers.dtype != np.uint8:
        return Answer(1.0, 0.0, note=f"layers of {layers.shape}, {layers.dtype}")
    seen = displayed(layers, images, stack, eyes_m=eyes_m, fov_deg=FOV_DEG, similarity=False)
    return Answer(10 ** (-seen.quality.psnr_db / 20), 1.0)


def smooth(stack: PanelStack) -> list[U8]:
    """(h, w, 3) for each eye: an ordinary picture and its like, a little aside."""
    y, x = np.mgrid[0 : stack.height_px, 0 : stack.width_px]
    wave = 128 + 90 * np.sin(x / stack.width_px * 19) * np.cos(y / stack.height_px * 11)
    left = np.repeat(wave[..., None], 3, axis=2).astype(np.uint8)
    return [left, np.roll(left, 1, axis=1)]


def solver(model: str) -> Method:
    """A model as a method of the solve stage, on 8-bit pictures."""

    def solve(problem: Problem) -> F32:
        images = [np.rint(image * 255).astype(np.uint8) for image in problem.pictures]
        layers = predicted(model, images, problem.eyes_m, problem.stack, fov_deg=problem.fov_deg)
        return layers.astype(np.float32) / np.float32(255)

    return solve


def trials(*, full: bool = False) -> Iterator[Trial]:
    """Every case of the networks; `full`: every pose for each model, and 4K panels."""
    for model in MODELS:
        for kind, (distance_m, angle_deg) in KINDS.items():
            where = f", from {distance_m:g} m, {angle_deg:g} degrees"
            for place, eyes in (
                ("", eyes_at(distance_m=0.6)),
                (where, eyes_at(distance_m=distance_m, angle_deg=angle_deg)),
            ):
                run = partial(stressed, model, pictures(kind), eyes)
                yield Trial(STAGE, f"{model}: {kind}{place}", run, measure="intensity", floor=FLOOR)
        if full or model == "balanced":
            yield from _poses(model, full=full)
    aside = eyes_at(distance_m=3.0, angle_deg=85.0)
    nothing = partial(stressed, "balanced", smooth(STACK), aside)
    yield refusal(STAGE, "85 degrees aside: no ray crosses all panels", nothing)


def _poses(model: str, *, full: bool) -> Iterator[Trial]:
    for name, eyes in (
        ("70 degrees aside", eyes_at(distance_m=0.8, angle_deg=70.0)),
        ("75 degrees aside", eyes_at(distance_m=2.0, angle_deg=75.0)),
        ("0.1 m away", eyes_at(distance_m=0.1)),
        ("4 m away", eyes_at(distance_m=4.0)),
        ("eyes 5 mm apart", eyes_at(distance_m=0.6, ipd_m=0.005)),
        ("eyes 0.1 mm apart", eyes_at(distance_m=0.6, ipd_m=1e-4)),
        ("eyes 30 cm apart", eyes_at(distance_m=0.6, ipd_m=0.3)),
        ("head tilted by 45 degrees", np.array([[0.6, -0.022, -0.022], [0.6, 0.022, 0.022]])),
        ("head turned by 60 degrees", np.array([[0.627, -0.016, 0.0], [0.573, 0.016, 0.0]])),
        ("left and right exchanged", eyes_at(distance_m=0.6)[::-1].copy()),
    ):
        run = partial(stressed, model, smooth(STACK), eyes)
        yield Trial(STAGE, f"{model}: {name}", run, measure="intensity", floor=FLOOR)
    for gap_m in (1e-4, 1e-3, 0.5):
        stack = replace(STACK, x_m=(-gap_m, 0.0, gap_m))
        run = partial(stressed, model, smooth(stack), eyes_at(distance_m=0.6 + gap_m), stack)
        yield Trial(STAGE, f"{model}: panels {gap_m:g} m apart", run, measure="intensity", floor=FLOOR)
    for width, height in ((16, 16), (17, 31), (333, 77), *(((3840, 2160),) if full else ())):
        stack = replace(STACK, width_px=width, height_px=height)
        run = partial(stressed, model, smooth(stack), eyes_at(distance_m=0.6), stack)
        yield Trial(STAGE, f"{model}: panels of {width}x{height}", run, measure="intensity", floor=FLOOR)
