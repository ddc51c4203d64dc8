"""Changes made by operators: choices that override the configuration, and the change being loaded."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from operator import attrgetter
from queue import SimpleQueue
from typing import Any

from runtime.config import Settings, changed
from runtime.content.placed import placed_source, placing_of
from runtime.daemon import status
from runtime.daemon.commands import PLACING, Command
from runtime.daemon.reconfigure import Reconfiguration, moved_since
from runtime.errors import InputError, PhasestackError
from runtime.frame.presenter import Presenter

log = logging.getLogger("phasestack.daemon")

NEEDS_RESTART = (
    "stack",
    "sensor",
    "output",
    "service",
    "loop",
    "model.backend",
    "calibration.ipd_m",
)  # used only at the start


@dataclass(frozen=True, slots=True)
class Choices:
    """The configuration as last read, and the operator's choices that override it."""

    configured: Settings
    chosen: dict[tuple[str, str], Any] = field(default_factory=dict)  # by section and key

    def settings(self) -> Settings:
        """Return the settings with all choices applied. Raises InputError if they are invalid."""
        settings = self.configured
        for (section, key), value in self.chosen.items():
            settings = changed(settings, section, {key: value}, source="ctl")
        return settings

    def choosing(self, section: str, **values: Any) -> Choices:
        """Return the choices with these values of one section added."""
        return replace(self, chosen=self.chosen | {(section, key): value for key, value in values.items()})

    def another_scene(self, scene: str) -> Choices:
        """Return the choices with another scene, which starts in its configured placement."""
        kept = {setting: value for setting, value in self.chosen.items() if setting[1] not in PLACING}
        return replace(self, chosen=kept).choosing("content", scene=scene)

    def reloaded(self, read: Callable[[], Settings]) -> Choices:
        """Return the new configuration, with the choices whose settings it has not changed.

        Raises InputError if the configuration is invalid or changes a setting that requires a restart.
        """
        settings, before = read(), self.configured
        frozen = [name for name in NEEDS_RESTART if attrgetter(name)(settings) != attrgetter(name)(before)]
        if frozen:
            raise InputError(
                "reload", ", ".join(frozen), "cannot change while the service is running; restart the service"
            )
        same = {at: value for at, value in self.chosen.items() if _value(settings, at) == _value(before, at)}
        return Choices(settings, same)


def _value(settings: Settings, at: tuple[str, str]) -> Any:
    return getattr(getattr(settings, at[0]), at[1])


@dataclass(slots=True)
class _Change:
    """A change of settings that a command asks for."""

    command: Command
    choose: Callable[[Choices], Choices]  # runs on the loading thread; raises InputError
    reload_content: bool = False
    choices: Choices | None = None  # set by the loading thread before its job ends

    def settings(self, before: Choices) -> Settings:
        """Apply the operator's choice and return the new settings. Raises InputError if they are invalid."""
        self.choices = self.choose(before)
        return self.choices.settings()


class Changes:
    """Changes to a run, loaded one at a time.

    Only the presenter's thread uses this object. A job reads and loads settings (`Reconfiguration`) and the solver's
    thread moves the scene. Both get copies of their inputs and return their outcome through a queue.
    """

    def __init__(self, presenter: Presenter) -> None:
        self._presenter = presenter
        self.choices = Choices(presenter.run_cell.state.settings)
        self.refused = ""  # reason for refusing the last change; empty if it was accepted
        self._loading: tuple[_Change, Reconfiguration] | None = None
        self._next: _Change | None = None  # starts when the current change has ended
        self._outcomes: SimpleQueue[Callable[[], None]] = SimpleQueue()  # outcomes of work on the solver's thread

    @property
    def loading(self) -> Reconfiguration | None:
        """Return the change being loaded, if any."""
        return None if self._loading is None else self._loading[1]

    def carry_on(self) -> None:
        """Process results of other threads and start the next change. Called once per refresh."""
        finished = self._loading is not None and self._loading[1].finished
        while not self._outcomes.empty():  # first, because they may concern the scene that a change replaces
            self._outcomes.get()()
        if self._loading is not None and finished:
            (change, loading), self._loading = self._loading, None
            if not loading.abandoned:
                self._finish(change, loading)
        if self._loading is None and self._next is not None:
            change, self._next = self._next, None
            self.attempt(change.command, partial(self._load, change))

    def begin(self, command: Command, choose: Callable[[Choices], Choices], *, reload_content: bool = False) -> None:
        """Start a change. A change that is still loading is abandoned first.

        choose: computes the new choices on the loading thread.
        reload_content: reload the content even if its settings have not changed.
        """
        change = _Change(command, choose, reload_content)
        if self._loading is None:
            self._load(change)
            return
        (current, loading), waiting = self._loading, self._next
        for skipped in (None if loading.abandoned else current, waiting):
            if skipped is not None:
                self.answer(skipped.command, "superseded by a newer change")
        loading.abandon()
        self._next = change

    def place(self, command: Command) -> None:
        """Move the scene. Raises InputError if the placement is invalid.

        This happens on the solver's thread, so that settings and content agree.
        """
        values = command.value or status.placing_in(self.choices.configured)
        changed(self._presenter.run_cell.state.settings, "content", values, source="place")

        def move(parts: Any) -> str:
            state = parts.run.state
            settings = changed(state.settings, "content", values, source="place")
            source = placed_source(state.content, placing_of(settings.content))
            parts.replace(settings=settings, content=source)
            return ""

        def moved() -> None:
            self.choices = self.choices.choosing("content", **values)

        self._between_steps(command, move, moved)

    def skip(self, command: Command) -> None:
        """Advance the playlist to its next entry, on the solver's thread."""

        def skip(parts: Any) -> str:
            skipped = parts.run.state.content.skip(time_ns=self._presenter.clock.now_ns())
            return "" if skipped else "there is no next entry: the scene is not a playlist, or it is at its last entry"

        self._between_steps(command, skip)

    def attempt(self, command: Command, work: Callable[[], None]) -> None:
        """Run `work`. If it raises, refuse the command and let the run continue."""
        if problem := _problem_of(command, work):
            self.answer(command, problem)

    def answer(self, command: Command, problem: str) -> None:
        """Report a change's outcome to client, log and status. problem: reason for a refusal, or ""."""
        self.refused = problem
        if problem:
            log.error("change refused: %s", problem)
            command.refuse(problem)
        else:
            command.done(**status.holds(self._presenter))

    def _load(self, change: _Change) -> None:
        present = self._presenter.run_cell.state.settings
        read = partial(change.settings, self.choices)
        loading = Reconfiguration(read, present, self._presenter.stack, reload_content=change.reload_content)
        self._loading = change, loading
        self._presenter.solver.do(loading.advance)

    def _finish(self, change: _Change, loading: Reconfiguration) -> None:
        """Adopt the choices of a change that has taken effect and answer its command."""
        if not loading.problem and change.choices is not None:
            state = self._presenter.run_cell.state
            moved = moved_since(loading.settings.content, state.settings.content)  # while it was loading
            self.choices = change.choices.choosing("content", **moved)
            log.info("now showing the scene %s with the model %s", state.content.info.name, state.predictor.name)
        self.answer(change.command, loading.problem)

    def _between_steps(
        self, command: Command, work: Callable[[Any], str], succeeded: Callable[[], None] = lambda: None
    ) -> None:
        """Run `work` on the solver's thread between two solutions, then answer the command on this thread.

        work: returns the reason for a refusal, or an empty string. succeeded: runs on the presenter's thread.
        """

        def finish(problem: str) -> None:
            if not problem:
                succeeded()
            self.answer(command, problem)

        def task(parts: Any) -> bool:
            refusals: list[str] = []
            problem = _problem_of(command, lambda: refusals.append(work(parts)))
            self._outcomes.put(partial(finish, problem or refusals[0]))
            return True

        self._presenter.solver.do(task)


def _problem_of(command: Command, work: Callable[[], None]) -> str:
    """Run `work` and return its problem, or an empty string. Logs unexpected errors."""
    try:
        work()
    except PhasestackError as error:
        return str(error)
    except (Exception, SystemExit) as error:
        log.exception("%s", command.name)
        return f"unexpected error ({type(error).__name__}); see the log"
    return ""
