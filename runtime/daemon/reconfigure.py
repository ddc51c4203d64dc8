"""A change of settings during a run: loaded beside the solver, taken over between two steps."""

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
from runtime.frame.run_state import LEFT_BEHIND
from runtime.model.predictor import SHIPPED, Predictor
from runtime.optics.stack import PanelStack
from runtime.support.background import Job
from runtime.support.child import in_child
from runtime.support.crash import written
from runtime.support.memory import give_back
from runtime.support.progress import listening
from runtime.support.untrusted_input import LIMITS

MODEL_S = 30.0  # to load a model and solve with it twice, at 1920x1080 on a slow PC
Ready = tuple[Opener | None, Predictor | None]  # None: stays as it is


class Reconfiguration:
    """One change of settings, all or nothing: it takes effect once everything it needs is loaded.

    Begun by whoever asks; `advance` is a task of the solver's thread, until it answers True; then `finished` is
    set, and `problem` says whether it was refused.
    """

    def __init__(
        self, read: Callable[[], Settings], old: Settings, stack: PanelStack, *, reload_content: bool = False
    ) -> None:
        """Begins to load; returns at once. read: the other settings, on another thread; may raise InputError.

        reload_content: read it again, though its settings are the same.
        """
        self._read, self._old, self._stack, self._reload_content = read, old, stack, reload_content
        self.settings = old
        self._calibration: Calibration
        self.abandoned = False
        self._begun_s = time.monotonic()
        self.progress = ""  # what is being made ready, for the status
        self.problem = ""  # one line, where it can't be done
        self._taker: RunningSolver | None = None  # that takes it over
        self._finished = False
        self._job = Job("reconfiguration", self._make_ready)

    def abandon(self) -> None:
        """It is no longer wanted; nothing of it stays."""
        self.abandoned = True

    def advance(self, parts: Any) -> bool:
        """True once it was taken over, refused or abandoned. Uploads to GL: for the solver's thread."""
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
                self._taker = parts
                self._take_over(parts, opener, predictor)
        Job("memory", give_back)  # what was replaced is large, and nobody waits for it
        self._finished = True
        return True

    @property
    def finished(self) -> bool:
        """True once taken over or refused; also where the solver hangs in it, or it was abandoned."""
        if not self._finished and self._taker is not None and not self._taker.is_newest:
            self.problem, self._finished = LEFT_BEHIND, True
        is_stuck = self.abandoned and time.monotonic() - self._begun_s > LIMITS.load_s
        return self._finished or is_stuck

    def _make_ready(self) -> Ready:
        """On the job's thread: all that takes long."""
        opener = predictor = None
        self.settings = settings = self._read()
        file = settings.calibration.file
        self._calibration = load_calibration(Path(file) if file else None)
        has_content = self._reload_content or settings.content != self._old.content
        has_model = _model_part(settings) != _model_part(self._old)
        model = settings.model.name
        with listening(self._listen):
            if has_model and model not in SHIPPED and Path(model).is_file():
                self.progress = "trying it out"
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
            raise Stopped("a newer change came")
        if what:
            self.progress = f"{what}: {done} of {total}" if total else f"{what}: {done}" if done else what

    def _take_over(self, parts: RunningSolver, opener: Opener | None, predictor: Predictor | None) -> None:
        """One new state, and what it replaces is closed; where the upload fails, nothing changes."""
        now, moved = parts.run.state.settings.content, {}
        if now.scene == self.settings.content.scene:  # another scene stands as the configuration has it
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
            except (Exception, SystemExit) as error:  # a GL driver's or a library's own: what is shown goes on
                self.problem = f"{self.settings.content.scene}: {written(error)}"
                return
            undo.pop_all()
        if opener is not None:
            before.content.close()
        if predictor is not None:
            before.predictor.close()


def _tried(settings: Settings) -> None:
    """Load a model of nobody knows whom, and solve with it, where that ends nothing but a child process."""
    ready_predictor(settings, settings.stack.stack()).close()


def moved_since(before: ContentSettings, now: ContentSettings) -> dict[str, Any]:
    """Where a scene stands now, in what that has changed."""
    return {key: getattr(now, key) for key in PLACING if getattr(now, key) != getattr(before, key)}


def _model_part(settings: Settings) -> Any:
    """All that decides which predictor there is, but what is asked anew for every solution."""
    return settings.model.model_copy(update={"budget_ms": 0.0, "eye_sigma_mm": "auto"})
