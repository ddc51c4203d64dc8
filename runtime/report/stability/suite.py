"""The complete suite of trials for all stages.

Some cases for the models and the tracker have no closed-form solution, so their errors are compared with those recorded
in `limits.json`. After changing the models or the tracker, record the errors again with
`phasestack stability --full --record FILE`, and explain in the commit what became worse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

from runtime.report.stability import calibration, models, optics, tracking
from runtime.report.stability.calibration import Fit
from runtime.report.stability.trial import Case, Trial, settle
from runtime.support.artifacts import write_text

LIMITS = Path(__file__).with_name("limits.json")  # recorded forward errors, keyed by `Trial.key`


def every_trial(fits: Mapping[str, Fit], *, full: bool) -> Iterator[Trial]:
    """Yield the trials for all stages, with calibration solvers by method, and with long ones if `full`."""
    yield from optics.trials()
    yield from models.trials(full=full)
    yield from tracking.trials(full=full)
    yield from calibration.trials(fits)


def run(
    trials: list[Trial], *, record: Path | None = None, progress: Callable[[int, int], None] = lambda done, of: None
) -> list[Case]:
    """Run all trials and return their cases; update the errors in the file `record`, if given."""
    limits: dict[str, float] = json.loads(LIMITS.read_text(encoding="utf-8"))
    cases = []
    for number, trial in enumerate(trials, 1):
        cases.append(settle(trial, limit=limits.get(trial.key)))
        progress(number, len(trials))
    if record is not None:
        for trial, case in zip(trials, cases, strict=True):
            if trial.floor is not None and math.isfinite(case.forward_error):
                limits[trial.key] = float(f"{case.forward_error:.4g}")
        write_text(record, json.dumps(dict(sorted(limits.items())), indent=0) + "\n")
    return cases
