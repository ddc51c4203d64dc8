"""Trials, extreme cases that have not been run yet. Running one gives a Case even if the code raises."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Literal

from runtime.errors import PhasestackError

Behaviour = Literal["answers", "refuses"]
EPS64 = 2.0**-52
WORSE = 1.05  # maximum accepted ratio of an error to the recorded one


@dataclass(frozen=True, slots=True)
class Answer:
    """Result compared with the reference."""

    forward_error: float  # error of the result, in the trial's measure
    tolerance: float  # maximum forward error that passes, fixed before the trial is run
    condition: float = 1.0  # factor by which the problem itself amplifies a relative error of its input
    backward_error: float | None = None  # change of the input that explains the result; None: as the forward error
    note: str = ""


@dataclass(frozen=True, slots=True)
class Trial:
    """Extreme case that has not been run yet."""

    stage: str
    name: str
    run: Callable[[], Answer]
    expected: Behaviour = "answers"
    measure: str = "relative"  # unit of the forward error
    # Set: the recorded error limits the forward error, too. What another machine's rounding may add, in the measure.
    floor: float | None = None

    @property
    def key(self) -> str:
        """Key of the case in the file of recorded errors."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True, slots=True)
class Case:
    """Extreme case with its outcome, an entry of `stability.json`."""

    name: str
    stage: str
    condition: float
    forward_error: float
    backward_error: float
    behaviour: Behaviour
    tolerance: float
    passed: bool
    measure: str
    note: str = ""


def settle(trial: Trial, *, limit: float | None = None) -> Case:
    """Run a trial. No exception escapes, and only the project's own errors count as a refusal.

    limit: the recorded forward error; a trial with a floor fails without it.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # about inf and NaN, because the result is checked anyway
            answer = trial.run()
    except Exception as error:
        is_refusal = isinstance(error, PhasestackError | ValueError)
        note = str(error) if is_refusal else f"{type(error).__name__}: {error}"
        passed = is_refusal and trial.expected == "refuses"
        return Case(trial.name, trial.stage, inf, nan, nan, "refuses", 0.0, passed, trial.measure, note)
    if trial.expected == "refuses":
        answer = replace(answer, note="it returned an answer although none exists")
    elif trial.floor is not None and limit is None:
        answer = replace(answer, tolerance=-1.0, note="no limit is recorded; run `phasestack stability --record`")
    elif trial.floor is not None and limit is not None:
        answer = replace(answer, tolerance=min(answer.tolerance, WORSE * limit + trial.floor))
    backward = answer.forward_error if answer.backward_error is None else answer.backward_error
    passed = trial.expected == "answers" and answer.forward_error <= answer.tolerance  # NaN fails
    return Case(
        trial.name, trial.stage, answer.condition, answer.forward_error, backward, "answers", answer.tolerance, passed,
        trial.measure, answer.note,
    )  # fmt: skip
