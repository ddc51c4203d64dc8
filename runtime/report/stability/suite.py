"""All trials of all stages, run one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from runtime.report.stability import calibration, networks, phases, poses, rpu, solve, tracking
from runtime.report.stability.calibration import Fit
from runtime.report.stability.networks import Check
from runtime.report.stability.trial import Case, Trial, settle

SOLVERS = (*networks.MODELS, "sart")


def every_trial(fit: Fit, check: Check, *, full: bool) -> Iterator[Trial]:
    """What there is to try. `fit` is the calibration's solver, `check` the check of eyes before a network."""
    yield from poses.trials()
    yield from rpu.trials()
    yield from phases.trials()
    yield from solve.trials({name: networks.solver(name) for name in SOLVERS})
    yield from networks.trials(check, full=full)
    yield from tracking.trials(full=full)
    yield from calibration.trials(fit)


def run(trials: list[Trial], *, progress: Callable[[int, int], None] = lambda done, of: None) -> list[Case]:
    """Settle every trial, telling how far it is."""
    cases = []
    for index, trial in enumerate(trials):
        cases.append(settle(trial))
        progress(index + 1, len(trials))
    return cases
