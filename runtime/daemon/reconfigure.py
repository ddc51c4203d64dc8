"""Change a run's settings: load in the background, then adopt between two solutions."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from runtime.config import ContentSettings, Settings
from runtime.content.placed import placed_source, placing_of
from runtime.content.registry import Opener, prepare_content
from runtime.daemon.commands import PLACING
from runtime.daemon.solver_parts import RunningSolver, ready_predictor
from runtime.errors import PhasestackError, Stopped
from runtime.eyes.calibration import Calibration, load_calibration
from runtime.frame.run_state import SOLVER_ABANDONED
from runtime.model.predictor import SHIPPED, Predictor
from runtime.optics.stack import PanelStack
from runtime.support.background import BackgroundJob
from runtime.support.child import in_child
from runtime.support.crash import written
from runtime.support.memory import give_back
from runtime.support.progress import listening
from runtime.support.untrusted_input import LIMITS

MODEL_S = 30.0  # long enough to load a model and solve twice at 1920x1080 on a slow PC
Ready = tuple[Opener | None, Predictor | None]  # new content and model; None: unchanged


class Reconfiguration:
    """A change of settings that takes effect as a whole once everything is loaded, or not at all.

    The new content and model are loaded by a background job and then adopted by `advance` on the solver's thread. The
    presenter's thread polls `finished` and then reads `problem`.
    """

    def __init__(
        self, read: Callable[[], Settings], old: Settings, stack: PanelStack, *, reload_content: bool = False
    ) -> None:
        """Start loading.

        Args:
            read: Function that returns the new settings. Called by the background job. May raise InputError.
            old: The current settings.
            stack: The run's panels.
            reload_content: True to reload the content even if its settings have not changed.
        """
        self._read, self._old, self._stack, self._reload_content = read, old, stack, reload_content
        self.settings = old
        self._calibration: Calibration
        self.abandoned = False
        self._begun_s = time.monotonic()
        self.progress = ""  # what is being loaded, for the status
        self.problem = ""  # why the change was refused, in one line
        self._adopter: RunningSolver | None = None  # the solver that adopts the change
        self._finished = False
        self._job = BackgroundJob("reconfiguration", self._make_ready)

    def abandon(self) -> None:
        """Cancel the change and discard anything loaded."""
        self.abandoned = True

    def advance(self, parts: Any) -> bool:
        """Adopt the loaded parts. Called on the solver's thread between steps until it returns True.

        Returns:
            True once the change has been adopted, refused or discarded.
        """
        assert isinstance(parts, RunningSolver)
        if not self._job.done:
            return False
        self.problem = self._job.problem
        ready = self._job.take()
        if ready is not None:
            opener, predictor = ready
            if self.abandoned:
                if predictor is not None:
                    predictor.close()
            else:
                self._adopter = parts
                self._take_over(parts, opener, predictor)
        BackgroundJob("memory", give_back)  # returns the replaced parts' memory to the system
        self._finished = True
        return True

    @property
    def finished(self) -> bool:
        """True once the change has been adopted, refused or discarded.

        Also True if the solver has been replaced while adopting it, or if it was abandoned but takes too long to load.
        """
        if not self._finished and self._adopter is not None and not self._adopter.is_newest:
            self.problem, self._finished = SOLVER_ABANDONED, True
        is_stuck = self.abandoned and time.monotonic() - self._begun_s > LIMITS.load_s
        return self._finished or is_stuck

    def _make_ready(self) -> Ready:
        """Read the settings and, if required, load new content and a new model, on the job's thread."""
        opener = predictor = None
        self.settings = settings = self._read()
        file = settings.calibration.file
        self._calibration = load_calibration(Path(file) if file else None)
        has_content = self._reload_content or settings.content != self._old.content
        has_model = _model_part(settings) != _model_part(self._old)
        model = settings.model.name
        with listening(self._listen):
            if has_model and model not in SHIPPED and Path(model).is_file():
                self.progress = "testing the model"
                in_child(_tried, settings, source=model, seconds=MODEL_S)
            if has_content:
                self.progress = f"loading {settings.content.scene}"
                opener = prepare_content(settings.content, self._stack)
        if has_model:
            self.progress = f"loading model {model}"
            predictor = ready_predictor(settings, self._stack)
        return opener, predictor

    def _listen(self, what: str, done: int, total: int | None) -> None:
        if self.abandoned:
            raise Stopped("superseded by a newer change")
        if what:
            self.progress = f"{what}: {done} of {total}" if total else f"{what}: {done}" if done else what

    def _take_over(self, parts: RunningSolver, opener: Opener | None, predictor: Predictor | None) -> None:
        """Replace the run's state and close any parts that were replaced.

        If the new content or model fails, the old state is kept and `problem` is set.
        """
        now, moved = parts.run.state.settings.content, {}
        if now.scene == self.settings.content.scene:  # another scene is placed as configured
            moved = moved_since(self._old.content, now)
        placed = self.settings.content.model_copy(update=moved)
        settings = self.settings.model_copy(update={"content": placed})
        changes: dict[str, Any] = {"settings": settings, "calibration": self._calibration}
        with ExitStack() as undo:
            try:
                if predictor is not None:
                    undo.callback(predictor.close)
                    changes["predictor"] = predictor
                if opener is not None:
                    changes["content"] = opener(context=parts.context)
                    undo.callback(changes["content"].close)
                    if moved:
                        changes["content"] = placed_source(changes["content"], placing_of(placed))
                if predictor is not None:
                    predictor.set_backend(parts.backend.backend)
                before = parts.replace(**changes)
            except PhasestackError as error:
                self.problem = str(error)
                return
            except (Exception, SystemExit) as error:  # raised by a GL driver or a library; the scene is kept
                self.problem = f"{self.settings.content.scene}: {written(error)}"
                return
            undo.pop_all()
        if opener is not None:
            before.content.close()
        if predictor is not None:
            before.predictor.close()


def _tried(settings: Settings) -> None:
    """Load an untrusted model and solve with it.

    Runs in a child process, so that a crash cannot harm the daemon.
    """
    ready_predictor(settings, settings.stack.stack()).close()


def moved_since(before: ContentSettings, now: ContentSettings) -> dict[str, Any]:
    """Return all placement settings in `now` that differ from those in `before`."""
    return {key: getattr(now, key) for key in PLACING if getattr(now, key) != getattr(before, key)}


def _model_part(settings: Settings) -> Any:
    """Return the model settings to compare, with constants in place of any that need no new predictor."""
    return settings.model.model_copy(update={"budget_ms": 0.0, "eye_sigma_mm": "auto"})
