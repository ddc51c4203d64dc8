"""Distinguish a person from a picture of one: people move and blink."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from runtime.clock import NS_PER_S
from runtime.records import F64

STILL_NS = 6 * NS_PER_S  # a face that neither moves nor blinks for this long may be a picture
LOOKED_NS = NS_PER_S  # time between two searches for somebody else
STILL = 0.04  # movement of a face, in eye separations, that a picture on a wall does not show; 2.5 mm
ALIVE = 0.08  # movement between two searches that shows a person
NEAR = 1.5  # largest distance, in eye separations, at which two faces are taken to be one
OPEN_MIN = 0.12  # minimum ratio of height to width for an open eye


@dataclass(frozen=True, slots=True)
class Sign:
    """A face's position in a picture, and whether its eyes are closed."""

    middle: F64  # (2,) midpoint between the pupils, px
    eye_distance: float  # px
    is_blinking: bool
    looks: F64  # (468,) appearance, with mean 0 and norm 1

    def apart(self, other: Sign) -> float:
        """Distance to another face, in its eye separations."""
        return float(np.linalg.norm(self.middle - other.middle)) / other.eye_distance


class Liveness:
    """Notices that the viewer may be a picture on a wall, and who of the others is a person."""

    def __init__(self) -> None:
        self._pictures: list[Sign] = []  # faces that were found not to be people
        self.begin()

    def begin(self) -> None:
        """Begin with another viewer."""
        self.has_lived = False  # True once the viewer has moved or blinked
        self._first: Sign
        self._anchor: Sign | None = None
        self._anchor_ns = self._looked_ns = 0
        self._others: list[Sign] = []

    def is_due(self, viewer: Sign, time_ns: int) -> bool:
        """Take the viewer's latest sign, and return True if it is time to look for somebody else."""
        if self._anchor is not None and (viewer.is_blinking or viewer.apart(self._first) > ALIVE):
            self.has_lived = True
        elif self._anchor is None:
            self._first = viewer
        if self._anchor is None or viewer.is_blinking or viewer.apart(self._anchor) > STILL:
            self._anchor, self._anchor_ns, self._others = viewer, time_ns, []
        if time_ns - self._anchor_ns < STILL_NS or time_ns - self._looked_ns < LOOKED_NS:
            return False
        self._looked_ns = time_ns
        return True

    def person_among(self, others: list[Sign]) -> int | None:
        """Return the index of the first face that has moved or blinked since the previous call, or None."""
        before, self._others = self._others, others
        for index, one in enumerate(others):
            same = [other for other in before if one.apart(other) < NEAR]
            if one.is_blinking or (same and min(map(one.apart, same)) > ALIVE):
                return index
        return None

    def mark_viewer(self) -> None:
        """Remember that the viewer is a picture."""
        if self._anchor is not None:
            self._pictures.append(self._anchor)

    def is_picture(self, face: Sign, *, alike: float) -> bool:
        """Return True if a face is where a picture was found, correlates by `alike`, and has not moved."""
        return any(face.apart(one) < STILL and face.looks @ one.looks > alike for one in self._pictures)
