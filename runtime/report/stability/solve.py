"""How stiff the two-eye problem is, and what each method makes of it.

The stiff part is the lowest frequency of the difference between the eyes: one cycle across the panels, which the
outer panels must carry by their parallax. Its eigenvalue is 3 - |1 + exp(2iks_0) + exp(2iks_2)|. What is wanted has
that wave, finer ones, and a common part that any panel can show. What a method's panels show is told by rays of 50
digits, and how good it could be by the exact least squares within the box (scipy): neither shares anything with the
methods.
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
from runtime.report.stability import exact
from runtime.report.stability.trial import Answer, Trial

STAGE = "solve"
AMPLITUDE = 0.1  # of the wanted difference between the eyes at its lowest frequency, in phase units of pi/2
FINER = ((5, 0.05), (11, 0.03))  # cycles across the panels, and amplitude, of more of the difference
COMMON = ((3, 0.15), (7, 0.1))  # the same of what both eyes want
WIDTH_M, HEIGHT_M, WIDTH_PX, HEIGHT_PX = 0.5184, 0.2916, 64, 4
FLOOR = 0.002  # a grey level of 8 bits, on one of three panels, of the wanted
Method = Callable[["Problem"], F32]  # (N, height, width, C) panel values in [0, 1]


def waves(parts: Sequence[tuple[int, float]]) -> F64:
    """(WIDTH_PX,) a sum of sines across the picture, their phases apart."""
    u = (np.arange(WIDTH_PX) + 0.5) / WIDTH_PX
    result: F64 = np.sum([size * np.sin(2 * np.pi * cycles * u + cycles - 1) for cycles, size in parts], axis=0)
    return result


class Problem:
    """Two eyes that want a common picture and a difference between them, in grey."""

    def __init__(self, *, gap_m: float, ipd_m: float, distance_m: float) -> None:
        self.stack = PanelStack(WIDTH_M, HEIGHT_M, (-gap_m, 0.0, gap_m), WIDTH_PX, HEIGHT_PX)
        self.gap_m, self.ipd_m, self.distance_m = self.geometry = (gap_m, ipd_m, gap_m + distance_m)
        self.eyes_m = np.array([[self.distance_m, side * ipd_m / 2, 0.0] for side in (-1, 1)])
        self.fov_deg = math.degrees(2 * math.atan(WIDTH_M / 2 / self.distance_m))
        difference, common = waves([(1, AMPLITUDE), *FINER]), waves(COMMON)
        self.targets = [1.5 + common + sign * difference / 2 for sign in (-1, 1)]  # phase of each column
        self.wanted: list[F32] = [
            np.broadcast_to(
                np.sin(np.pi / 2 * target).astype(np.float32)[None, :, None] ** 2, (HEIGHT_PX, WIDTH_PX, 3)
            ).copy()
            for target in self.targets
        ]

    def condition(self) -> float:
        """Largest over smallest eigenvalue for that wave; the smallest would lose digits in doubles."""
        k = 2 * exact.mp.pi / exact.mpf(WIDTH_M)
        parallaxes_m = [self.ipd_m / 2 * x_m / (self.distance_m - x_m) for x_m in (-self.gap_m, self.gap_m)]
        c = 1 + sum(exact.mp.exp(2j * k * exact.mpf(parallax_m)) for parallax_m in parallaxes_m)
        return float((3 + abs(c)) / (3 - abs(c)))

    def left_over(self, layers: F32) -> float:
        """RMS of what is missing of the wanted phases over both eyes, relative to how they vary: 1 for flat grey."""
        flat = np.asarray(layers, np.float64).mean(axis=-1).reshape(self.stack.count * HEIGHT_PX * WIDTH_PX)
        missing, whole = 0.0, 0.0
        for side, (matrix, columns) in enumerate(exact_operator(*self.geometry)):
            target = self.targets[side][columns]
            missing += float(((matrix @ flat - target) ** 2).sum())
            whole += float(((target - 1.5) ** 2).sum())
        return math.sqrt(missing / whole)


@lru_cache(maxsize=64)
def exact_operator(gap_m: float, ipd_m: float, distance_m: float) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Each eye's rays that cross every panel, by 50 digits: (rays, N·h·w) bilinear weights, and their columns."""
    fov_deg = math.degrees(2 * math.atan(WIDTH_M / 2 / distance_m))
    stack = PanelStack(WIDTH_M, HEIGHT_M, (-gap_m, 0.0, gap_m), WIDTH_PX, HEIGHT_PX)
    half, found = exact.mpf("0.5"), []
    for sign in (-1, 1):
        eye = exact.vector([distance_m, sign * ipd_m / 2, 0.0])
        upper: list[list[tuple[int, dict[int, float]]]] = []
        for v in range(HEIGHT_PX // 2):  # the eyes are level with the middle: the lower half mirrors the upper
            upper.append([])
            for u in range(WIDTH_PX):
                ray = exact.ray(eye, u + half, v + half, width_px=WIDTH_PX, height_px=HEIGHT_PX, fov_deg=fov_deg)
                weights: dict[int, float] = {}
                for number in range(3):
                    x, y = exact.on_panel(eye, ray, stack, number)
                    if not (half < x < WIDTH_PX - half and half < y < HEIGHT_PX - half):
                        break
                    left, top = int(exact.mp.floor(x - half)), int(exact.mp.floor(y - half))
                    fx, fy = x - half - left, y - half - top
                    for row, wy in ((top, 1 - fy), (top + 1, fy)):
                        for column, wx in ((left, 1 - fx), (left + 1, fx)):
                            if wx * wy:
                                weights[(number * HEIGHT_PX + row) * WIDTH_PX + column] = float(wx * wy)
                else:
                    upper[-1].append((u, weights))
        lower = [[(u, {_mirrored(i): w for i, w in row.items()}) for u, row in line] for line in reversed(upper)]
        columns = [u for line in upper + lower for u, _ in line]
        rows = [row for line in upper + lower for _, row in line]
        lengths = np.cumsum([0, *(len(row) for row in rows)])
        data = np.array([w for row in rows for w in row.values()])
        indices = np.array([i for row in rows for i in row])
        found.append((csr_matrix((data, indices, lengths), shape=(len(rows), 3 * HEIGHT_PX * WIDTH_PX)), columns))
    return found[0], found[1]


def _mirrored(index: int) -> int:
    """The pixel that is as far below the middle of its panel as another is above it."""
    panel, row, column = index // (HEIGHT_PX * WIDTH_PX), index // WIDTH_PX % HEIGHT_PX, index % WIDTH_PX
    return (panel * HEIGHT_PX + HEIGHT_PX - 1 - row) * WIDTH_PX + column


@lru_cache(maxsize=64)
def optimum(gap_m: float, ipd_m: float, distance_m: float) -> float:
    """What is left of it at least, by any values from 0 to 1 that are the same in every row, as the wanted are."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m - gap_m)
    parts = exact_operator(gap_m, ipd_m, distance_m)
    half = [len(columns) // 2 for _, columns in parts]  # the other half is its mirror image, and wants the same
    targets = np.concatenate([problem.targets[side][parts[side][1][: half[side]]] for side in (0, 1)])
    rows = np.vstack([parts[side][0].toarray()[: half[side]] for side in (0, 1)])
    same_rows = rows.reshape(len(rows), 3, HEIGHT_PX, WIDTH_PX).sum(axis=2).reshape(len(rows), -1)
    best = lsq_linear(same_rows, targets, bounds=(0, 1), tol=1e-9)
    return math.sqrt(2 * best.cost / float(((targets - 1.5) ** 2).sum()))


def converges(method: Method, gap_m: float, ipd_m: float, distance_m: float) -> Answer:
    """What a method leaves of what is wanted, against the least that any panel values leave."""
    problem = Problem(gap_m=gap_m, ipd_m=ipd_m, distance_m=distance_m)
    left, least = problem.left_over(method(problem)), optimum(*problem.geometry)
    note = f"no panel values leave less than {least:.3g}"
    if left < 0.98 * least - FLOOR:
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
            yield Trial(STAGE, f"{method_name}, {name}", run, measure="of the wanted", floor=FLOOR)
