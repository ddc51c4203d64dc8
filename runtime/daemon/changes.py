"""Apply operators' changes to a run's settings, one at a time."""

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
    "pose",
    "model.backend",
    "calibration.ipd_m",
)  # settings read only when a run starts

# What a refusal begins with although the command itself says it.
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
        """Return a copy with the configuration returned by `read`.

        A choice is kept only if the setting is the same in the new configuration as in the old one. Raises InputError
        if the new configuration is invalid or if it changes a setting that requires a restart.
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
class _Change:
    """A change of settings requested by a command."""

    command: Command
    choose: Callable[[Choices], Choices]  # returns the new choices; called on the loading thread; may raise InputError
    reload_content: bool = False
    choices: Choices | None = None  # set by the loading thread before it is done

    def settings(self, before: Choices) -> Settings:
        """Apply the change to the previous choices, and return the new settings.

        Raises InputError if the new settings are invalid.
        """
        self.choices = self.choose(before)
        return self.choices.settings()


class Changes:
    """Carries out operators' changes to a run, loading one change at a time.

    For use only on the presenter's thread. Settings are read and new parts loaded by a background job (see
    `Reconfiguration`), and the scene is moved on the solver's thread. Both work on copies of their inputs. `carry_on`
    polls the job and collects the results from the solver's thread. It never waits.
    """

    def __init__(self, presenter: Presenter) -> None:
        self._presenter = presenter
        self.choices = Choices(presenter.run_cell.state.settings)
        self.refused = ""  # why the latest change was refused; empty if it was accepted
        self._loading: tuple[_Change, Reconfiguration] | None = None
        self._next: _Change | None = None  # to start once the current change is over
        self._outcomes: SimpleQueue[Callable[[], None]] = SimpleQueue()  # results from the solver's thread

    @property
    def loading(self) -> Reconfiguration | None:
        """The change being loaded, or None."""
        return None if self._loading is None else self._loading[1]

    def carry_on(self) -> None:
        """Process results from other threads and start the next waiting change. Called once per refresh."""
        finished = self._loading is not None and self._loading[1].finished
        while not self._outcomes.empty():  # first, because they may concern the scene to be replaced
            self._outcomes.get()()
        if self._loading is not None and finished:
            (change, loading), self._loading = self._loading, None
            if not loading.abandoned:
                self._finish(change, loading)
        if self._loading is None and self._next is not None:
            change, self._next = self._next, None
            self.attempt(change.command, partial(self._load, change))

    def begin(self, command: Command, choose: Callable[[Choices], Choices], *, reload_content: bool = False) -> None:
        """Start a change, or replace one that is still loading.

        Args:
            command: Command to answer once the change is over.
            choose: Function that returns the new choices, given the current ones. Called on the loading thread.
            reload_content: True to reload the content even if its settings have not changed.
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
        """Move the scene as requested. Raises InputError if the placement is invalid.

        The settings and the content are replaced together, on the solver's thread between two solutions.
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
        """Advance the playlist to its next entry, on the solver's thread between two solutions."""

        def skip(parts: Any) -> str:
            skipped = parts.run.state.content.skip(time_ns=self._presenter.clock.now_ns())
            return (
                ""
                if skipped
                else ("there is no next entry because the scene is not a playlist or is already at its last entry")
            )

        self._between_steps(command, skip)

    def attempt(self, command: Command, work: Callable[[], None]) -> None:
        """Run `work`. If it raises an exception, refuse the command and let the run continue."""
        if problem := _problem_of(command, work):
            self.answer(command, problem)

    def answer(self, command: Command, problem: str) -> None:
        """Report a command's outcome to its client and in the status. If it was refused, also log this.

        Args:
            command: Command to answer.
            problem: Why the command was refused, or an empty string if it succeeded.
        """
        problem = problem.removeprefix(OWN_PREFIX.get(command.name, ""))
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
        """Answer a finished change's command. If the change has taken effect, adopt its choices."""
        if not loading.problem and change.choices is not None:
            state = self._presenter.run_cell.state
            moved = moved_since(loading.settings.content, state.settings.content)  # moved during loading
            self.choices = change.choices.choosing("content", **moved)
            log.info("now showing the scene %s with the model %s", state.content.info.name, state.predictor.name)
        self.answer(change.command, loading.problem)

    def _between_steps(
        self, command: Command, work: Callable[[Any], str], succeeded: Callable[[], None] = lambda: None
    ) -> None:
        """Run `work` on the solver's thread between two solutions. Then answer the command on this thread.

        Args:
            command: Command to answer.
            work: Function called with the solver's parts. Returns why the command was refused, or an empty string.
            succeeded: Function called on the presenter's thread if the work succeeds, before the command is answered.
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
    """Run `work` and return an error message, or an empty string if it succeeds. Logs unexpected errors."""
    try:
        work()
    except PhasestackError as error:
        return str(error)
    except (Exception, SystemExit) as error:
        log.exception("%s", command.name)
        return f"unexpected error ({type(error).__name__}); see the log"
    return ""
