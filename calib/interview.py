"""Which monitor is which panel, and how each is mounted: asked of a person, who answers with keys. No screen here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum, auto
from typing import Any

from calib.keys import Key
from runtime.panels.monitors import Monitor
from runtime.panels.mounting import Arrow, mounting_of

ARROWS: dict[Key, Arrow] = {Key.UP: "up", Key.DOWN: "down", Key.LEFT: "left", Key.RIGHT: "right"}


class Question(Enum):
    """What is asked at the moment."""

    WHICH = auto()
    ARROW = auto()
    MIRROR = auto()


def identity(monitor: Monitor, monitors: Sequence[Monitor]) -> dict[str, Any]:
    """How a configuration names a monitor: by its serial where no other has it, else by its connector."""
    alone = [m.serial for m in monitors].count(monitor.serial) == 1
    return {"edid_serial": monitor.serial} if monitor.serial and alone else {"connector": monitor.connector}


class Interview:
    """Asks for every panel, rear to front: which monitor, which way its arrow points, does it read rightly."""

    def __init__(self, monitors: Sequence[Monitor], *, panels: int, say: Callable[[str], None]) -> None:
        """Raises ValueError where there are fewer monitors than panels."""
        if len(monitors) < panels:
            raise ValueError(f"{len(monitors)} monitors for {panels} panels")
        self.monitors, self.panels, self._say = list(monitors), panels, say
        self.tables: list[dict[str, Any]] = []
        self.shown = 0  # the monitor that shows its card; all others are clear
        self.question = Question.WHICH
        self.finished = False
        self._taken: list[int] = []
        self._arrow: Arrow = "up"

    @property
    def done(self) -> bool:
        """True once every panel has its monitor."""
        return len(self.tables) == self.panels

    def ask(self) -> None:
        """Say what is asked."""
        asked, keys = self.asked
        monitor = self.monitors[self.shown]
        first = f"{monitor} shows its card, the others are clear. " if self.question is Question.WHICH else ""
        self._say(f"{first}{asked} ({keys})")

    @property
    def asked(self) -> tuple[str, str]:
        """The question, and the keys that answer it."""
        number = len(self.tables)
        place = {0: "the rearmost, at the backlight", self.panels - 1: "the front one"}.get(number, "the next one")
        texts = {
            Question.WHICH: (f"Is it panel {number}, {place}?", "Enter: yes, n: another monitor, u: one back, q: stop"),
            Question.ARROW: ("Which way does its arrow point, seen from the front?", "arrow keys"),
            Question.MIRROR: ("Does its writing read rightly?", "Enter: yes, n: it is mirrored"),
        }
        return texts[self.question]

    def press(self, key: Key) -> None:
        """Take in an answer."""
        match self.question, key:
            case _, Key.QUIT:
                self.finished = True
            case _, Key.UNDO:
                self._back()
            case Question.WHICH, Key.ACCEPT:
                self.question = Question.ARROW
            case Question.WHICH, Key.NEXT | Key.RIGHT:
                self._show_free(1)
            case Question.WHICH, Key.PREVIOUS | Key.LEFT:
                self._show_free(-1)
            case Question.ARROW, arrow if arrow in ARROWS:
                self._arrow, self.question = ARROWS[arrow], Question.MIRROR
            case Question.MIRROR, Key.ACCEPT | Key.NEXT:
                self._mounted(mirrored=key is Key.NEXT)
        if not self.finished:
            self.ask()

    def _mounted(self, *, mirrored: bool) -> None:
        rotation_deg, mirror = mounting_of(self._arrow, mirrored=mirrored)
        named = identity(self.monitors[self.shown], self.monitors)
        self.tables.append(named | {"rotation_deg": rotation_deg, "mirror": mirror})
        self._taken.append(self.shown)
        self.question = Question.WHICH
        if self.done:
            self.finished = True
        else:
            self._show_free(1)

    def _back(self) -> None:
        if self.question is not Question.WHICH:
            self.question = Question.WHICH
        elif self.tables:
            self.tables.pop()
            self.shown = self._taken.pop()

    def _show_free(self, step: int) -> None:
        for _ in self.monitors:
            self.shown = (self.shown + step) % len(self.monitors)
            if self.shown not in self._taken:
                return
