"""All trials of all stages, run one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from runtime.report.stability import calibration, phases, poses, rpu, solve, tracking
from runtime.report.stability.calibration import Fit
from runtime.report.stability.solve import Method
from runtime.report.stability.trial import Case, Trial, settle


def every_trial(fit: Fit, *, methods: dict[str, Method], full: bool, extra: list[Trial]) -> Iterator[Trial]:
    """What there is to try. `fit` is the calibration's solver, `methods` the solvers of layers, `extra` the network."""
    yield from poses.trials()
    yield from rpu.trials()
    yield from phases.trials()
    yield from solve.trials(methods)
    yield from tracking.trials(full=full)
    yield from calibration.trials(fit)
    yield from extra


def run(trials: list[Trial], *, progress: Callable[[int, int], None] = lambda done, of: None) -> list[Case]:
    """Settle every trial, telling how far it is."""
    cases = []
    for index, trial in enumerate(trials):
        cases.append(settle(trial))
        progress(index + 1, len(trials))
    return cases
