"""What each case came to when it was last recorded: no worse than that by more than 5% is what it is held to.

Cases of what a model or a filter makes of a hard problem have no closed form for how good it can be.
`phasestack stability --full --record FILE` writes the file anew; whoever changes a model or the tracker does, and says
in the commit what became worse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from runtime.report.stability.trial import Case, Trial

FILE = Path(__file__).with_name("limits.json")


def load_limits() -> dict[str, float]:
    """Recorded forward errors by `stage: case`."""
    limits: dict[str, float] = json.loads(FILE.read_text(encoding="utf-8"))
    return limits


def recorded(trials: Sequence[Trial], cases: Sequence[Case], old: Mapping[str, float]) -> str:
    """The record's text: of the trials that are held to one, what they came to; others' old limits stay."""
    held = [(trial, case.forward_error) for trial, case in zip(trials, cases, strict=True) if trial.floor is not None]
    new = {trial.key: float(f"{error:.4g}") for trial, error in held if math.isfinite(error)}
    return json.dumps(dict(sorted((dict(old) | new).items())), indent=0) + "\n"
