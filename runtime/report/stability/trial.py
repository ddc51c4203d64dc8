"""Trials, which are extreme cases to be run, and their outcomes.

Running a trial gives an outcome (`Case`) even if the tested code raises an exception.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf, nan
from typing import Literal

from runtime.errors import PhasestackError

Behaviour = Literal["answers", "refuses"]
EPS64 = 2.0**-52
WORSE = 1.05  # maximum accepted ratio of an error to the recorded error


@dataclass(frozen=True, slots=True)
class Answer:
    """Error of a computed result compared with the reference, and the error that is acceptable."""

    forward_error: float  # error of the result, in the trial's measure
    tolerance: float  # maximum forward error that passes, fixed before the trial is run
    condition: float = 1.0  # factor by which the problem itself amplifies a relative error of its input
    backward_error: float | None = None  # change of the input that explains the result; None: equal to forward_error
    note: str = ""


@dataclass(frozen=True, slots=True)
class Trial:
    """Extreme case that has not been run yet, with the criterion for passing."""

    stage: str
    name: str
    run: Callable[[], Answer]
    expected: Behaviour = "answers"
    measure: str = "relative"  # unit of the forward error
    # If set, the recorded error also limits the forward error. The value is the part of the forward error, in the
    # trial's measure, that may come from another machine's rounding.
    floor: float | None = None

    @property
    def key(self) -> str:
        """Key of the trial in the file of recorded errors."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True, slots=True)
class Case:
    """Outcome of a trial, an entry of `stability.json`."""

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
    """Run a trial and return the outcome. An exception of the tested code is part of the outcome.

    A trial that expects a refusal passes if the code raises an error of the project or a ValueError. Every other
    exception fails the trial.

    Args:
        trial: Trial to run.
        limit: Recorded forward error. A trial with a floor fails if no error is recorded.
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
        answer = replace(answer, tolerance=-1.0, note="no limit is recorded; run phasestack stability --record")
    elif trial.floor is not None and limit is not None:
        answer = replace(answer, tolerance=min(answer.tolerance, WORSE * limit + trial.floor))
    backward = answer.forward_error if answer.backward_error is None else answer.backward_error
    passed = trial.expected == "answers" and answer.forward_error <= answer.tolerance  # NaN fails
    return Case(
        trial.name, trial.stage, answer.condition, answer.forward_error, backward, "answers", answer.tolerance, passed,
        trial.measure, answer.note,
    )  # fmt: skip
