"""Interpolate the true eye positions at any time between the samples of a recording."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from runtime.clock import NS_PER_S
from runtime.optics.alignment import midpoints
from runtime.records import F64, Eyes, RefreshAccount

GAP_NS = NS_PER_S // 5  # maximum gap between samples to interpolate across
KEPT = 512  # maximum number of samples kept, eight seconds at 60 Hz


class TrueEyes:
    """Stores the true eyes from recent samples and interpolates between their capture times."""

    def __init__(self) -> None:
        self._known: deque[tuple[int, F64]] = deque(maxlen=KEPT)
        self._ended = False
        self._place_of: dict[int, int] = {}  # index among the true people, by number of a person who is served

    @property
    def is_recorded(self) -> bool:
        """True once a sample has contained true eyes, which are found only in recordings."""
        return bool(self._known)

    def add(self, capture_ns: int, eyes_m: Eyes) -> None:
        """Add a sample's true eyes, (2, 3) for each person, in the `stack` frame."""
        if self._known and len(eyes_m) != len(self._known[-1][1]):
            self._known.clear()
        if not self._known or capture_ns > self._known[-1][0]:
            self._known.append((capture_ns, eyes_m))

    def end(self) -> None:
        """Note that no more samples will arrive."""
        self._ended = True

    def may_come(self, time_ns: int) -> bool:
        """Return True if the true eyes at a given time are not known yet but may be after further samples."""
        return bool(self._known) and time_ns > self._known[-1][0] and not self._ended

    def meet(self, account: RefreshAccount) -> None:
        """Note who of the true people a person is who is served for the first time: the nearest.

        From then on it stays the same one, so that a tracker that took another person's eyes would show.
        """
        if not self._known or len(self._known[-1][1]) == 2:
            return
        true_m = midpoints(self._known[-1][1])
        served = {self._place_of[each.number] for each in account.people if each.number in self._place_of}
        for person in account.people:
            if person.number not in self._place_of:
                away_m = np.linalg.norm(true_m - midpoints(person.eyes_m), axis=1)
                away_m[[*served]] = np.nan
                if not np.isnan(away_m).all():
                    place = self._place_of[person.number] = int(np.nanargmin(away_m))
                    served.add(place)

    def place_of(self, number: int) -> int | None:
        """Return a person's index among the true people, or None until it is known."""
        is_one = bool(self._known) and len(self._known[-1][1]) == 2
        return 0 if is_one else self._place_of.get(number)

    def of(self, account: RefreshAccount) -> RefreshAccount:
        """Return a refresh's account with the true eyes of all people served, where they are known."""
        all_m = self.at(account.photon_ns)
        if all_m is None:
            return account
        if len(all_m) == 2:
            first, others = account.people[:1], account.people[1:]
            people = (*(replace(person, true_eyes_m=all_m) for person in first), *others)
            return replace(account, true_eyes_m=all_m, people=people)
        pairs = [pair if np.isfinite(pair).all() else None for pair in all_m.reshape(-1, 2, 3)]
        places = [self._place_of.get(person.number) for person in account.people]
        known = [None if place is None else pairs[place] for place in places]
        people = tuple(replace(each, true_eyes_m=pair) for each, pair in zip(account.people, known, strict=True))
        present = [*known[:1], *(pair for pair in pairs if not known and pair is not None)]
        return replace(account, true_eyes_m=present[0] if present else None, people=people)

    def at(self, time_ns: int) -> F64 | None:
        """Return the true eyes (2P, 3) at a given time, or None if they are unknown. Absent people are NaN."""
        if not self._known or time_ns > self._known[-1][0]:
            return None
        after_ns, after_m = self._known[-1]
        for before_ns, before_m in reversed(self._known):
            if before_ns <= time_ns:
                if before_ns == time_ns:
                    return before_m
                if after_ns - before_ns > GAP_NS:
                    return None
                weight = (time_ns - before_ns) / (after_ns - before_ns)
                eyes: F64 = (1 - weight) * before_m + weight * after_m
                return eyes
            after_ns, after_m = before_ns, before_m
        return None
