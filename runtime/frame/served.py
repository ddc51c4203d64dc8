"""Compare the people that a solution was computed for with the people who are served now."""

from __future__ import annotations

import numpy as np

from runtime.optics.alignment import common_movement_m, midpoints
from runtime.plan.savings import selected_eyes
from runtime.records import F64, Eyes, EyesEstimate, PersonAccount, Solution

UNSHARED = 8.0  # weight of the squared movement that people do not share, because the alignment cannot follow it


def matched(solution: Solution, eyes: EyesEstimate) -> tuple[F64, F64]:
    """Return the eyes that a solution was computed for, and the same people's present eyes, (2P, 3) each.

    If none of the people served now is among those that it was computed for, the first ones' eyes are returned.
    """
    assert solution.solved_for_m is not None and eyes.eyes_m is not None
    both = [number for number in solution.people if number in eyes.people]
    then = [solution.people.index(number) for number in both] or [0]
    now = [eyes.people.index(number) for number in both] or [0]
    seeing = tuple(solution.seeing[2 * n + side] for n in then for side in (0, 1))
    return _of(solution.solved_for_m, then), selected_eyes(_of(eyes.eyes_m, now), seeing)


def _of(eyes_m: Eyes, people: list[int]) -> F64:
    return np.concatenate([eyes_m[2 * n : 2 * n + 2] for n in people])


def moved_m2(before_m: Eyes, after_m: Eyes) -> float:
    """Return the squared distance that people have moved, in m².

    For several people, this is the mean of their squared distances, and movement that they do not share counts
    `UNSHARED` times in addition.
    """
    if len(before_m) == 2:
        x, y, z = midpoints(after_m - before_m)[0].tolist()
        return float(x * x + y * y + z * z)
    moved = midpoints(after_m) - midpoints(before_m)
    unshared = moved - common_movement_m(before_m, after_m)
    return float((moved**2 + UNSHARED * unshared**2).sum(axis=1).mean())


def sigma_factor(people: int) -> float:
    """Return the factor for the standard deviation of errors in several people's eyes (`moved_m2`)."""
    return 1.0 if people < 2 else float((1 + UNSHARED) ** 0.5)


def accounts_of(solution: Solution | None, eyes: EyesEstimate) -> tuple[PersonAccount, ...]:
    """Return an account of each person who is served, with the eyes that the solution is for."""
    if eyes.eyes_m is None:
        return ()
    numbers, solved = eyes.people or (1,), dict[int, F64]()
    if solution is not None and solution.solved_for_m is not None:
        solved = {number: solution.solved_for_m[2 * n : 2 * n + 2] for n, number in enumerate(solution.people)}
        if not solved.keys() & set(numbers):
            solved[numbers[0]] = solution.solved_for_m[:2]
    return tuple(
        PersonAccount(number, eyes.eyes_m[2 * n : 2 * n + 2], solved.get(number)) for n, number in enumerate(numbers)
    )
