"""How stiff the two-eye problem is, and what each method makes of it.

The stiff part is the lowest frequency of the difference between the eyes: one cycle across the panels, which the
outer panels must carry by their parallax. Its eigenvalue is 3 - |1 + exp(2iks_0) + exp(2iks_2)|. The target has
that wave, finer ones, and a common part that any panel can show. What a method's panels show is traced here, ray by
ray, and how good it could be is the exact least squares within the bounds (scipy): neither shares code with them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear
from scipy.sparse import csr_matrix

from runtime.optics.stack import PanelStack
from runtime.records import F32, F64
from runtime.report.stability.trial import Answer, Trial

STAGE = "solve"
AMPLITUDE = 0.1  # of the target difference between the eyes at its lowest frequency, in phase units of pi/2
FINER = ((5, 0.05), (11, 0.03))  # cycles across the panels, and amplitude, of more of the difference
COMMON = ((3, 0.15), (7, 0.1))  # the same of what both eyes want
WIDTH_M, HEIGHT_M, WIDTH_PX, HEIGHT_PX = 0.5184, 0.0648, 64, 8
FLOOR = 0.002  # a grey level of 8 bits, on one of three panels, relative to the target
Method = Callable[["Problem"], F32]  # (N, height, width, C) panel values in [0, 1]


def waves(parts: Sequence[tuple[int, float]]) -> F64:
    """(WIDTH_PX,) a sum of sines across the picture, their phases apart."""
    u = (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX
    result: F64 = np.sum([size * np.sin(2 * np.pi * cycles * u + cycles - 1) for cycles, size in parts], axis=0)
    return result


class Problem:
    """Two eyes whose targets are a common picture and a difference between them, in grey."""

    def __init__(self, *, gap_m: float, ipd_m: float, distance_m: float) -> None:
        self.stack = PanelStack(WIDTH_M, HEIGHT_M, (-gap_m, 0.0, gap_m), WIDTH_PX, HEIGHT_PX)
        self.gap_m, self.ipd_m, self.distance_m = self.geometry = (gap_m, ipd_m, gap_m + distance_m)
        self.eyes_m = np.array([[self.distance_m, side * ipd_m / 2, 0.0] for side in (-1, 1)])
        self.fov_deg = math.degrees(2 * math.atan(WIDTH_M / 2 / self.distance_m))
        difference, common = waves([(1, AMPLITUDE), *FINER]), waves(COMMON)
        self.targets = [1.5 + common + sign * difference / 2 for sign in (-1, 1)]  # phase of each column
        self.pictures: list[F32] = [
            np.broadcast_to(
                np.sin(np.pi / 2 * target).astype(np.float32)[None, :, None] ** 2, (HEIGHT_PX, WIDTH_PX, 3)
            ).copy()
            for target in self.targets
        ]

    def condition(self) -> float:
        """Largest over smallest eigenvalue for that wave."""
        parallaxes_m = [self.ipd_m / 2 * x_m / (self.distance_m - x_m) for x_m in (-self.gap_m, self.gap_m)]
        c = 1 + sum(np.exp(4j * np.pi / WIDTH_M * parallax_m) for parallax_m in parallaxes_m)
        return float((3 + abs(c)) / (3 - abs(c)))

    def residual(self, layers: F32) -> float:
        """RMS residual of the target phases over both eyes, relative to how they vary: 1 for mid-grey."""
        flat = np.asarray(layers, np.float64).mean(axis=-1).reshape(self.stack.count * HEIGHT_PX * WIDTH_PX)
        missing, whole = 0.0, 0.0
        for side, (matrix, columns) in enumerate(traced(*self.geometry)):
            target = self.targets[side][columns]
            missing += float(((matrix @ flat - target) ** 2).sum())
            whole += float(((target - 1.5) ** 2).sum())
        return math.sqrt(missing / whole)


@lru_cache(maxsize=64)
def traced(gap_m: float, ipd_m: float, distance_m: float) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Rays of each eye that cross every panel: (rays, N·h·w) bilinear weights, and picture columns."""
    focal, found = WIDTH_PX * distance_m / WIDTH_M, []
    v, u = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX] + 0.5
    for sign in (-1, 1):
        eye = np.array([distance_m, sign * ipd_m / 2])
        back = eye / np.hypot(*eye)
        across = (u - WIDTH_PX / 2) / focal
        x, y = -back[0] - across * back[1], -back[1] + across * back[0]  # the rays' directions; z is up
        z = -(v - HEIGHT_PX / 2) / focal
        weights, indices, inside = [], [], np.ones(u.shape, bool)
        for number, x_m in enumerate((-gap_m, 0.0, gap_m)):
            t = (x_m - eye[0]) / x
            column = ((eye[1] + t * y) / WIDTH_M + 0.5) * WIDTH_PX - 0.5
            row = (0.5 - t * z / HEIGHT_M) * HEIGHT_PX - 0.5
            inside &= (column > 0) & (column < WIDTH_PX - 1) & (row > 0) & (row < HEIGHT_PX - 1)
            left, top = np.floor(column), np.floor(row)
            for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
                share = np.abs(1 - down - (row - top)) * np.abs(1 - right - (column - left))
                weights.append(share)
                indices.append((number * HEIGHT_PX + top + down) * WIDTH_PX + left + right)
        data, places = (np.stack(parts)[:, inside].T for parts in (weights, indices))
        rays = np.arange(0, data.size + 1, data.shape[1])
        matrix = csr_matrix(
            (data.ravel(), places.ravel().astype(int), rays), shape=(len(data), 3 * HEIGHT_PX * WIDTH_PX)
        )
        found.append((matrix, np.broadcast_to(np.arange(WIDTH_PX), u.shape)[inside]))
    return found[0], found[1]


@lru_cache(maxsize=64)
def optimum(gap_m: float, ipd_m: float, distance_m: float) -> float:
    """The least residual of any values from 0 to 1 that are the same in every row, as the targets are."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m - gap_m)
    parts = traced(gap_m, ipd_m, distance_m)
    targets = np.concatenate([problem.targets[side][parts[side][1]] for side in (0, 1)])
    rows = np.vstack([matrix.toarray() for matrix, _ in parts])
    same_rows = rows.reshape(len(rows), 3, HEIGHT_PX, WIDTH_PX).sum(axis=2).reshape(len(rows), -1)
    best = lsq_linear(same_rows, targets, bounds=(0, 1), tol=1e-9)
    return math.sqrt(2 * best.cost / float(((targets - 1.5) ** 2).sum()))


def converges(method: Method, gap_m: float, ipd_m: float, distance_m: float) -> Answer:
    """A method's residual against the least that any panel values leave."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m)
    left, least = problem.residual(method(problem)), optimum(*problem.geometry)
    note = f"no panel values leave less than {least:.3g}"
    if left < 0.8 * least - FLOOR:  # rows that differ a little can do with less
        return Answer(math.nan, 1.0, problem.condition(), note=f"{left:.3g} is impossible: {note}")
    # Serving the eyes in turn leaves all of the difference to one of them; nothing is worse than flat grey.
    return Answer(left, 1.0, problem.condition(), left - least, note=note)


GEOMETRIES: Sequence[tuple[str, dict[str, float]]] = (
    *((f"gap {gap:g} m", {"gap_m": gap}) for gap in (1e-4, 5e-3, 0.03, 0.1, 1.0)),
    *((f"eyes {ipd:g} m apart", {"ipd_m": ipd}) for ipd in (1e-4, 0.005, 0.2)),
    *((f"eyes at {distance:g} m", {"distance_m": distance}) for distance in (0.1, 1.5, 30.0)),
)
USUAL = {"gap_m": 0.06, "ipd_m": 0.06, "distance_m": 0.54}


def trials(methods: Mapping[str, Method]) -> Iterator[Trial]:
    """Every case of the solve."""
    for name, change in GEOMETRIES:
        geometry = USUAL | change
        for method_name, method in methods.items():
            run = partial(converges, method, **geometry)
            yield Trial(STAGE, f"{method_name}, {name}", run, measure="of the target", floor=FLOOR)
