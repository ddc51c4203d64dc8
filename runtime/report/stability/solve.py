"""How stiff the two-eye problem is, and what each method makes of it.

The stiff part is the lowest frequency of the difference between the eyes: one cycle across the panels, which the
outer panels must carry by their parallax. Its eigenvalue is 3 - |1 + exp(2iks_0) + exp(2iks_2)|.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from runtime.optics.malus import intensity_from_phase, phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64
from runtime.report.baselines import EyeOperator, conjugate_gradients, eye_operator, mean_of_targets
from runtime.report.stability import exact
from runtime.report.stability.trial import Answer, Trial, refusal

STAGE = "solve"
AMPLITUDE = 0.1  # of the wanted difference between the eyes, in phase units of pi/2
WIDTH_M, HEIGHT_M, WIDTH_PX, HEIGHT_PX = 0.5184, 0.2916, 64, 4
SEQUENTIAL = 1.05 * math.sqrt(2)  # a solver that serves the eyes in turn leaves all of a difference to the first
Method = Callable[["Problem"], F32]  # (N, height, width, C) panel values in [0, 1]


class Problem:
    """Two eyes that should see a grey field whose difference is one cycle across the panels."""

    def __init__(self, *, gap_m: float, ipd_m: float, distance_m: float) -> None:
        self.stack = PanelStack(WIDTH_M, HEIGHT_M, (-gap_m, 0.0, gap_m), WIDTH_PX, HEIGHT_PX)
        self.distance_m = gap_m + distance_m
        self.ipd_m = ipd_m
        self.eyes_m = np.array([[self.distance_m, side * ipd_m / 2, 0.0] for side in (-1, 1)])
        self.fov_deg = math.degrees(2 * math.atan(WIDTH_M / 2 / self.distance_m))
        self.operators: list[EyeOperator] = [
            eye_operator(eye, self.stack, width_px=WIDTH_PX, height_px=HEIGHT_PX, fov_deg=self.fov_deg)
            for eye in self.eyes_m
        ]
        wave = np.sin(2 * np.pi * (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX) * AMPLITUDE / 2
        self.wanted: list[F32] = [
            np.broadcast_to(
                intensity_from_phase(1.5 + sign * wave).astype(np.float32)[None, :, None],
                (HEIGHT_PX, WIDTH_PX, 3),
            ).copy()
            for sign in (-1, 1)
        ]

    def parallax_m(self, x_m: float) -> float:
        """Half of what an eye's step to the other moves a panel by, on the centre panel, metres."""
        return self.ipd_m / 2 * x_m / (self.distance_m - x_m)

    def eigenvalue(self) -> tuple[float, float]:
        """Smallest and largest eigenvalue of the operator for that wave; the smallest loses digits in doubles."""
        k = 2 * exact.mp.pi / exact.mpf(WIDTH_M)
        c = 1 + sum(
            exact.mp.exp(2j * k * exact.mpf(self.parallax_m(x))) for x in (self.stack.x_m[0], self.stack.x_m[2])
        )
        return float(3 - abs(c)), float(3 + abs(c))

    def reach(self) -> float:
        """The largest part of the wanted difference that values within [0, 1] can show: |D| <= 2·|sin(ks)|·2·1/2."""
        k = 2 * math.pi / WIDTH_M
        outer = [abs(math.sin(k * self.parallax_m(self.stack.x_m[index]))) for index in (0, 2)]
        return min(1.0, sum(outer) / AMPLITUDE)

    def condition(self) -> float:
        """Largest over smallest eigenvalue for that wave."""
        least, largest = self.eigenvalue()
        return largest / least

    def left_over(self, layers: F32) -> float:
        """RMS of what is missing of the difference, relative to the difference wanted."""
        flat = layers.reshape(self.stack.count, -1, 3).astype(np.float32)
        missing, whole = 0.0, 0.0
        for operator, image in zip(self.operators, self.wanted, strict=True):
            target = phase_from_intensity(image[operator.mask])
            missing += float(((operator.phases(flat) - target) ** 2).sum())
            whole += float(((target - 1.5) ** 2).sum())
        return math.sqrt(missing / whole)

    def spectrum(self) -> F64:
        """Eigenvalues of the whole sampled operator times its transpose, ascending."""
        dense = np.vstack([np.hstack([m.toarray() for m in operator.panels]) for operator in self.operators])
        return np.asarray(np.linalg.eigvalsh(dense.astype(np.float64) @ dense.T.astype(np.float64)), np.float64)


def chebyshev(condition: float, iterations: int) -> float:
    """By how much CG reduces the error at least, for a spectrum of that condition."""
    root = math.sqrt(condition)
    return min(1.0, 2 * ((root - 1) / (root + 1)) ** iterations)


def stiffness(gap_m: float, ipd_m: float, distance_m: float) -> Answer:
    """The sampled operator against the closed form: its Rayleigh quotient for the stiffest wave."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m)
    least, largest = problem.eigenvalue()
    # The wave itself, on the rays of both eyes: +1 for the one, -1 for the other.
    wave = np.sin(2 * np.pi * (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX)
    rays = [
        sign * np.broadcast_to(wave, operator.mask.shape)[operator.mask][:, None].astype(np.float32)
        for sign, operator in zip((-1, 1), problem.operators, strict=True)
    ]
    gathered = sum(operator.back(part) for operator, part in zip(problem.operators, rays, strict=True))
    quotient = float((np.asarray(gathered) ** 2).sum() / sum((part**2).sum() for part in rays))
    condition = largest / least
    note = f"smallest eigenvalue {least:.2g}; at most {problem.reach():.0%} of a difference of {AMPLITUDE} fits the box"
    # The closed form leaves out borders, sampling, and, to first order, that near and far panels differ in scale.
    tolerance = 0.05 + 1.2 * gap_m / distance_m
    return Answer(abs(quotient - least) / 6, tolerance, condition, note=note)


def converges(
    method: Method, gap_m: float, ipd_m: float, distance_m: float, *, iterations: int | None, limit: float
) -> Answer:
    """What a method leaves of the stiffest wave: at most `limit` of it, for CG also at most Chebyshev's bound."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m)
    least, largest = problem.eigenvalue()
    left = problem.left_over(method(problem))
    if iterations is not None:
        values = problem.spectrum()
        values = values[values > 1e-9 * values[-1]]
        limit = chebyshev(float(values[-1] / values[0]), iterations)
    reach = problem.reach()
    note = f"at most {reach:.0%} fits the box" if reach < 1 else ""
    return Answer(left, max(limit, 1.0 - reach), largest / least, left, note=note)


def cg(problem: Problem, *, iterations: int) -> F32:
    return conjugate_gradients(problem.operators, problem.wanted, problem.stack, iterations=iterations)


def mean(problem: Problem) -> F32:
    return mean_of_targets(problem.eyes_m, problem.wanted, problem.stack, fov_deg=problem.fov_deg)


GEOMETRIES: Sequence[tuple[str, dict[str, float]]] = (
    *((f"gap {gap:g} m", {"gap_m": gap}) for gap in (1e-4, 1e-3, 5e-3, 0.01, 0.03, 0.06, 0.1, 0.5, 1.0)),
    *((f"eyes {ipd:g} m apart", {"ipd_m": ipd}) for ipd in (1e-4, 0.005, 0.02, 0.2)),
    *((f"eyes at {distance:g} m", {"distance_m": distance}) for distance in (0.1, 0.3, 1.5, 4.0, 30.0)),
)
USUAL = {"gap_m": 0.06, "ipd_m": 0.06, "distance_m": 0.54}


def problem_of(geometry: tuple[str, dict[str, float]]) -> Problem:
    """The problem of one of the geometries."""
    return Problem(**(USUAL | geometry[1]))


def trials(methods: dict[str, Method] | None = None) -> Iterator[Trial]:
    """Every case of the solve. `methods`: solvers to try beside CG and the mean of the targets."""
    solvers: dict[str, tuple[Method, int | None]] = {
        "CG-30": (partial(cg, iterations=30), 30),
        "mean of targets": (mean, None),
    }
    solvers |= {name: (method, None) for name, method in (methods or {}).items()}
    limits = {"sart": SEQUENTIAL}
    for name, change in GEOMETRIES:
        geometry = USUAL | change
        run = partial(stiffness, **geometry)
        yield Trial(STAGE, f"spectrum, {name}", run, measure="of the largest")
        for method_name, (method, iterations) in solvers.items():
            solve = partial(converges, method, **geometry, iterations=iterations, limit=limits.get(method_name, 1.05))
            yield Trial(STAGE, f"{method_name}, {name}", solve, measure="of the difference")
    yield refusal(
        STAGE,
        "eyes so far aside that no ray crosses every panel",
        partial(
            eye_operator, [1.01, 30.0, 0.0], PanelStack(0.5, 0.3, (-1.0, 0.0, 1.0), 32, 16), width_px=32, height_px=16,
            fov_deg=40.0,
        ),
    )  # fmt: skip
