"""Apply operators' changes to a run's settings, one at a time."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import Any

from runtime.config import PLACING, Settings, changed
from runtime.daemon import status
from runtime.daemon.commands import Command
from runtime.daemon.reconfigure import moved_since
from runtime.errors import InputError, PhasestackError
from runtime.eyes.calibration import Calibration, load_calibration
from runtime.frame.messages import Answer, Cancel, ChangeSettings, Done, Move, Order, Progress, Skip
from runtime.frame.presenter import Presenter
from runtime.support.background import BackgroundJob
from runtime.support.untrusted_input import LIMITS

log = logging.getLogger("phasestack.daemon")

SUPERSEDED = "superseded by a newer change"
NEEDS_RESTART = (
    "stack",
    "sensor",
    "output",
    "service",
    "loop",
    "pose",
    "model.backend",
    "calibration.ipd_m",
)  # settings read only when a run starts

# Beginnings of refusals that only repeat the command.
OWN_PREFIX = {"scene": "content: scene: ", "model": "model: name: ", "place": "place: "}


@dataclass(frozen=True, slots=True)
class Choices:
    """The configuration as last read, and the settings overridden by the operator."""

    configured: Settings
    chosen: dict[tuple[str, str], Any] = field(default_factory=dict)  # chosen values, keyed by (section, key)

    def settings(self) -> Settings:
        """Return the settings with all choices applied. Raises InputError if they are invalid."""
        settings = self.configured
        for (section, key), value in self.chosen.items():
            settings = changed(settings, section, {key: value}, source="ctl")
        return settings

    def choosing(self, section: str, **values: Any) -> Choices:
        """Return a copy that also overrides these settings in one section."""
        return replace(self, chosen=self.chosen | {(section, key): value for key, value in values.items()})

    def another_scene(self, scene: str) -> Choices:
        """Return a copy with another scene, placed as configured."""
        kept = {setting: value for setting, value in self.chosen.items() if setting[1] not in PLACING}
        return replace(self, chosen=kept).choosing("content", scene=scene)

    def reloaded(self, read: Callable[[], Settings]) -> Choices:
        """Return a copy with another configuration, in which choices are kept if their settings are equal.
        Raises InputError if the new configuration is invalid or changes a setting that requires a restart.
        """
        settings, before = read(), self.configured
        frozen = [name for name in NEEDS_RESTART if attrgetter(name)(settings) != attrgetter(name)(before)]
        if frozen:
            raise InputError(
                "reload", ", ".join(frozen), "cannot be changed while the service is running; restart the service"
            )
        same = {at: value for at, value in self.chosen.items() if _value(settings, at) == _value(before, at)}
        return Choices(settings, same)


def _value(settings: Settings, at: tuple[str, str]) -> Any:
    return getattr(getattr(settings, at[0]), at[1])


@dataclass(slots=True)
class _Loading:
    """A change of settings requested by a command. Created and written only on the presenter's thread."""

    command: Command
    choose: Callable[[Choices], Choices]  # returns the new choices; called on the reading thread; may raise InputError
    reload_content: bool = False
    reading: BackgroundJob[tuple[Choices, Settings, Calibration]] | None = None  # None: not begun
    moved: dict[str, Any] = field(default_factory=dict)  # placement sent to the solver before this change was
    choices: Choices | None = None  # once they have been read
    settings: Settings | None = None
    calibration: Calibration | None = None
    order: int | None = None  # number of the order to the solver; None: not sent yet
    begun_s: float = 0.0
    superseded: bool = False  # True if the command has already been answered
    progress: str = ""  # content or model being loaded, for the status

    def read(self, before: Choices) -> tuple[Choices, Settings, Calibration]:
        """Apply the change to the previous choices, and read what belongs to it. Raises InputError."""
        choices = self.choose(before)
        settings = choices.settings()
        file = settings.calibration.file
        return choices, settings, load_calibration(Path(file) if file else None)


class Changes:
    """Carries out operators' changes to a run, loading one change at a time. For use only on the
    presenter's thread. Settings are read by a background job, and new content and a new model are loaded by the solver.
    `carry_on` polls the job, and the solver's host passes on the answers. Neither waits.
    """

    def __init__(self, presenter: Presenter) -> None:
        self._presenter = presenter
        self.choices = Choices(presenter.settings)
        self.refused = ""  # why the latest change was refused; empty if it was accepted
        self._loading: _Loading | None = None
        self._waiting: list[_Loading] = []  # one for each command's name, to start once the current change is over

    @property
    def loading(self) -> str | None:
        """Description of the content or model being loaded, or None."""
        return None if self._loading is None else self._loading.progress

    def carry_on(self) -> None:
        """Send a change that has been read to the solver, and start the next one. Called once per refresh."""
        loading = self._loading
        if loading is not None and loading.order is None and loading.reading is not None and loading.reading.done:
            self._send(loading, loading.reading)
        elif loading is not None and loading.order is not None:
            limit_s = LIMITS.load_s if loading.superseded else LIMITS.start_s
            if time.monotonic() - loading.begun_s > limit_s:
                loading.begun_s = time.monotonic()
                self._presenter.solver.restart("was ended because it took too long to load a scene or a model")
        if self._loading is None and self._waiting:
            following = self._waiting.pop(0)
            self.attempt(following.command, partial(self._load, following))

    def begin(self, command: Command, choose: Callable[[Choices], Choices], *, reload_content: bool = False) -> None:
        """Start a change, and answer the command once it is over.

        It replaces one of the same command that is not over, and waits for those of others. `choose` maps the current
        choices to the new ones, on the reading thread. `reload_content` reloads it in any case.
        """
        following = _Loading(command, choose, reload_content)
        loading = self._loading
        if loading is None:
            self._load(following)
            return
        replaced = [each for each in self._waiting if each.command.name == command.name]
        if loading.command.name == command.name and not loading.superseded:
            replaced.append(loading)
            if loading.order is not None:
                self._presenter.solver.send(Cancel(loading.order))
            loading.superseded = True
        for each in replaced:
            self.answer(each.command, SUPERSEDED)
        self._waiting = [*(each for each in self._waiting if each not in replaced), following]

    def place(self, command: Command) -> None:
        """Move the scene as requested, between two solutions. Raises InputError if the placement is invalid."""
        values = command.value or status.placing_in(self.choices.configured)
        changed(self._presenter.solver.facts.settings, "content", values, source="place")

        def moved() -> None:
            self.choices = self.choices.choosing("content", **values)

        loading = self._loading
        if loading is not None and loading.order is None:  # the solver would undo it with the content still being read
            loading.moved |= values
        self._order(command, Move(values), moved)

    def skip(self, command: Command) -> None:
        """Advance the playlist to its next entry, between two solutions."""
        self._order(command, Skip(self._presenter.clock.now_ns()))

    def attempt(self, command: Command, work: Callable[[], None]) -> None:
        """Run `work`. If it raises an exception, refuse the command and let the run continue."""
        if problem := _problem_of(command, work):
            self.answer(command, problem)

    def answer(self, command: Command, problem: str) -> None:
        """Report a command's outcome to its client and in the status; log a problem, "" if it succeeded."""
        problem = problem.removeprefix(OWN_PREFIX.get(command.name, ""))
        self.refused = problem
        if problem:
            log.error("change refused: %s", problem)
            command.refuse(problem)
        else:
            command.done(**self.holds())

    def holds(self) -> dict[str, Any]:
        """Return the current scene, model, placement and pause, for a command's answer."""
        presenter = self._presenter
        return status.holds(presenter.solver.facts, paused=presenter.paused, flat_asked=presenter.flat_asked)

    def _load(self, loading: _Loading) -> None:
        self._loading, before = loading, self.choices
        loading.begun_s = time.monotonic()
        loading.reading = BackgroundJob("reconfiguration", lambda: loading.read(before))

    def _send(self, loading: _Loading, reading: BackgroundJob[tuple[Choices, Settings, Calibration]]) -> None:
        read = reading.take()
        if loading.superseded or read is None:
            self._over(loading, reading.problem)
            return
        loading.choices, loading.settings, loading.calibration = read
        if loading.settings.content.scene == self._presenter.solver.facts.settings.content.scene:
            loading.choices = loading.choices.choosing("content", **loading.moved)
            loading.settings = changed(loading.settings, "content", loading.moved, source="place")

        def answered(answer: Answer) -> None:
            if isinstance(answer, Progress):
                loading.progress = answer.text
            elif isinstance(answer, Done):
                self._over(loading, answer.problem)

        loading.order = 0  # in case the answer comes at once
        loading.order = self._presenter.solver.send(ChangeSettings(loading.settings, loading.reload_content), answered)

    def _over(self, loading: _Loading, problem: str) -> None:
        """Answer a finished change's command. If the change has taken effect, adopt its settings and choices."""
        self._loading = None
        facts = self._presenter.solver.facts
        if not problem and loading.choices is not None and loading.settings is not None:
            self._presenter.adopt(facts.settings, loading.calibration)
            moved = moved_since(loading.settings.content, facts.settings.content)  # moved during loading
            if not loading.superseded:
                self.choices = loading.choices.choosing("content", **moved)
            log.info("now showing the scene %s with the model %s", facts.info.name, facts.model.name)
        if not loading.superseded:
            self.answer(loading.command, problem)

    def _order(self, command: Command, order: Order, succeeded: Callable[[], None] = lambda: None) -> None:
        """Send an order to the solver, and answer the command, after calling `succeeded`, once it is carried out."""

        def answered(answer: Answer) -> None:
            assert isinstance(answer, Done)
            if not answer.problem:
                self._presenter.adopt(self._presenter.solver.facts.settings)
                succeeded()
            self.answer(command, answer.problem)

        self._presenter.solver.send(order, answered)


def _problem_of(command: Command, work: Callable[[], None]) -> str:
    """Run `work` and return an error message, or an empty string if it succeeds. Logs unexpected errors."""
    try:
        work()
    except PhasestackError as error:
        return str(error)
    except (Exception, SystemExit) as error:
        log.exception("%s", command.name)
        return f"unexpected error ({type(error).__name__}); see the log"
    return ""
