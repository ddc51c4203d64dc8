"""Choose the raster and number of steps so that each solution has the least expected error.

docs/mathematics.md, "Effort", has the equations: a solution of cost c, shown for the eyes expected at the middle of its
display times, which spread by s, has the error J (E1, E2). Until it is complete, the panels show the previous one, with
error E, and do not respond if the head starts moving (E3). The effort with the lowest mean error over the horizon is
chosen, unless the current effort or a faster one is nearly as good. The rates a, b and D_max are measured on successive
target pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from runtime.records import SOLVING_STAGES, Effort, Measures

FOCUS_DRAWN, FOCUS_STEP = 5, 3  # with focus, the drawn pictures per eye, and a step's cost relative to one without
PER_PERSON = ("render", "prepare", "inference", "step")  # stages that take as many times as long for several people
REST = "rest"  # time between two solutions that belongs to no stage, for measurements and for waking up
HORIZON_S = 1.0  # how long head and content are assumed to continue as they are
EQUAL = 1.05  # the fastest effort with a mean error at most this many times the lowest is chosen
PREFERRED = 0.92  # a slower effort is chosen if its mean error is below this share of the current effort's
GAIN = 0.2  # weight given to the latest measurement in a running mean
LOAD_SHARE = 0.8  # exponent of a raster's slowdown in that of the others; the rest is attributed to the raster itself
KEPT_SOLUTIONS = 100  # a raster's times are discarded after this many solutions on other rasters
# Squared light error after k steps, relative to none. Steps after the fourth hardly matter.
STEP_SHARES = (1.0, 0.68, 0.53, 0.36, 0.34, 0.34, 0.33, 0.33, 0.33)
FIRST_RESIDUAL = 1e-3  # initial estimate of the squared error on the full raster without any steps
FIRST_RATE = 0.5  # initial estimate of a, per metre, from the demo scene
BLUR_M = 4e-3  # d0; farther away, outlines are displaced by more than their blur and the error grows linearly
FIRST_CONTRAST = 0.03  # initial estimate of D_max
FORESIGHT_GAIN = 1 / 60  # weight given to the latest refresh in the running means kept by `Foresight`
LEAST_SCALE, MOST_SCALE = 0.02, 4.0
MOST_FOUND = 16.0  # limit on the ratio at a single refresh, because samples may be mistaken
TAIL = 0.02  # slope with respect to y left at saturation, so that a smaller distance is always better
SCALE_M, SCALE_S = 5e-3, 0.1  # units of displacement and time used in fitting the rates


@dataclass(frozen=True, slots=True)
class RasterError:
    """Squared light errors of solutions on one raster without any steps."""

    share: float  # relative to the full raster
    first_detail: float  # due to detail lost on the raster: an initial estimate, until measured


# By reduction. Shares here and in STEP_SHARES: `balanced` solver, means over the demo, texture and moving scenes at
# 960x540, with a still and a leaning head and with tracking errors of 0.3 and 3 mm, as measured by `SolutionMeter`.
RASTER_ERRORS = {
    1: RasterError(1.0, 0.0),
    2: RasterError(2.1, 1.6e-3),
    3: RasterError(2.5, 3.6e-3),
    4: RasterError(3.5, 6e-3),
}


@dataclass(frozen=True, slots=True)
class Costs:
    """Time taken by each kind of solution on this machine with this scene, in milliseconds."""

    stages: Mapping[int, Mapping[str, float]]  # keyed by reduction, then stage or REST; `step`: one step

    def for_people(self, count: int) -> Costs:
        """Return the costs of solutions for several people: drawing and steps take as many times as long."""
        if count < 2:
            return self
        return Costs({by: stages_for(of, people=count) for by, of in self.stages.items()})

    def ms(self, effort: Effort) -> float:
        """Return how long a solution takes from start to complete layers, in milliseconds."""
        stages = self.stages.get(effort.reduction, {})
        steps = effort.steps - (effort.continued_from or 0)
        begun = ("finish", REST) if effort.continued_from is not None else (*SOLVING_STAGES[:-1], REST)
        step_ms = stages.get("step", 0.0)
        if not effort.focus:
            return sum(stages.get(stage, 0.0) for stage in begun) + steps * step_ms
        drawn_ms = (FOCUS_DRAWN - 1) * stages.get("render", 0.0)
        return sum(stages.get(stage, 0.0) for stage in begun) + steps * FOCUS_STEP * step_ms + drawn_ms


def stages_for(stage_ms: Mapping[str, float], *, people: float) -> dict[str, float]:
    """Return stage times for several people, given those for one. `people` below 1 is the reverse."""
    return {stage: ms * people if stage in PER_PERSON else ms for stage, ms in stage_ms.items()}


def simulated_costs(stage_ms: Mapping[str, float], reductions: Iterable[int]) -> Costs:
    """Scale the full raster's stage times in ms (`loop.simulated_stage_ms`) by pixel count, for each
    reduction.
    """
    return Costs({by: {stage: stage_ms.get(stage, 0.0) / by**2 for stage in SOLVING_STAGES} for by in reductions})


class CostBook:
    """Keeps running means of each raster's stage times.

    When a solution changes the means of its raster, those of the other rasters change nearly in proportion, because
    other work on the machine slows down all of them. If a raster has not been used for `KEPT_SOLUTIONS` solutions, its
    times are discarded, because the scene may have changed.
    """

    def __init__(self, first: Mapping[int, Mapping[str, float]]) -> None:
        """Create a cost book with times in ms, by reduction and stage, measured before the first refresh."""
        self.first = first
        self._measured: dict[int, dict[str, float]] = {}
        self._unused: dict[int, int] = {}  # solutions on other rasters since this one's last use, by reduction

    def learn(self, effort: Effort, stage_ms: Mapping[str, float]) -> None:
        """Update the means with one solution's stage times, in milliseconds, unless it has focus."""
        if effort.focus:
            return
        self._unused = {by: count + 1 for by, count in self._unused.items()} | {effort.reduction: 0}
        self._measured = {by: means for by, means in self._measured.items() if self._unused[by] < KEPT_SOLUTIONS}
        if effort.reduction not in self._measured:
            expected = self.costs().stages.get(effort.reduction, {})
            self._measured[effort.reduction] = {s: ms for s, ms in expected.items() if s != REST or self._measured}
        means = self._measured[effort.reduction]
        steps = effort.steps - (effort.continued_from or 0)
        begun = ("finish", REST) if effort.continued_from is not None else (*SOLVING_STAGES[:-1], REST)
        spent_ms = {stage: stage_ms.get(stage, 0.0) for stage in begun}
        if steps:
            spent_ms["step"] = stage_ms.get("step", 0.0) / steps
        known = [stage for stage in spent_ms if stage in means]
        before_ms = sum(means[stage] for stage in known)
        means |= {stage: means.get(stage, ms) + GAIN * (ms - means.get(stage, ms)) for stage, ms in spent_ms.items()}
        slowdown = sum(means[stage] for stage in known) / before_ms if before_ms > 0.0 else 1.0
        for by, stages in self._measured.items():
            for stage in stages:
                if by != effort.reduction:
                    stages[stage] *= slowdown**LOAD_SHARE
                elif stage not in spent_ms:
                    stages[stage] *= slowdown

    def costs(self) -> Costs:
        """Return the current solution costs on every raster.

        If a raster has not been measured recently, its initial times are used, scaled by the ratio of recent to initial
        times on the measured rasters. They are limited to the times on the next finer raster, divided by the ratio of
        the two raster widths. Without this limit, a raster might never be chosen again if other work had slowed down
        its initial measurement.
        """
        both = [
            (ms, self.first[by][s]) for by, of in self._measured.items() for s, ms in of.items() if s in self.first[by]
        ]
        measured_ms, first_ms = sum(ms for ms, _ in both), sum(ms for _, ms in both)
        scale = measured_ms / first_ms if first_ms > 0 and measured_ms > 0 else 1.0
        latest = min(self._measured, key=self._unused.__getitem__, default=None)
        rest_ms = 0.0 if latest is None else self._measured[latest].get(REST, 0.0)
        costs: dict[int, dict[str, float]] = {}
        finer: tuple[int, dict[str, float]] | None = None
        for by, first in sorted(self.first.items()):
            costs[by] = {stage: scale * ms for stage, ms in first.items()}
            if finer is not None:
                most = {stage: ms * finer[0] / by for stage, ms in finer[1].items()}
                costs[by] = {stage: min(ms, most.get(stage, ms)) for stage, ms in costs[by].items()}
            costs[by] |= {REST: rest_ms, **self._measured.get(by, {})}
            finer = by, costs[by]
        return Costs(costs)


@dataclass(frozen=True, slots=True)
class Outlook:
    """Expected accuracy of the eyes predicted for a solution, which depends on the solution's effort."""

    sigma_m: float = 0.0  # standard deviation of the predicted midpoint of the eyes along each axis
    speed_m_s: float = 0.0  # the head's speed
    lag_m: float = 0.0  # how far the head moves beyond the tracker's prediction horizon

    def moved_m2(self, spread_s: float) -> float:
        """Return the mean squared distance from a solution's eyes to the true eyes, in m²."""
        return 2 * self.sigma_m**2 + (self.speed_m_s * spread_s) ** 2 + self.lag_m**2


def display_spread_s(cost_ms: float, *, period_ms: float) -> float:
    """Return the RMS deviation, from their middle, of the display times of a solution, in seconds. Those
    of n refreshes deviate by the period times sqrt((n² - 1)/12). A solution is shown at one refresh at least, and
    otherwise at as many as fit in the time taken by the next one.
    """
    return float(max(cost_ms**2 - period_ms**2, 0.0) ** 0.5) / 12**0.5 / 1e3


@dataclass(slots=True)
class Foresight:
    """Estimates the ratio of observed to expected squared eye displacement. A displacement is the
    distance from the eyes that a solution was computed for to the true eyes while it is shown.
    """

    scale: float = 1.0
    _expected: float = 0.0
    _found: float = 0.0

    def learn(self, *, expected_m2: float, found_m2: float) -> None:
        """Update the ratio with the distances found at one refresh."""
        self._expected += FORESIGHT_GAIN * (expected_m2 - self._expected)
        self._found += FORESIGHT_GAIN * (min(found_m2, MOST_FOUND * expected_m2) - self._found)
        if self._expected > 0.0:
            self.scale = min(max(self._found / self._expected, LEAST_SCALE), MOST_SCALE)


@dataclass(slots=True)
class PictureStatistics:
    """Estimates solution errors and how fast the pictures change, based on measurements."""

    residual: float = FIRST_RESIDUAL  # squared error on the full raster without any steps
    detail: dict[int, float] = field(  # error from lost detail, by reduction
        default_factory=lambda: {by: error.first_detail for by, error in RASTER_ERRORS.items()}
    )
    rate_m: float = FIRST_RATE  # a, per metre
    rate_s2: float = 0.0  # b, per square second
    contrast: float = FIRST_CONTRAST  # D_max
    _measured: bool = False

    def learn(self, measures: Measures, effort: Effort) -> None:
        """Update the estimates with one solution's measures."""
        gain = GAIN if self._measured else 1.0
        if measures.residual is not None:
            residual = measures.residual / residual_share(effort)
            self.residual += gain * (residual - self.residual)
            self._measured = True
        for reduction, value in measures.detail.items():
            self.detail[reduction] = value
        if measures.contrast is not None:
            self.contrast = max(measures.contrast, 1e-4)
        if measures.change is not None:
            self._learn_change(*measures.change)

    def stale(self, distance_m: float, elapsed_s: float) -> float:
        """Return D, the squared error of a picture drawn `elapsed_s` earlier, for eyes `distance_m` away."""
        y = self.rate_m * _outlines_off_m(distance_m) + self.rate_s2 * elapsed_s**2
        return y / (1 + y / self.contrast) + TAIL * y

    def own(self, effort: Effort) -> float:
        """Return Q, a solution's squared error at the eyes that it was computed for."""
        return self.detail.get(effort.reduction, 0.0) + self.residual * residual_share(effort)

    def _learn_change(self, changed: float, distance_m: float, elapsed_s: float) -> None:
        """Fit a and b in y = a·d²/(d + d0) + b·t² by normalised least mean squares."""
        y = changed / max(1 - changed / self.contrast, 0.1)
        off, t2 = _outlines_off_m(distance_m) / SCALE_M, (elapsed_s / SCALE_S) ** 2
        a, b = self.rate_m * SCALE_M, self.rate_s2 * SCALE_S**2
        weight = GAIN * (y - a * off - b * t2) / max(off * off + t2 * t2, 1e-3)
        self.rate_m = max(a + weight * off, 1e-5) / SCALE_M
        self.rate_s2 = max(b + weight * t2, 0.0) / SCALE_S**2


def _outlines_off_m(distance_m: float) -> float:
    return distance_m**2 / (distance_m + BLUR_M)


def step_share(steps: int) -> float:
    """Return the squared error after this many steps, relative to the squared error without any."""
    return STEP_SHARES[min(steps, len(STEP_SHARES) - 1)]


def residual_share(effort: Effort) -> float:
    """Return the solver's squared error, relative to that on the full raster without any steps."""
    return RASTER_ERRORS[effort.reduction].share * step_share(effort.steps)


def candidates(reductions: tuple[int, ...], steps: int) -> list[Effort]:
    """List the efforts to choose from: 0, 1, 2, 4 and `steps` steps on every raster."""
    counts = sorted({count for count in (0, 1, 2, 4, steps) if count <= steps})
    return [Effort(reduction, count) for reduction in reductions for count in counts]


class EffortChooser:
    """Chooses the next solution's effort, based on measured statistics and the previous choice."""

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
        """Return the effort with the lowest mean error over the horizon. `outlook` maps a solution's cost in
        ms to its outlook; `shown_error` is the squared error expected from the solution now shown; `horizon_s` is how
        long head and content are assumed to continue as they are.
        """
        means: dict[Effort, float] = {}
        for effort in efforts:
            cost_ms = costs.ms(effort)
            error = self.expected_error(
                effort, outlook(cost_ms), spread_s=display_spread_s(cost_ms, period_ms=period_ms)
            )
            means[effort] = self.mean_error(error, cost_ms, shown_error=shown_error, horizon_s=horizon_s)
        least = min(means.values())
        best = min((effort for effort in means if means[effort] <= EQUAL * least), key=costs.ms)
        if (kept := self._chosen) in means and costs.ms(best) > costs.ms(kept):
            best = best if means[best] < PREFERRED * means[kept] else kept
        self._chosen = best
        return best

    def mean_error(self, error: float, cost_ms: float, *, shown_error: float, horizon_s: float) -> float:
        """Return the mean error over the horizon for a solution started now. The error is `shown_error` until
        the solution is complete, and `error` after that. If the head starts moving before the solution is complete, the
        viewer sees an outdated view until then. The probability of this is c/H, and it lasts c/2 on average.
        """
        waited = min(cost_ms / 1e3 / horizon_s, 0.9)
        return waited * shown_error + (1 - waited) * error + waited**2 / 2 * self.pictures.contrast

    def expected_error(self, effort: Effort, outlook: Outlook, *, spread_s: float) -> float:
        """Return J, the mean squared light error while a solution is shown, for `display_spread_s`."""
        moved_m = (self.foresight.scale * outlook.moved_m2(spread_s)) ** 0.5
        return self.pictures.own(effort) + self.pictures.stale(moved_m, spread_s)
