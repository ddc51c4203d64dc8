"""The effort of each solution: the raster and number of steps with the least expected error at the true eyes.

A solution that takes c seconds is on the panels for T = max(c, refresh period), and is made for where the eyes will be
in the middle of that time. Averaged over its life, its squared error in light is that of a viewer who stays, plus that
of a view that is stale (docs/mathematics.md, "Effort"):

    J = Q(raster, steps) + D(sqrt(2·sigma² + v²·T²/12 + l²), T/sqrt(12)),
    D(d, t) = y / (1 + y/D_max),    y = a·d² + b·t²

sigma: the tracker's error at that instant, an axis; v: the head's speed; l: the way beyond its horizon. All three are
scaled together, so that the displacements they predict are those that come to pass. a, b: how fast the picture changes
with the head's position and with time, D_max: half its variance, measured on successive targets.

Until a solution is complete, the panels show the one before, with error E, and a head that begins to move meanwhile is
not answered: over a horizon H the mean is (c·E + (H - c)·J) / H + D_max·(c/H)²/2. The effort with the least mean is
chosen, the present one preferred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

from runtime.records import Effort, Measures

SOLVING_STAGES = ("render", "prepare", "inference", "finish", "step")
HORIZON_S = 1.0  # for how long what the head and the content do is taken to last
PREFERRED = 0.93  # another effort is chosen where it has less than this share of the present one's expected error
GAIN = 0.2  # of the newest measurement in a running mean
# Squared error in light after k steps, relative to none: `best`, mean of the scenes demo and texture, 960x540, for a
# tracking error of 2 mm.
STEP_SHARES = (1.0, 0.77, 0.61, 0.58, 0.53, 0.53, 0.51, 0.51, 0.51)
FIRST_RESIDUAL = 1e-3  # squared error of a solution without steps, until one has been measured
FIRST_DETAIL = {
    1: 0.0,
    2: 1.6e-3,
    3: 3.6e-3,
    4: 6e-3,
}  # squared error of a raster that lacks detail, until that is measured
FIRST_RATE = 2e-4 / 1e-6  # per m²: the demo scene's
FIRST_CONTRAST = 0.03
FORESIGHT_GAIN = 1 / 60  # of the newest refresh
LEAST_SCALE, MOST_SCALE = 0.02, 4.0
TAIL = 0.02  # of y: far off, nearer is still better
SCALE_M, SCALE_S = 5e-3, 0.1  # units in which displacement and time enter the fit of their rates


@dataclass(frozen=True, slots=True)
class Costs:
    """Time of each effort on this machine and scene, milliseconds."""

    stages: Mapping[int, Mapping[str, float]]  # by reduction and SOLVING_STAGES; `step` is one step's

    def ms(self, effort: Effort) -> float:
        """Time from beginning to the complete layers."""
        stages = self.stages[effort.reduction]
        steps = effort.steps - (effort.continued_from or 0)
        begun = ("finish",) if effort.continued_from is not None else ("render", "prepare", "inference", "finish")
        return sum(stages.get(stage, 0.0) for stage in begun) + steps * stages.get("step", 0.0)


def simulated_costs(stage_ms: Mapping[str, float], reductions: Iterable[int]) -> Costs:
    """Configured costs of the full raster (`loop.simulated_stage_ms`), proportional to the pixels on coarser ones."""
    return Costs({by: {stage: stage_ms.get(stage, 0.0) / by**2 for stage in SOLVING_STAGES} for by in reductions})


class CostBook:
    """Running means of what the stages of a solution take, by raster."""

    def __init__(self, first: Mapping[int, Mapping[str, float]]) -> None:
        """first: by reduction and stage, measured with whole pictures before the first refresh."""
        self._first = first
        self._measured: dict[int, dict[str, float]] = {}

    def learn(self, effort: Effort, stage_ms: Mapping[str, float]) -> None:
        """Take in the stage times of one solution."""
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
        """All that is known. Rasters that were not solved on yet are as much cheaper or dearer as those that were."""
        measured_ms = sum(sum(stages.values()) for stages in self._measured.values())
        first_ms = sum(self._first.get(by, {}).get(s, 0.0) for by, stages in self._measured.items() for s in stages)
        scale = measured_ms / first_ms if first_ms > 0 and measured_ms > 0 else 1.0
        return Costs(
            {
                by: {stage: scale * ms for stage, ms in stages.items()} | self._measured.get(by, {})
                for by, stages in self._first.items()
            }
        )


@dataclass(frozen=True, slots=True)
class Outlook:
    """What the tracker foresees for one effort: the eyes in the middle of its life."""

    sigma_m: float = 0.0  # standard deviation of an axis of the middle between the eyes
    speed_m_s: float = 0.0
    lag_m: float = 0.0  # distance that the head moves beyond the tracker's horizon

    def moved_m2(self, life_s: float) -> float:
        """Mean squared distance, over a solution's life, between its eyes and the true ones."""
        return 2 * self.sigma_m**2 + (self.speed_m_s * life_s) ** 2 / 12 + self.lag_m**2


@dataclass(slots=True)
class Foresight:
    """How far solutions' eyes turn out to be from the eyes, relative to what was expected: running means of squares."""

    scale: float = 1.0
    _expected: float = 0.0
    _found: float = 0.0

    def learn(self, *, expected_m2: float, found_m2: float) -> None:
        """Take in one refresh."""
        self._expected += FORESIGHT_GAIN * (expected_m2 - self._expected)
        self._found += FORESIGHT_GAIN * (found_m2 - self._found)
        if self._expected > 0.0:
            self.scale = min(max(self._found / self._expected, LEAST_SCALE), MOST_SCALE)


@dataclass(slots=True)
class PictureStatistics:
    """Running means of what solutions measured: how good they were, and how fast their pictures change."""

    residual: float = FIRST_RESIDUAL  # squared error of a solution without steps, on its own raster
    detail: dict[int, float] = field(default_factory=lambda: dict(FIRST_DETAIL))  # by reduction
    rate_m2: float = FIRST_RATE  # a, per m²
    rate_s2: float = 0.0  # b, per s²
    contrast: float = FIRST_CONTRAST  # D_max
    _measured: bool = False

    def learn(self, measures: Measures, effort: Effort) -> None:
        """Take in what one solution measured."""
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
        """D: squared error of a picture drawn for a head that was elsewhere, and earlier."""
        y = self.rate_m2 * distance_m**2 + self.rate_s2 * elapsed_s**2
        return y / (1 + y / self.contrast) + TAIL * y

    def own(self, effort: Effort) -> float:
        """Q: squared error at the eyes that a solution is for."""
        return self.detail.get(effort.reduction, 0.0) + self.residual * step_share(effort.steps)

    def _learn_change(self, changed: float, distance_m: float, elapsed_s: float) -> None:
        """Normalised least mean squares of y = a·d² + b·t²."""
        y = changed / max(1 - changed / self.contrast, 0.1)
        d2, t2 = (distance_m / SCALE_M) ** 2, (elapsed_s / SCALE_S) ** 2
        a, b = self.rate_m2 * SCALE_M**2, self.rate_s2 * SCALE_S**2
        weight = GAIN * (y - a * d2 - b * t2) / max(d2 * d2 + t2 * t2, 1e-3)
        self.rate_m2 = max(a + weight * d2, 1e-7) / SCALE_M**2
        self.rate_s2 = max(b + weight * t2, 0.0) / SCALE_S**2


def step_share(steps: int) -> float:
    """Squared error after some steps, relative to none."""
    return STEP_SHARES[min(steps, len(STEP_SHARES) - 1)]


def candidates(reductions: tuple[int, ...], steps: int) -> list[Effort]:
    """Efforts to choose from: every raster, with none, one, two, four, ... of the model's steps, and all of them."""
    counts = sorted({count for count in (0, 1, 2, 4, steps) if count <= steps})
    return [Effort(reduction, count) for reduction in reductions for count in counts]


class EffortChooser:
    """Chooses the next solution's effort; holds what solutions measured and the effort chosen last."""

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
        """The effort with the least mean error over the horizon.

        outlook: of a solution that takes so many milliseconds; shown_error: of what the panels show at present.
        """
        means: dict[Effort, float] = {}
        for effort in efforts:
            cost_ms = costs.ms(effort)
            error = self.expected_error(effort, outlook(cost_ms), life_s=max(cost_ms, period_ms) / 1e3)
            means[effort] = self.mean_error(error, cost_ms, shown_error=shown_error, horizon_s=horizon_s)
        best = min(means, key=means.__getitem__)
        if self._chosen in means and means[best] > PREFERRED * means[self._chosen]:
            best = self._chosen
        self._chosen = best
        return best

    def mean_error(self, error: float, cost_ms: float, *, shown_error: float, horizon_s: float) -> float:
        """Mean over the horizon: what is shown until the solution is complete, then the solution's own error.

        A head that begins to move meanwhile sees a stale view until then: with probability c/H, for c/2 on average.
        """
        waited = min(cost_ms / 1e3 / horizon_s, 0.9)
        return waited * shown_error + (1 - waited) * error + waited**2 / 2 * self.pictures.contrast

    def expected_error(self, effort: Effort, outlook: Outlook, *, life_s: float) -> float:
        """J: mean squared error in light over a solution's life."""
        spread_s = life_s / 12**0.5
        moved_m = (self.foresight.scale * outlook.moved_m2(life_s)) ** 0.5
        return self.pictures.own(effort) + self.pictures.stale(moved_m, spread_s)
