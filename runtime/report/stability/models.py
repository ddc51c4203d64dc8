"""Cases that test the models on stiff problems, and on extreme pictures, poses and sizes.

The stiff part of the two-eye problem (docs/mathematics.md) is the lowest frequency of the difference between the eyes.
The target contains that wave, finer waves, and a part common to both eyes that any panel can show. This module traces
rays through a model's panels and compares the residual with that of the exact least-squares solution within the panels'
range (scipy). Neither shares code with the models. Errors of other problems are compared with recorded ones.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from runtime.config import ModelSettings
from runtime.evaluation.displayed import displayed, expected_quality
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8, Eyes
from runtime.report.pairs import eyes_at
from runtime.report.stability.trial import Answer, Trial

SOLVE, NETWORK = "solve", "network"
MODELS = ("fast", "balanced", "best")
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)
FOV_DEG = 40.0
AMPLITUDE = 0.1  # amplitude of the target difference between the eyes, at its lowest frequency, in units of pi/2
FINER = ((5, 0.05), (11, 0.03))  # further waves in the difference, as (cycles across the panels, amplitude)
COMMON = ((3, 0.15), (7, 0.1))  # waves in the part common to both eyes, as (cycles across the panels, amplitude)
WIDTH_M, HEIGHT_M, WIDTH_PX, HEIGHT_PX = 0.5184, 0.0648, 64, 8
SOLVE_FLOOR = 0.002  # an 8-bit grey level on one of three panels, relative to the target
NETWORK_FLOOR = 0.0005  # an eighth of an 8-bit code value, to allow for different rounding on other processors


@lru_cache(maxsize=4)
def ready(model: str, stack: PanelStack) -> Predictor:
    """Return a model's predictor. Predictors are cached, because most cases share the same panels."""
    return load_predictor(model, stack, ModelSettings(threads=1))


def layers_of(model: str, images: Sequence[U8], eyes_m: Eyes, stack: PanelStack, *, fov_deg: float = FOV_DEG) -> U8:
    """Solve a pair of pictures, and return a copy of the layers with shape (N, h, w, 3)."""
    still = solve_still(images[0], images[1], eyes_m=eyes_m, fov_deg=fov_deg, predictor=ready(model, stack))
    return np.array(still.layers[..., :3])


def waves(parts: Sequence[tuple[int, float]]) -> F64:
    """Return a sum of sine waves across a row (WIDTH_PX,), given cycles and amplitudes."""
    u = (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX
    result: F64 = np.sum([size * np.sin(2 * np.pi * cycles * u + cycles - 1) for cycles, size in parts], axis=0)
    return result


def hats(positions: F64, count: int) -> F64:
    """Return the weights (n, count) of linear interpolation at positions (n,) between values at 0, 1, ..."""
    weights: F64 = np.maximum(1 - np.abs(positions[:, None] - np.arange(count)), 0.0)
    return weights


@dataclass(frozen=True)
class StiffProblem:
    """A problem whose targets are a common grey picture plus a difference, with a stiff part, between the
    eyes. Both eyes look at three panels from straight ahead. The rays are traced independently of the models.
    """

    gap_m: float = 0.06  # distance between neighbouring panels
    ipd_m: float = 0.06  # distance between the eyes
    distance_m: float = 0.54  # distance from the front panel

    @property
    def eye_x_m(self) -> float:
        """Distance from the middle panel to the eyes, in metres."""
        return self.gap_m + self.distance_m

    def target(self, side: int) -> F64:
        """Return each column's target phase for the left (0) or right (1) eye, shape (WIDTH_PX,)."""
        return 1.5 + waves(COMMON) + (side - 0.5) * waves([(1, AMPLITUDE), *FINER])

    def condition(self) -> float:
        """Return the ratio of the largest to the smallest eigenvalue at the lowest frequency."""
        parallaxes_m = [self.ipd_m / 2 * x_m / (self.eye_x_m - x_m) for x_m in (-self.gap_m, self.gap_m)]
        c = 1 + sum(np.exp(4j * np.pi / WIDTH_M * parallax_m) for parallax_m in parallaxes_m)
        return float((3 + abs(c)) / (3 - abs(c)))

    def rays(self, side: int) -> tuple[list[tuple[F64, F64]], F64]:
        """Trace an eye's n rays that hit all panels. Return interpolation weights for each panel's rows (n,
        HEIGHT_PX) and columns (n, WIDTH_PX), and target phases (n,).
        """
        v, u = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX] + 0.5
        focal_px = WIDTH_PX * self.eye_x_m / WIDTH_M
        eye = np.array([self.eye_x_m, (side - 0.5) * self.ipd_m])
        back, across = eye / np.hypot(*eye), (u - WIDTH_PX / 2) / focal_px
        x, y = -back[0] - across * back[1], -back[1] + across * back[0]  # ray directions; the z axis points up
        z = -(v - HEIGHT_PX / 2) / focal_px
        positions, inside = [], np.ones(u.shape, bool)
        for x_m in (-self.gap_m, 0.0, self.gap_m):
            t = (x_m - eye[0]) / x
            column = ((eye[1] + t * y) / WIDTH_M + 0.5) * WIDTH_PX - 0.5
            row = (0.5 - t * z / HEIGHT_M) * HEIGHT_PX - 0.5
            inside &= (column > 0) & (column < WIDTH_PX - 1) & (row > 0) & (row < HEIGHT_PX - 1)
            positions.append((row, column))
        weights = [(hats(row[inside], HEIGHT_PX), hats(column[inside], WIDTH_PX)) for row, column in positions]
        return weights, np.broadcast_to(self.target(side), u.shape)[inside]

    def residual(self, layers: F64) -> float:
        """Return the RMS residual of panel values (3, HEIGHT_PX, WIDTH_PX), relative to the targets'."""
        missing, whole = 0.0, 0.0
        for weights, target in map(self.rays, (0, 1)):
            sums = sum(
                np.einsum("rh,hw,rw->r", rows, layer, columns)
                for (rows, columns), layer in zip(weights, layers, strict=True)
            )
            missing += float(((sums - target) ** 2).sum())
            whole += float(((target - 1.5) ** 2).sum())
        return math.sqrt(missing / whole)


@lru_cache(maxsize=64)
def optimum(problem: StiffProblem) -> float:
    """Return the smallest residual of panels with values in [0, 1] and equal rows, as the targets have."""
    parts = [problem.rays(side) for side in (0, 1)]
    targets = np.concatenate([target for _, target in parts])
    matrix = np.vstack([np.hstack([columns for _, columns in weights]) for weights, _ in parts])
    best = lsq_linear(matrix, targets, bounds=(0, 1), tol=1e-9)
    return math.sqrt(2 * best.cost / float(((targets - 1.5) ** 2).sum()))


def solved(model: str, problem: StiffProblem) -> Answer:
    """Compare a model's residual with the smallest possible one (`optimum`)."""
    stack = PanelStack(WIDTH_M, HEIGHT_M, (-problem.gap_m, 0.0, problem.gap_m), WIDTH_PX, HEIGHT_PX)
    eyes_m = np.array([[problem.eye_x_m, side * problem.ipd_m / 2, 0.0] for side in (-1, 1)])
    greys = [np.rint(255 * np.sin(np.pi / 2 * problem.target(side)) ** 2).astype(np.uint8) for side in (0, 1)]
    images = [np.tile(grey[None, :, None], (HEIGHT_PX, 1, 3)) for grey in greys]
    fov_deg = math.degrees(2 * math.atan(WIDTH_M / 2 / problem.eye_x_m))
    layers = layers_of(model, images, eyes_m, stack, fov_deg=fov_deg)
    residual, least = problem.residual(layers.mean(axis=-1) / 255), optimum(problem)
    note = f"no panels leave less than {least:.3g}"
    if residual < 0.8 * least - SOLVE_FLOOR:  # rows that differ slightly can be somewhat better than the optimum
        return Answer(math.nan, 1.0, problem.condition(), note=f"{residual:.3g} is impossible: {note}")
    # A model that alternates between the eyes leaves the entire error to one eye. Flat grey is the worst case.
    return Answer(residual, 1.0, problem.condition(), residual - least, note=note)


def pictures(kind: str) -> list[U8]:
    """Return the two eyes' pictures, each (h, w, 3), for a kind in KINDS."""
    shape = (STACK.height_px, STACK.width_px, 3)
    left, right = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    match kind:
        case "all white":
            left[:] = right[:] = 255
        case "lines one pixel wide":
            left[:, ::9], right[:, 4::9] = 255, 255
        case "black for one eye, white for the other":
            right[:] = 255
        case "noise, another for each eye":
            rng = np.random.default_rng(4)
            left, right = (rng.integers(0, 256, shape, dtype=np.uint8) for _ in range(2))
        case "coloured stripes, shifted by a third":
            left[:] = np.where((np.arange(STACK.width_px) % 24 < 12)[:, None], (230, 60, 140), 128)
            right = np.roll(left, 8, axis=1)
    return [left, right]


# Extreme pictures. Each pair is seen from straight ahead, and from the given distance (m) and off-axis angle (degrees).
KINDS = {
    "all black": (0.7, 15.0), "all white": (0.9, -25.0), "lines one pixel wide": (1.5, -35.0),
    "black for one eye, white for the other": (0.7, 15.0), "noise, another for each eye": (0.9, -25.0),
    "coloured stripes, shifted by a third": (0.7, 15.0),
}  # fmt: skip


def smooth(stack: PanelStack) -> list[U8]:
    """Return a smooth picture, shape (h, w, 3), and the same picture shifted by one pixel."""
    y, x = np.mgrid[0 : stack.height_px, 0 : stack.width_px]
    wave = 128 + 90 * np.sin(x / stack.width_px * 19) * np.cos(y / stack.height_px * 11)
    left = np.repeat(wave[..., None], 3, axis=2).astype(np.uint8)
    return [left, np.roll(left, 1, axis=1)]


def stressed(
    model: str, images: Sequence[U8], eyes_m: Eyes, stack: PanelStack = STACK, *, light: bool = False
) -> Answer:
    """Measure the displayed pictures' RMS error, for light or for one ray per pixel."""
    layers = layers_of(model, images, eyes_m, stack)
    if layers.shape != (3, stack.height_px, stack.width_px, 3) or layers.dtype != np.uint8:
        return Answer(1.0, 0.0, note=f"layers of {layers.shape}, {layers.dtype}")
    seen = displayed(layers, images, stack, eyes_m=eyes_m, fov_deg=FOV_DEG, similarity=False)
    error_db = expected_quality(seen, layers, sigmas_mm=(0.0,)).db["0"] if light else seen.quality.psnr_db
    return Answer(10 ** (-error_db / 20), 1.0)


def trials(*, full: bool = False) -> Iterator[Trial]:
    """Yield all trials for the models: if `full`, all models at all poses, gaps and sizes, and 4K."""
    geometries: dict[str, dict[str, float]] = {
        **{f"gap {gap:g} m": {"gap_m": gap} for gap in (1e-4, 5e-3, 0.03, 0.1, 1.0)},
        **{f"eyes {ipd:g} m apart": {"ipd_m": ipd} for ipd in (1e-4, 0.005, 0.2)},
        **{f"eyes at {distance:g} m": {"distance_m": distance} for distance in (0.1, 1.5, 30.0)},
    }
    for name, geometry in geometries.items():
        for model in (*MODELS, "sart"):
            run = partial(solved, model, StiffProblem(**geometry))
            yield Trial(SOLVE, f"{model}, {name}", run, measure="of the target", floor=SOLVE_FLOOR)

    def case(
        model: str, name: str, images: Sequence[U8], eyes_m: Eyes, stack: PanelStack = STACK, *, light: bool = False
    ) -> Trial:
        run: Any = partial(stressed, model, images, eyes_m, stack, light=light)
        return Trial(NETWORK, f"{model}: {name}", run, measure="light" if light else "intensity", floor=NETWORK_FLOOR)

    for model in MODELS:
        for kind, (distance_m, angle_deg) in KINDS.items():
            aside = eyes_at(distance_m=distance_m, angle_deg=angle_deg)
            yield case(model, kind, pictures(kind), eyes_at(distance_m=0.6))
            yield case(model, f"{kind}, from {distance_m:g} m, {angle_deg:g} degrees", pictures(kind), aside)
        if not full and model != "balanced":
            continue
        for name, eyes_m in POSES.items():
            yield case(model, name, smooth(STACK), eyes_m)
        for gap_m in (1e-4, 1e-3, 0.5):
            stack = replace(STACK, x_m=(-gap_m, 0.0, gap_m))
            yield case(model, f"panels {gap_m:g} m apart", smooth(stack), eyes_at(distance_m=0.6 + gap_m), stack)
        for width, height in ((16, 16), (17, 31), (333, 77), *(((3840, 2160),) if full else ())):
            stack = replace(STACK, width_px=width, height_px=height)
            # At 333x77, each panel row shows the mean of three picture rows, which a single ray cannot represent.
            flat = (width, height) == (333, 77)
            yield case(model, f"panels of {width}x{height}", smooth(stack), eyes_at(distance_m=0.6), stack, light=flat)
    far_aside = partial(stressed, "balanced", smooth(STACK), eyes_at(distance_m=3.0, angle_deg=85.0))
    yield Trial(NETWORK, "85 degrees aside: no ray crosses all panels", far_aside, expected="refuses", measure="-")


POSES: dict[str, F64] = {
    "70 degrees aside": eyes_at(distance_m=0.8, angle_deg=70.0),
    "75 degrees aside": eyes_at(distance_m=2.0, angle_deg=75.0),
    "0.1 m away": eyes_at(distance_m=0.1),
    "4 m away": eyes_at(distance_m=4.0),
    "eyes 5 mm apart": eyes_at(distance_m=0.6, ipd_m=0.005),
    "eyes 0.1 mm apart": eyes_at(distance_m=0.6, ipd_m=1e-4),
    "eyes 30 cm apart": eyes_at(distance_m=0.6, ipd_m=0.3),
    "head tilted by 45 degrees": np.array([[0.6, -0.022, -0.022], [0.6, 0.022, 0.022]]),
    "head turned by 60 degrees": np.array([[0.627, -0.016, 0.0], [0.573, 0.016, 0.0]]),
    "left and right exchanged": eyes_at(distance_m=0.6)[::-1].copy(),
}
