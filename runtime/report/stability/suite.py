"""All trials of all stages, run one after the other.

How good a model or a filter could be on a hard problem has no closed form: such cases are held to the recorded errors
in `limits.json`. `phasestack stability --full --record FILE` writes it anew; whoever changes a model or
the tracker does, and says in the commit what became worse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from runtime.report.stability import calibration, networks, optics, solve, tracking
from runtime.report.stability.calibration import Fit
from runtime.report.stability.trial import Case, Trial, settle
from runtime.support.artifacts import write_text

LIMITS = Path(__file__).with_name("limits.json")  # forward errors by `stage: case`

SOLVERS = (*networks.MODELS, "sart")


def every_trial(fits: Mapping[str, Fit], *, full: bool) -> Iterator[Trial]:
    """What there is to try. `fits` are the calibration's solvers by rule."""
    yield from optics.trials()
    yield from solve.trials({name: networks.solver(name) for name in SOLVERS})
    yield from networks.trials(full=full)
    yield from tracking.trials(full=full)
    yield from calibration.trials(fits)


def run(
    trials: list[Trial], *, record: Path | None = None, progress: Callable[[int, int], None] = lambda done, of: None
) -> list[Case]:
    """Run every trial with progress. record: the file of limits to update."""
    limits: dict[str, float] = json.loads(LIMITS.read_text(encoding="utf-8"))
    cases = []
    for index, trial in enumerate(trials):
        cases.append(settle(trial, limit=limits.get(trial.key)))
        progress(index + 1, len(trials))
    if record is not None:
        new = {
            trial.key: float(f"{case.forward_error:.4g}")
            for trial, case in zip(trials, cases, strict=True)
            if trial.floor is not None and math.isfinite(case.forward_error)
        }
        write_text(record, json.dumps(dict(sorted((limits | new).items())), indent=0) + "\n")
    return cases
