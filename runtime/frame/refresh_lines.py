"""Write each refresh to frames.jsonl, and measure its view error once the true eyes are known."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

from runtime.evaluation.refresh_quality import view_error_mm
from runtime.frame.stats import Quantiles
from runtime.frame.truth import TrueEyes
from runtime.records import F64, RefreshAccount, State

WAITING_MAX = 2048  # when this many refreshes are queued, the oldest is written without true eyes
PERSON_WINDOW = 1024  # maximum number of values kept for a person's quantiles
LINE = (
    "frame", "capture_ns", "predicted_for_ns", "present_ns", "eyes_m", "eyes_label", "eye_sigma_mm", "state",
    "solution", "effort", "solved_for_m", "solution_age_ms", "true_eyes_m", "inference", "presented", "stage_ms",
    "skew_ms", "people",
)  # fmt: skip


class RefreshLines:
    """Writes a line for each refresh to frames.jsonl, in order, and collects the view errors. Each
    refresh is queued until the true eyes at its display time are known, or never will be.
    """

    def __init__(self, truth: TrueEyes, write: Callable[[dict[str, Any]], None] | None) -> None:
        self._truth, self._write = truth, write
        self._waiting: deque[RefreshAccount] = deque()
        self.view_error_mm = Quantiles()  # for each refresh that shows a solution, if the true eyes are known
        self.people_mm: dict[int, Quantiles] = {}  # the same, by person
        self._first = 1  # number of the first person who was served last

    def add(self, account: RefreshAccount) -> None:
        """Queue a refresh."""
        self._waiting.append(account)

    def advance(self) -> None:
        """Write each queued refresh whose true eyes are known or will never be known."""
        while self._waiting:
            photon_ns = self._waiting[0].photon_ns
            if self._truth.may_come(photon_ns) and len(self._waiting) < WAITING_MAX:
                return
            account = self._truth.of(self._waiting.popleft())
            self._first = account.people[0].number if account.people else self._first
            for number, true_m, solved_for_m in _views(account, first=self._first):
                error_mm = view_error_mm(true_m, solved_for_m)
                self.view_error_mm.add(error_mm)
                self.people_mm.setdefault(number, Quantiles(PERSON_WINDOW)).add(error_mm)
            if self._write is not None:
                self._write(line_of(account))


def _views(account: RefreshAccount, *, first: int) -> Iterator[tuple[int, F64, F64]]:
    """Yield the number, the true eyes and the eyes of the shown solution of each person for whom both are known."""
    people = [(person.number, person.true_eyes_m, person.solved_for_m) for person in account.people]
    for number, true_m, solved_for_m in people or [(first, account.true_eyes_m, account.solved_for_m)]:
        if true_m is not None and solved_for_m is not None:
            yield number, true_m, solved_for_m


def line_of(account: RefreshAccount) -> dict[str, Any]:
    """Convert a refresh's account to a line for frames.jsonl (docs/contracts.md)."""
    return {name: _plain(getattr(account, name)) for name in LINE}


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return round(value, 4)
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, tuple):
        return [asdict(person) for person in value]
    return str(value) if isinstance(value, State) else value
