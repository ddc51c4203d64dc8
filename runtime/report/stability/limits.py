"""What each case came to when it was last recorded: no worse than that by more than 5% is what it is held to.

Cases of what a model or a filter makes of a hard problem have no closed form for how good it can be.
`phasestack stability --full --record FILE` writes the file anew; whoever changes a model or the tracker does, and says
in the commit what became worse.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path

from runtime.errors import InputError
from runtime.report.stability.trial import Case, Trial

FILE = Path(__file__).with_name("limits.json")


def load_limits(path: Path = FILE) -> dict[str, float]:
    """Recorded forward errors by `stage: case`. Raises InputError."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        return {str(key): float(value) for key, value in found.items()}
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise InputError(path, "", f"is no record of limits ({error})") from None


def key_of(case: Case | Trial) -> str:
    """What a case is recorded by."""
    return f"{case.stage}: {case.name}"


def recorded(trials: Iterable[Trial], cases: Iterable[Case], old: Mapping[str, float]) -> str:
    """The record's text: of the trials that are held to one, what they came to; others' old limits stay."""
    held = {key_of(trial) for trial in trials if trial.recorded}
    new = {key_of(case): case.forward_error for case in cases if key_of(case) in held}
    kept = dict(old) | {key: float(f"{value:.4g}") for key, value in new.items() if math.isfinite(value)}
    return json.dumps(dict(sorted(kept.items())), indent=0) + "\n"
