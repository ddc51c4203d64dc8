"""Choose the raster and the number of steps that minimize the expected error of each solution.

A solution that takes c seconds to compute stays on the panels for T = max(c, refresh period) and is computed for the
eyes at the middle of this interval. The squared error of light at the true eyes, averaged over the interval, is the
error Q for a still viewer plus the error D of an outdated view (docs/mathematics.md, "Effort"):

    J = Q(raster, steps) + D(sqrt(2·sigma² + v²·T²/12 + l²), T/sqrt(12)),
    D(d, t) = y / (1 + y/D_max),    y = a·d²/(d + d0) + b·t²

The symbol sigma is the tracking error per axis at the middle of the interval, v is the speed of the head, and l is the
distance that the head moves beyond the tracker's prediction horizon. A common factor scales sigma, v and l to
make predicted displacements match observed displacements. The rates a and b describe how the picture changes with the
position of the head and with time. D_max is half the variance of the picture. The values of a, b and D_max are
measured on successive target pictures.

Until a solution is complete, the panels show the previous solution with the error E and do not respond to a head that
starts moving. The mean error over a horizon H is (c·E + (H - c)·J) / H + D_max·(c/H)²/2. The chooser takes the effort
with the lowest mean error, with a preference for the present effort and for faster efforts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from runtime.records import Effort, Measures

SOLVING_STAGES = ("render", "prepare", "inference", "finish", "step")
HORIZON_S = 1.0  # time for which head and content are assumed to continue unchanged
EQUAL = 1.03  # the fastest effort is chosen among efforts whose mean errors are within this factor of the lowest
PREFERRED = 0.93  # share of the present effort's mean error below which another effort is chosen
GAIN = 0.2  # weight of the newest measurement in a running mean
KEPT_SOLUTIONS = 100  # times of a raster are discarded after this many solutions on other rasters
# Squared error of light after k steps, relative to no steps: solver `best`, mean over the scenes demo and texture at
# 960x540, tracking error 2 mm.
STEP_SHARES = (1.0, 0.77, 0.61, 0.58, 0.53, 0.53, 0.51, 0.51, 0.51)
FIRST_RESIDUAL = 1e-3  # initial value of the squared error of a solution without steps
FIRST_DETAIL = {
    1: 0.0,
    2: 1.6e-3,
    3: 3.6e-3,
    4: 6e-3,
}  # initial values of the squared error due to the detail lost on a coarse raster, by reduction
FIRST_RATE = 0.5  # initial value of a, per metre, from the demo scene
BLUR_M = 4e-3  # d0, beyond which outlines are displaced by more than their blur and the error grows linearly
FIRST_CONTRAST = 0.03  # initial value of D_max
FORESIGHT_GAIN = 1 / 60  # weight of the newest refresh in the running means of `Foresight`
LEAST_SCALE, MOST_SCALE = 0.02, 4.0
TAIL = 0.02  # slope in y that remains at saturation, which makes a smaller distance always better
SCALE_M, SCALE_S = 5e-3, 0.1  # units of displacement and time in the fit of the rates


@dataclass(frozen=True, slots=True)
class Costs:
    """Times that solutions take on this machine and with this scene, in milliseconds."""

    stages: Mapping[int, Mapping[str, float]]  # by reduction and stage in SOLVING_STAGES; `step` is for a single step

    def ms(self, effort: Effort) -> float:
        """Return the time in milliseconds that a solution takes from its start to complete layers."""
        stages = self.stages[effort.reduction]
        steps = effort.steps - (effort.continued_from or 0)
        begun = ("finish",) if effort.continued_from is not None else ("render", "prepare", "inference", "finish")
        return sum(stages.get(stage, 0.0) for stage in begun) + steps * stages.get("step", 0.0)


def simulated_costs(stage_ms: Mapping[str, float], reductions: Iterable[int]) -> Costs:
    """Scale the configured costs of the full raster by the number of pixels on each raster.

    Args:
        stage_ms: Milliseconds by stage on the full raster (`loop.simulated_stage_ms`).
        reductions: Divisors of the rows and columns of the panels.
    """
    return Costs({by: {stage: stage_ms.get(stage, 0.0) / by**2 for stage in SOLVING_STAGES} for by in reductions})


class CostBook:
    """Keeps running means of the stage times on each raster.

    The times of a raster that has not been used for `KEPT_SOLUTIONS` solutions are discarded, because the load of the
    machine may have changed.
    """

    def __init__(self, first: Mapping[int, Mapping[str, float]]) -> None:
        """Create a book of costs with initial times.

        Args:
            first: Milliseconds by reduction and stage, measured with full pictures before the first refresh.
        """
        self.first = first
        self._measured: dict[int, dict[str, float]] = {}
        self._unused: dict[int, int] = {}  # number of solutions on other rasters since the last use, by reduction

    def learn(self, effort: Effort, stage_ms: Mapping[str, float]) -> None:
        """Update the means with the stage times of one solution, in milliseconds."""
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
        """Return the present costs of solutions on every raster.

        Rasters that have not been measured recently get their initial times, scaled by the ratio of recent times to
        initial times on the measured rasters. Their cost is limited to the cost of the next finer raster divided by the
        ratio of the raster widths. The limit keeps a raster eligible if other work delayed its initial measurement.
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
    """Accuracy with which the tracker can predict the eyes for a solution, for one effort."""

    sigma_m: float = 0.0  # standard deviation per axis of the predicted midpoint of the eyes
    speed_m_s: float = 0.0  # speed of the head
    lag_m: float = 0.0  # distance that the head moves beyond the tracker's prediction horizon

    def moved_m2(self, life_s: float) -> float:
        """Return the mean squared distance in m² from a solution's eyes to the true eyes.

        Args:
            life_s: Time for which the solution is shown.
        """
        return 2 * self.sigma_m**2 + (self.speed_m_s * life_s) ** 2 / 12 + self.lag_m**2


@dataclass(slots=True)
class Foresight:
    """Estimates the ratio of observed to expected squared distances that the eyes move.

    The distances are from the eyes that a solution was computed for to the true eyes while the solution is shown.
    """

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
    """Estimates the errors of solutions and the rates at which their pictures change, from measurements."""

    residual: float = FIRST_RESIDUAL  # squared error of a solution without steps, on the solution's raster
    detail: dict[int, float] = field(default_factory=lambda: dict(FIRST_DETAIL))  # error of lost detail, by reduction
    rate_m: float = FIRST_RATE  # a, per metre
    rate_s2: float = 0.0  # b, per square second
    contrast: float = FIRST_CONTRAST  # D_max
    _measured: bool = False

    def learn(self, measures: Measures, effort: Effort) -> None:
        """Update the estimates with the measures of one solution."""
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
        """Return Q, the squared error at the eyes that a solution was computed for."""
        return self.detail.get(effort.reduction, 0.0) + self.residual * step_share(effort.steps)

    def _learn_change(self, changed: float, distance_m: float, elapsed_s: float) -> None:
        """Fit a and b of y = a·d²/(d + d0) + b·t² by normalised least mean squares."""
        y = changed / max(1 - changed / self.contrast, 0.1)
        off, t2 = _outlines_off_m(distance_m) / SCALE_M, (elapsed_s / SCALE_S) ** 2
        a, b = self.rate_m * SCALE_M, self.rate_s2 * SCALE_S**2
        weight = GAIN * (y - a * off - b * t2) / max(off * off + t2 * t2, 1e-3)
        self.rate_m = max(a + weight * off, 1e-5) / SCALE_M
        self.rate_s2 = max(b + weight * t2, 0.0) / SCALE_S**2


def _outlines_off_m(distance_m: float) -> float:
    return distance_m**2 / (distance_m + BLUR_M)


def step_share(steps: int) -> float:
    """Return the squared error after `steps` steps, relative to the squared error without steps."""
    return STEP_SHARES[min(steps, len(STEP_SHARES) - 1)]


def candidates(reductions: tuple[int, ...], steps: int) -> list[Effort]:
    """List the efforts to choose from, which are 0, 1, 2, 4 and `steps` steps on every raster."""
    counts = sorted({count for count in (0, 1, 2, 4, steps) if count <= steps})
    return [Effort(reduction, count) for reduction in reductions for count in counts]


class EffortChooser:
    """Chooses the effort of the next solution from measured statistics and the previous choice."""

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
        """Return the effort with the lowest mean error over the horizon.

        Args:
            efforts: Efforts to choose from.
            costs: Costs of solutions.
            outlook: Function that maps the cost of a solution in milliseconds to its outlook.
            shown_error: Expected squared error of the solution that is shown at present.
            period_ms: Refresh period of the display.
            horizon_s: Time for which head and content are assumed to continue unchanged.
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
        """Return the mean error over the horizon if a solution is started now.

        The error is `shown_error` until the solution is complete and `error` afterwards. A head that starts to move
        before the solution is complete sees an outdated view until then. This case has the probability c/H and lasts
        c/2 on average.
        """
        waited = min(cost_ms / 1e3 / horizon_s, 0.9)
        return waited * shown_error + (1 - waited) * error + waited**2 / 2 * self.pictures.contrast

    def expected_error(self, effort: Effort, outlook: Outlook, *, life_s: float) -> float:
        """Return J, the mean squared error of light while a solution is shown for `life_s` seconds."""
        spread_s = life_s / 12**0.5
        moved_m = (self.foresight.scale * outlook.moved_m2(life_s)) ** 0.5
        return self.pictures.own(effort) + self.pictures.stale(moved_m, spread_s)
