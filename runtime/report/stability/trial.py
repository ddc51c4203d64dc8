"""A trial is one extreme case; running it gives a Case, whatever the code under trial does."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

from runtime.errors import PhasestackError

Behaviour = Literal["answers", "refuses"]
EPS64 = 2.0**-52
WORSE = 1.05  # than recorded a case may be at most


@dataclass(frozen=True, slots=True)
class Answer:
    """What the code under trial came to, measured against the reference."""

    forward_error: float  # of the result, in the trial's measure
    tolerance: float  # largest forward error that passes, stated before the trial is run
    condition: float = 1.0  # how much the problem itself enlarges a relative error of its input
    backward_error: float | None = None  # relative change of the input that explains the result; None: the forward one
    note: str = ""


@dataclass(frozen=True, slots=True)
class Trial:
    """One extreme case, not yet run."""

    stage: str
    name: str
    run: Callable[[], Answer | None]  # None: it answered where it must refuse
    expected: Behaviour = "answers"
    measure: str = "relative"  # unit of the forward error
    # Where the case is held to what was recorded (`limits`), in addition to the tolerance that the answer states: what
    # another machine's rounding may add, in the measure.
    floor: float | None = None

    @property
    def key(self) -> str:
        """What the case is recorded by."""
        return f"{self.stage}: {self.name}"


@dataclass(frozen=True, slots=True)
class Case:
    """One extreme case and how it ended: a row of `stability.json`."""

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


def refusal(stage: str, name: str, call: Callable[[], object]) -> Trial:
    """A trial that passes when the code refuses, in its own words, to answer."""

    def run() -> None:
        call()

    return Trial(stage, name, run, expected="refuses", measure="-")


def settle(trial: Trial, *, limit: float | None = None) -> Case:
    """Run a trial. Only the project's own errors count as a refusal; nothing escapes.

    limit: the forward error that was recorded of it; a trial that is held to one fails without it.
    """
    try:
        with warnings.catch_warnings():
            # numpy's complaints about inf and NaN are not how the runtime warns: what comes out is measured.
            warnings.simplefilter("ignore", RuntimeWarning)
            answer = trial.run()
    except (PhasestackError, ValueError) as error:
        return _unanswered(trial, "refuses", str(error), passed=trial.expected == "refuses")
    except Exception as error:
        return _unanswered(trial, "refuses", f"{type(error).__name__}: {error}")
    if answer is None:
        return _unanswered(trial, "answers", "it answered where no answer exists")
    if trial.floor is not None:
        answer = _held_to(answer, limit, trial.floor)
    return Case(
        name=trial.name,
        stage=trial.stage,
        condition=answer.condition,
        forward_error=answer.forward_error,
        backward_error=answer.forward_error if answer.backward_error is None else answer.backward_error,
        behaviour="answers",
        tolerance=answer.tolerance,
        # A NaN compares false with everything: it fails.
        passed=trial.expected == "answers" and answer.forward_error <= answer.tolerance,
        measure=trial.measure,
        note=answer.note,
    )


def _unanswered(trial: Trial, behaviour: Behaviour, note: str, *, passed: bool = False) -> Case:
    numbers = (float("inf"), float("nan"), float("nan"))
    return Case(trial.name, trial.stage, *numbers, behaviour, 0.0, passed, trial.measure, note)


def _held_to(answer: Answer, limit: float | None, floor: float) -> Answer:
    """The answer with the tighter of its own tolerance and the recorded limit."""
    if limit is None:
        note = "; ".join(filter(None, (answer.note, "no limit is recorded: phasestack stability --record")))
        return replace(answer, tolerance=-1.0, note=note)
    return replace(answer, tolerance=min(answer.tolerance, WORSE * limit + floor))
