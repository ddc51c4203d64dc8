"""Assign a sensor sample's heads to known people by how far each can have moved."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from runtime.records import F64

DECISIVE = 9.0  # difference between two assignments, in terms of `_cost`, that leaves no doubt
SIGMAS = 3.0  # a radius of reach in standard deviations


def assigned(distance_m: F64, radius_m: F64) -> tuple[list[int | None], list[bool]]:
    """Assign heads to people, unless there is doubt, by distances and reaches (people, heads) from where
    each is expected.

    As many people as possible get a head within their reach. Among these assignments, the likeliest is chosen. If
    another one is nearly as likely, all people are in doubt to whom it assigns another head. Returns, for each person,
    the index of the head or None, and True if there was doubt.
    """
    count = len(distance_m)
    found = [(sum(head is not None for head in heads), cost, heads) for cost, heads in _matchings(distance_m, radius_m)]
    most = max(number for number, _, _ in found)
    likely = sorted((cost, n, heads) for n, (number, cost, heads) in enumerate(found) if number == most)
    least, _, best = likely[0]
    rivals = [heads for cost, _, heads in likely[1:] if cost - least < DECISIVE]
    doubtful = [any(heads[person] != best[person] for heads in rivals) for person in range(count)]
    return [None if doubt else head for head, doubt in zip(best, doubtful, strict=True)], doubtful


def _matchings(distance_m: F64, radius_m: F64) -> Iterator[tuple[float, tuple[int | None, ...]]]:
    """Yield the cost of every possible assignment, and the head that it assigns to each person."""
    if not len(distance_m):
        yield 0.0, ()
        return
    for cost, heads in _matchings(distance_m[1:], radius_m[1:]):
        yield cost, (None, *heads)
        for head, (distance, radius) in enumerate(zip(distance_m[0].tolist(), radius_m[0].tolist(), strict=True)):
            if head not in heads and distance <= radius:
                yield cost + _cost(distance, radius), (head, *heads)


def _cost(distance_m: float, radius_m: float) -> float:
    """Return -2 ln of the density, at this distance, of a normal distribution in space that fits the radius."""
    sigma_m = radius_m / SIGMAS
    return (distance_m / sigma_m) ** 2 + 6 * float(np.log(sigma_m))
