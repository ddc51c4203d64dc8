"""Which model and resolution hold a time budget, with hysteresis. Pure: told times, answers a level."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

SLOW_FRAMES = 8  # of the last ten must be over the budget before something is given up
LOOK_BACK = 10
ROOM = 0.8  # a better level must be expected to take no more than this of the budget
PATIENCE = 90  # frames within it, before it is tried
LEARNING = 0.2  # of the newest frame in a level's expected time


@dataclass(frozen=True, slots=True)
class QualityLevel:
    """One choice of model and resolution."""

    model: str
    scale: float  # of the panel's pixels that are solved
    expected_ms: float  # a whole frame, as it was measured
    psnr_db: float  # displayed, as it was measured

    @property
    def label(self) -> str:
        return self.model if self.scale == 1.0 else f"{self.model} at {self.scale:g}"


def useful(levels: list[QualityLevel]) -> list[QualityLevel]:
    """Best picture first; a level that is both slower and worse than another is left out."""
    ordered = sorted(levels, key=lambda level: (-level.psnr_db, level.expected_ms))
    kept: list[QualityLevel] = []
    for level in ordered:
        if not kept or level.expected_ms < kept[-1].expected_ms:
            kept.append(level)
    return kept


class BudgetKeeper:
    """Goes down a level when frames miss the budget, and up again when there has long been room."""

    def __init__(self, levels: list[QualityLevel], budget_ms: float) -> None:
        """levels: best first, as `useful` orders them; budget 0: none, the best."""
        if not levels:
            raise ValueError("a budget needs at least one level")
        self.levels, self.budget_ms = levels, budget_ms
        self._expected = [level.expected_ms for level in levels]
        self.index = 0
        if budget_ms > 0:
            fitting = [index for index, time_ms in enumerate(self._expected) if time_ms <= budget_ms]
            self.index = fitting[0] if fitting else len(levels) - 1
        self._recent: deque[float] = deque(maxlen=LOOK_BACK)
        self._calm = 0
        self.switches = 0

    @property
    def level(self) -> QualityLevel:
        return self.levels[self.index]

    @property
    def costs_db(self) -> float:
        """What the present level gives up against the best."""
        return self.levels[0].psnr_db - self.level.psnr_db

    @property
    def lightest(self) -> bool:
        """Nothing more can be given up."""
        return self.index + 1 == len(self.levels)

    @property
    def held(self) -> bool | None:
        """The last frames keep to the budget, but for a few; None before there are any at this level."""
        if not self._recent:
            return None
        return sum(taken > self.budget_ms for taken in self._recent) < SLOW_FRAMES

    def frame_took(self, time_ms: float) -> bool:
        """Tell a whole frame's time; True where the level has changed."""
        if self.budget_ms <= 0:
            return False
        self._expected[self.index] += LEARNING * (time_ms - self._expected[self.index])
        self._recent.append(time_ms)
        slow = sum(taken > self.budget_ms for taken in self._recent)
        if slow >= SLOW_FRAMES and self.index + 1 < len(self.levels):
            return self._go(self.index + 1)
        better = self.index - 1
        # What slows this level slows the better one too.
        slowdown = max(time_ms, self._expected[self.index]) / self.level.expected_ms
        likely = self.levels[better].expected_ms * slowdown
        self._calm = self._calm + 1 if better >= 0 and likely <= ROOM * self.budget_ms else 0
        if self._calm >= PATIENCE:
            return self._go(better)
        return False

    def _go(self, index: int) -> bool:
        self.index, self._calm = index, 0
        self._recent.clear()
        self.switches += 1
        return True
