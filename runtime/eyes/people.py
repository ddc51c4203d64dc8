"""Follow several people, each with one tracker, and decide who is served.

A sensor's heads are assigned to people by how far each can have moved (`association`). A person hidden for longer
than `IDENTITY_S`, or whose head could as well be another's, comes back as a new person, with a tracker that remembers
nothing. So no tracker ever takes over another person's eyes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.clock import NS_PER_S
from runtime.eyes.association import assigned
from runtime.eyes.plausibility import NOT_NEWER, reason_against
from runtime.eyes.rest import RestWatch
from runtime.eyes.tracker import CLOCK_RESET_NS, CONFIDENCE_MIN, REACH_SPEED, UNCERTAIN, Tracker
from runtime.records import F64, EyePoints

APART_M = 0.12  # two heads cannot be closer together
UNSEEN_NS = NS_PER_S // 10  # a person who is not in this many nanoseconds' samples counts as lost
SEVERAL_NS = 10 * NS_PER_S  # heads are assigned for this long after several people were last in view
MISTAKE_NS = NS_PER_S // 4  # a head that is not seen again within this time was a mistake
WALKS_M_S = 0.5  # a person who moves faster is passing by
SPEED_NS = NS_PER_S // 20  # time over which the speed is predicted
PEOPLE_MOST = 6  # more people, the farthest, are ignored
CROWD = "one of more people than can be followed"
DOUBTFUL = "may be either of two people"
ONE_HEAD = "as near to another head as no two heads can be"


@dataclass(slots=True, eq=False)
class Person:
    """Somebody in front of the display."""

    tracker: Tracker
    rest: RestWatch | None
    number: int  # 0 until enough samples have been seen
    steady_ns: int = 0  # since when the person has been in view without walking
    before: Person | None = None  # a person lost shortly before, who could have moved to here

    def middle_m(self, time_ns: int) -> F64 | None:
        """Return the midpoint (3,) between the eyes, or None if the person is lost."""
        eyes_m = self.tracker.ahead(time_ns).eyes_m
        return None if eyes_m is None else eyes_m.mean(axis=0)


class People:
    """All people in front of the display, and those who are served. Not thread-safe. Never reads a clock."""

    def __init__(
        self,
        new_tracker: Callable[[], Tracker],
        new_rest: Callable[[], RestWatch | None],
        *,
        most_served: int,
        join_s: float,
        in_front_m: float,
    ) -> None:
        """Begin without people. A further person is served after `join_s` in view; eyes have x > `in_front_m`."""
        self._new_tracker, self._new_rest = new_tracker, new_rest
        self._most, self._join_ns, self._in_front_m = most_served, round(join_s * NS_PER_S), in_front_m
        self._count = 0  # highest number given to a person
        self._newest_ns = -1
        self._begin()

    def _begin(self) -> None:
        first = Person(self._new_tracker(), self._new_rest(), self._next())
        self._people, self.served = [first], [first]
        self._several_ns = -SEVERAL_NS  # when several people were last in view

    def _next(self) -> int:
        self._count += 1
        return self._count

    @property
    def in_view(self) -> int:
        """Number of people who are followed, whether or not they are served."""
        return sum(person.number > 0 and person.tracker.seen_ns is not None for person in self._people)

    def renew_rest(self) -> None:
        """Replace the detectors of heads at rest."""
        for person in self._people:
            person.rest = self._new_rest()

    def update(self, seen: Sequence[EyePoints], *, capture_ns: int) -> list[str]:
        """Add a sample of all people's eyes in `stack`, nearest first. Return why each was refused, or ""."""
        if max(len(self._people), len(seen)) > 1:
            self._several_ns = capture_ns
        elif abs(capture_ns - self._several_ns) > SEVERAL_NS:
            return self._update_one(seen, capture_ns)
        if capture_ns <= self._newest_ns:
            if self._newest_ns - capture_ns < CLOCK_RESET_NS:
                return [NOT_NEWER] * len(seen)
            self._begin()
        self._newest_ns = capture_ns
        reasons = self._update_all(seen, capture_ns)
        self._part(capture_ns)
        self._serve(capture_ns)
        return reasons

    def _update_one(self, seen: Sequence[EyePoints], capture_ns: int) -> list[str]:
        (person,) = self._people
        self.served = [person]
        replaced = person.tracker.replaced
        why = person.tracker.update(seen[0] if seen else None, capture_ns=capture_ns)
        self._newest_ns = capture_ns
        if person.tracker.replaced != replaced:
            person.number = self._next()
        if seen and not why and person.rest is not None:
            person.rest.update(seen[0].eyes_m, capture_ns=capture_ns)
        return [why] * len(seen)

    def _update_all(self, seen: Sequence[EyePoints], capture_ns: int) -> list[str]:
        reasons = self._reasons(seen)
        left = [n for n, why in enumerate(reasons) if not why]
        missed = [*self._people]
        for is_established in (True, False):  # a mistake never casts doubt on who is who
            people = [person for person in missed if (person.number > 0) is is_established]
            for person, n, doubtful in self._assigned(people, [(n, seen[n]) for n in left], capture_ns):
                if n is not None:
                    left.remove(n)
                    reasons[n] = DOUBTFUL if doubtful else self._give(person, seen[n], capture_ns)
                if not doubtful and n is not None:
                    missed.remove(person)
        for person in missed:
            seen_ns = person.tracker.seen_ns
            if seen_ns is not None and (not seen or capture_ns - seen_ns > UNSEEN_NS):
                person.tracker.update(None, capture_ns=capture_ns)
        for n in left:
            reasons[n] = self._meet(seen[n], capture_ns)
        return reasons

    def _reasons(self, seen: Sequence[EyePoints]) -> list[str]:
        """Return why eyes cannot be those of a person, or cannot be distinguished from another's."""
        reasons: list[str] = []
        for points in seen:
            why = reason_against(points.eyes_m, in_front_m=self._in_front_m)
            if not min(points.confidence.tolist()) >= CONFIDENCE_MIN:
                why = UNCERTAIN
            taken = (seen[m].eyes_m for m, other in enumerate(reasons) if not other)
            if not why and any(_apart_m(points.eyes_m, eyes_m) < APART_M for eyes_m in taken):
                why = ONE_HEAD
            reasons.append(why or (CROWD if sum(not other for other in reasons) >= PEOPLE_MOST else ""))
        return reasons

    @staticmethod
    def _assigned(
        people: Sequence[Person], heads: Sequence[tuple[int, EyePoints]], capture_ns: int
    ) -> list[tuple[Person, int | None, bool]]:
        """Return, for each person, the index of a head or None, and whether it is doubtful. A doubtful head is returned
        for each person whose head it may be, once in all.
        """
        distance_m, radius_m = np.full((2, len(people), len(heads)), np.inf)
        radius_m[:] = 0.0
        for row, person in enumerate(people):
            for column, (_, points) in enumerate(heads):
                if (reach := person.tracker.reach_m(points, capture_ns=capture_ns)) is not None:
                    distance_m[row, column], radius_m[row, column] = reach
        found, doubts = assigned(distance_m, radius_m)
        result: list[tuple[Person, int | None, bool]] = []
        spent = {heads[head][0] for head in found if head is not None}
        for row, (person, head, doubtful) in enumerate(zip(people, found, doubts, strict=True)):
            if not doubtful:
                result.append((person, None if head is None else heads[head][0], False))
                continue
            within = [heads[n][0] for n in np.flatnonzero(distance_m[row] <= radius_m[row]).tolist()]
            result += [(person, n, True) for n in within if n not in spent] or [(person, None, True)]
            spent.update(within)
        return result

    def _give(self, person: Person, points: EyePoints, capture_ns: int) -> str:
        """Update a person with their eyes, and return why the tracker has refused them, or an empty string."""
        why = person.tracker.update(points, capture_ns=capture_ns)
        if why:
            return why
        if person.rest is not None:
            person.rest.update(points.eyes_m, capture_ns=capture_ns)
        if not person.number and person.tracker.is_established:
            person.number = self._next()
            self._succeed(person)
        now_m, then_m = person.middle_m(capture_ns), person.middle_m(capture_ns + SPEED_NS)
        walks_m = WALKS_M_S * SPEED_NS / NS_PER_S
        if now_m is not None and then_m is not None and float(np.linalg.norm(then_m - now_m)) > walks_m:
            person.steady_ns = capture_ns
        return ""

    def _succeed(self, person: Person) -> None:
        """Give a new person the place of a person who was lost here."""
        before, person.before = person.before, None
        if before is None or before not in self._people:
            return
        self._people.remove(before)
        person.steady_ns = before.steady_ns
        self.served = [person if other is before else other for other in self.served]

    def _meet(self, points: EyePoints, capture_ns: int) -> str:
        """Begin to follow a new person, unless another is known to be there."""
        middle_m, lost = points.eyes_m.mean(axis=0), []
        for other in self._people:
            seen_ns, place_m = other.tracker.seen_ns, other.middle_m(capture_ns)
            if seen_ns is None or place_m is None:
                continue
            away_m = float(np.linalg.norm(place_m - middle_m))
            age_s = (capture_ns - seen_ns) / NS_PER_S
            if age_s == 0.0 and away_m < APART_M:
                return ONE_HEAD
            if age_s > 0.0 and other.number and away_m < REACH_SPEED * age_s + APART_M:
                lost.append((away_m, other))
        unused = [person for person in self._people if person.tracker.seen_ns is None and person.number]
        person = unused[0] if unused else Person(self._new_tracker(), self._new_rest(), 0)
        if not unused:
            self._people.append(person)
        person.steady_ns = capture_ns
        person.before = min(lost, key=lambda one: one[0])[1] if lost else None
        why = person.tracker.update(points, capture_ns=capture_ns)
        if person.rest is not None and not why:
            person.rest.update(points.eyes_m, capture_ns=capture_ns)
        return why

    def _part(self, capture_ns: int) -> None:
        """Forget people who have left and heads that were mistakes."""
        last = max(self._people, key=lambda person: person.tracker.seen_ns or -1)
        kept = []
        for person in self._people:
            seen_ns = person.tracker.seen_ns
            is_mistake = not person.number and seen_ns is not None and capture_ns - seen_ns > MISTAKE_NS
            if person is last or not (is_mistake or person.middle_m(capture_ns) is None):
                kept.append(person)
        self._people = kept
        if len(kept) == 1 and not kept[0].number:
            kept[0].number = self._next()

    def _serve(self, capture_ns: int) -> None:
        """Keep serving those who are not lost, and take in the nearest others while there is room."""
        self.served = [person for person in self.served if person in self._people]
        waiting = []
        for person in self._people:
            middle_m = person.middle_m(capture_ns)
            if person in self.served or not person.number or middle_m is None:
                continue
            if not self.served or capture_ns - person.steady_ns >= self._join_ns:
                waiting.append((float(np.linalg.norm(middle_m)), person))
        waiting.sort(key=lambda one: one[0])
        room = self._most - len(self.served)
        room = max(room, 0) if self.served else 1  # the others wait, however long they have been in view
        self.served += [person for _, person in waiting[:room]]
        if not self.served:
            first = self._people[0]
            first.number = first.number or self._next()
            self.served = [first]


def _apart_m(eyes_m: F64, other_m: F64) -> float:
    return float(np.linalg.norm((eyes_m - other_m).mean(axis=0)))
