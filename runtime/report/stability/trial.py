"""Trials (extreme cases to run) and their outcomes (`Case`), also if the code raises."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Literal

from runtime.errors import PhasestackError

Behaviour = Literal["answers", "refuses"]
EPS64 = 2.0**-52
WORSE = 1.05  # largest accepted ratio of an error to the recorded error


@dataclass(frozen=True, slots=True)
class Answer:
    """A computed result's error relative to the reference, and the error that is acceptable."""

    forward_error: float  # the result's error, in the trial's measure
    tolerance: float  # maximum forward error that passes, set before the trial is run
    condition: float = 1.0  # how much the problem itself amplifies a relative error in its input
    backward_error: float | None = None  # change in the input that explains the result; None: same as forward_error
    note: str = ""


@dataclass(frozen=True, slots=True)
class Trial:
    """An extreme case that has not been run yet, with its criterion for passing."""

    stage: str
    name: str
    run: Callable[[], Answer]
    expected: Behaviour = "answers"
    measure: str = "relative"  # the forward error's unit
    # If set, the recorded error also limits the forward error. The value is how much of the forward error, in the
    # trial's measure, may be due to another machine's rounding.
    floor: float | None = None

    @property
    def key(self) -> str:
        """The trial's key in the file of recorded errors."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True, slots=True)
class Case:
    """A trial's outcome: an entry in `stability.json`."""

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
    """Run a trial and return its outcome, given a recorded forward error, which a trial with a floor
    needs. A trial that expects a refusal passes if the code raises one of the project's errors or a ValueError. With
    any other exception, the trial fails.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # about inf and NaN; the result is checked below
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
