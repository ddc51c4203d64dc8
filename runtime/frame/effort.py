"""Choose the raster and the number of steps that give each solution the least expected error.

A solution that takes c seconds stays on the panels for T = max(c, refresh period), and is computed for the eyes at the
middle of that interval. Averaged over it, the squared error of light at the true eyes is the error for a still viewer
plus the error of a stale view (docs/mathematics.md, "Effort"):

    J = Q(raster, steps) + D(sqrt(2·sigma² + v²·T²/12 + l²), T/sqrt(12)),
    D(d, t) = y / (1 + y/D_max),    y = a·d²/(d + d0) + b·t²

Here sigma is the tracker's error per axis at that instant, v the head's speed, and l the distance moved beyond the
tracker's horizon. A common factor scales these three, so that predicted displacements match observed ones. The rates a
and b describe how the picture changes with the head's position and with time; D_max is half its variance. All are
measured on successive targets.

Until a solution is complete, the panels show the previous one, with error E, and do not respond to a head that starts
moving. Over a horizon H the mean error is (c·E + (H - c)·J) / H + D_max·(c/H)²/2. The effort with the least mean is
chosen, with a preference for the present effort and for faster ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from runtime.records import Effort, Measures

SOLVING_STAGES = ("render", "prepare", "inference", "finish", "step")
HORIZON_S = 1.0  # time for which head and content are assumed to continue unchanged
EQUAL = 1.03  # among efforts whose expected errors differ by less, choose the fastest
PREFERRED = 0.93  # switch effort only if its expected error is below this share of the current one's
GAIN = 0.2  # weight of the newest measurement in a running mean
KEPT_SOLUTIONS = 100  # a raster's times are forgotten after this many solutions on others, as the load may have changed
# Squared error of light after k steps, relative to no steps: solver `best`, mean over the scenes demo and texture at
# 960x540, tracking error 2 mm.
STEP_SHARES = (1.0, 0.77, 0.61, 0.58, 0.53, 0.53, 0.51, 0.51, 0.51)
FIRST_RESIDUAL = 1e-3  # squared error of a solution without steps; initial value
FIRST_DETAIL = {
    1: 0.0,
    2: 1.6e-3,
    3: 3.6e-3,
    4: 6e-3,
}  # squared error due to a coarse raster's lost detail; initial values
FIRST_RATE = 0.5  # per m, from the demo scene
BLUR_M = 4e-3  # d0: beyond it, outlines are displaced by more than their blur, and the error grows linearly
FIRST_CONTRAST = 0.03
FORESIGHT_GAIN = 1 / 60  # weight of the newest refresh
LEAST_SCALE, MOST_SCALE = 0.02, 4.0
TAIL = 0.02  # slope in y that remains at saturation, so that a smaller distance is always better
SCALE_M, SCALE_S = 5e-3, 0.1  # units of displacement and time in the fit of the rates


@dataclass(frozen=True, slots=True)
class Costs:
    """Time of each effort on this machine and scene, in milliseconds."""

    stages: Mapping[int, Mapping[str, float]]  # by reduction and SOLVING_STAGES; `step` is the time of one step

    def ms(self, effort: Effort) -> float:
        """Return the time from the start of a solution to complete layers."""
        stages = self.stages[effort.reduction]
        steps = effort.steps - (effort.continued_from or 0)
        begun = ("finish",) if effort.continued_from is not None else ("render", "prepare", "inference", "finish")
        return sum(stages.get(stage, 0.0) for stage in begun) + steps * stages.get("step", 0.0)


def simulated_costs(stage_ms: Mapping[str, float], reductions: Iterable[int]) -> Costs:
    """Scale the configured costs of the full raster (`loop.simulated_stage_ms`) by pixel count."""
    return Costs({by: {stage: stage_ms.get(stage, 0.0) / by**2 for stage in SOLVING_STAGES} for by in reductions})


class CostBook:
    """Running means of the stage times of each raster. Times of a raster long unused are forgotten."""

    def __init__(self, first: Mapping[int, Mapping[str, float]]) -> None:
        """Create a book with the times `first`, measured with full pictures before the first refresh.

        first: milliseconds by reduction and stage.
        """
        self.first = first
        self._measured: dict[int, dict[str, float]] = {}
        self._unused: dict[int, int] = {}  # by reduction: solutions on other rasters since its last one

    def learn(self, effort: Effort, stage_ms: Mapping[str, float]) -> None:
        """Update the means with the stage times of one solution."""
        self._unused = {by: count + 1 for by, count in self._unused.items()} | {effort.reduction: 0}
        self._measured = {by: means for by, means in self._measured.items() if self._unused[by] < KEPT_SOLUTIONS}
        means = self._measured.setdefault(effort.reduction, {})
        steps = effort.steps - (effort.continued_from or 0)
        for stage in SOLVING_STAGES:
            if effort.continued_from is not None and stage not in ("finish", "step"):
                continue
            if stage == "step" and not steps:
                continue
            spent_ms = stage_ms.get(stage, 0.0) / (steps if stage == "step" else 1)
            means[stage] = means.get(stage, spent_ms) + GAIN * (spent_ms - means.get(stage, spent_ms))

    def costs(self) -> Costs:
        """Return the current costs.

        Costs of unmeasured rasters are scaled from measured ones. A raster's cost is at most that of the next finer
        raster divided by the ratio of the widths, so that a first measurement delayed by other work does not exclude
        it.
        """
        measured_ms = sum(sum(stages.values()) for stages in self._measured.values())
        first_ms = sum(self.first.get(by, {}).get(s, 0.0) for by, stages in self._measured.items() for s in stages)
        scale = measured_ms / first_ms if first_ms > 0 and measured_ms > 0 else 1.0
        costs: dict[int, dict[str, float]] = {}
        finer: tuple[int, dict[str, float]] | None = None
        for by, first in sorted(self.first.items()):
            costs[by] = {stage: scale * ms for stage, ms in first.items()}
            if finer is not None:
                most = {stage: ms * finer[0] / by for stage, ms in finer[1].items()}
                costs[by] = {stage: min(ms, most.get(stage, ms)) for stage, ms in costs[by].items()}
            costs[by] |= self._measured.get(by, {})
            finer = by, costs[by]
        return Costs(costs)


@dataclass(frozen=True, slots=True)
class Outlook:
    """Forecast by the tracker of the eyes in the middle of a solution's display time, for one effort."""

    sigma_m: float = 0.0  # standard deviation per axis of the point midway between the eyes
    speed_m_s: float = 0.0
    lag_m: float = 0.0  # distance that the head moves beyond the tracker's horizon

    def moved_m2(self, life_s: float) -> float:
        """Return the mean squared distance between a solution's eyes and the true ones while it is shown."""
        return 2 * self.sigma_m**2 + (self.speed_m_s * life_s) ** 2 / 12 + self.lag_m**2


@dataclass(slots=True)
class Foresight:
    """Ratio of observed to expected squared distances between solutions' eyes and the true ones."""

    scale: float = 1.0
    _expected: float = 0.0
    _found: float = 0.0

    def learn(self, *, expected_m2: float, found_m2: float) -> None:
        """Update the ratio with one refresh."""
        self._expected += FORESIGHT_GAIN * (expected_m2 - self._expected)
        self._found += FORESIGHT_GAIN * (found_m2 - self._found)
        if self._expected > 0.0:
            self.scale = min(max(self._found / self._expected, LEAST_SCALE), MOST_SCALE)


@dataclass(slots=True)
class PictureStatistics:
    """Running means of the solutions' errors, and of the rates at which their pictures change."""

    residual: float = FIRST_RESIDUAL  # squared error of a solution without steps, on the raster solved on
    detail: dict[int, float] = field(default_factory=lambda: dict(FIRST_DETAIL))  # by reduction
    rate_m: float = FIRST_RATE  # a, per m
    rate_s2: float = 0.0  # b, per s²
    contrast: float = FIRST_CONTRAST  # D_max
    _measured: bool = False

    def learn(self, measures: Measures, effort: Effort) -> None:
        """Update the means with one solution's measures."""
        gain = GAIN if self._measured else 1.0
        if measures.residual is not None:
            residual = measures.residual / step_share(effort.steps)
            self.residual += gain * (residual - self.residual)
            self._measured = True
        for reduction, value in measures.detail.items():
            self.detail[reduction] = value
        if measures.contrast is not None:
            self.contrast = max(measures.contrast, 1e-4)
        if measures.change is not None:
            self._learn_change(*measures.change)

    def stale(self, distance_m: float, elapsed_s: float) -> float:
        """Return D, the squared error of a picture drawn `elapsed_s` earlier and `distance_m` away."""
        y = self.rate_m * _outlines_off_m(distance_m) + self.rate_s2 * elapsed_s**2
        return y / (1 + y / self.contrast) + TAIL * y

    def own(self, effort: Effort) -> float:
        """Return Q, the squared error at the eyes that a solution is for."""
        return self.detail.get(effort.reduction, 0.0) + self.residual * step_share(effort.steps)

    def _learn_change(self, changed: float, distance_m: float, elapsed_s: float) -> None:
        """Fit y = a·d²/(d + d0) + b·t² by normalised least mean squares."""
        y = changed / max(1 - changed / self.contrast, 0.1)
        off, t2 = _outlines_off_m(distance_m) / SCALE_M, (elapsed_s / SCALE_S) ** 2
        a, b = self.rate_m * SCALE_M, self.rate_s2 * SCALE_S**2
        weight = GAIN * (y - a * off - b * t2) / max(off * off + t2 * t2, 1e-3)
        self.rate_m = max(a + weight * off, 1e-5) / SCALE_M
        self.rate_s2 = max(b + weight * t2, 0.0) / SCALE_S**2


def _outlines_off_m(distance_m: float) -> float:
    return distance_m**2 / (distance_m + BLUR_M)


def step_share(steps: int) -> float:
    """Return the squared error after `steps` steps relative to none."""
    return STEP_SHARES[min(steps, len(STEP_SHARES) - 1)]


def candidates(reductions: tuple[int, ...], steps: int) -> list[Effort]:
    """List the efforts to choose from: every raster with 0, 1, 2, 4 and all of the model's steps."""
    counts = sorted({count for count in (0, 1, 2, 4, steps) if count <= steps})
    return [Effort(reduction, count) for reduction in reductions for count in counts]


class EffortChooser:
    """Chooses the next solution's effort from running statistics and the previous choice."""

    def __init__(self) -> None:
        self.pictures, self.foresight = PictureStatistics(), Foresight()
        self._chosen: Effort | None = None

    def choose(
        self,
        efforts: list[Effort],
        costs: Costs,
        outlook: Callable[[float], Outlook],
        *,
        shown_error: float,
        period_ms: float,
        horizon_s: float = HORIZON_S,
    ) -> Effort:
        """Return the effort with the least mean error over the horizon.

        outlook: maps a solution's cost in milliseconds to its forecast; shown_error: error of the displayed picture.
        """
        means: dict[Effort, float] = {}
        for effort in efforts:
            cost_ms = costs.ms(effort)
            error = self.expected_error(effort, outlook(cost_ms), life_s=max(cost_ms, period_ms) / 1e3)
            means[effort] = self.mean_error(error, cost_ms, shown_error=shown_error, horizon_s=horizon_s)
        least = min(means.values())
        best = min((effort for effort in means if means[effort] <= EQUAL * least), key=costs.ms)
        if self._chosen in means and means[best] > PREFERRED * means[self._chosen]:
            best = self._chosen
        self._chosen = best
        return best

    def mean_error(self, error: float, cost_ms: float, *, shown_error: float, horizon_s: float) -> float:
        """Return the mean over the horizon of `shown_error` until completion and `error` afterwards.

        If the head starts to move before completion, the view is stale until then. This has probability c/H and lasts
        c/2 on average.
        """
        waited = min(cost_ms / 1e3 / horizon_s, 0.9)
        return waited * shown_error + (1 - waited) * error + waited**2 / 2 * self.pictures.contrast

    def expected_error(self, effort: Effort, outlook: Outlook, *, life_s: float) -> float:
        """Return J, the mean squared error of light while the solution is shown."""
        spread_s = life_s / 12**0.5
        moved_m = (self.foresight.scale * outlook.moved_m2(life_s)) ** 0.5
        return self.pictures.own(effort) + self.pictures.stale(moved_m, spread_s)
