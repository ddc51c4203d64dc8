"""All trials of all stages, run one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial

from runtime.report.stability import (
    calibration,
    networks,
    phases,
    poses,
    retina,
    rpu,
    solve,
    tracking,
    uncertainty,
)
from runtime.report.stability.calibration import Fit
from runtime.report.stability.trial import Answer, Case, Trial, settle

SOLVERS = (*networks.MODELS, "sart")


def every_trial(fits: Mapping[str, Fit], *, full: bool) -> Iterator[Trial]:
    """What there is to try. `fits` are the calibration's solvers by rule.

    A stage whose cases can't be made is one case, which fails.
    """
    methods = {name: networks.solver(name) for name in SOLVERS}
    stages: dict[str, Callable[[], Iterable[Trial]]] = {
        poses.STAGE: poses.trials,
        rpu.STAGE: rpu.trials,
        phases.PHASE: phases.trials,
        retina.STAGE: retina.trials,
        solve.STAGE: partial(solve.trials, methods),
        networks.STAGE: partial(networks.trials, full=full),
        uncertainty.STAGE: uncertainty.trials,
        tracking.STAGE: partial(tracking.trials, full=full),
        calibration.STAGE: partial(calibration.trials, fits),
    }
    for stage, make in stages.items():
        try:
            yield from make()
        except Exception as error:  # one stage's fault is not the end of the others
            yield Trial(stage, "its cases", partial(_raise, error))


def _raise(error: Exception) -> Answer:
    raise RuntimeError(f"{type(error).__name__}: {error}") from error


def run(
    trials: list[Trial],
    *,
    limits: Mapping[str, float],
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[Case]:
    """Settle every trial, telling how far it is."""
    cases = []
    for index, trial in enumerate(trials):
        cases.append(settle(trial, limit=limits.get(trial.key)))
        progress(index + 1, len(trials))
    return cases
