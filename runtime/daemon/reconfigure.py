"""Other settings while it runs: what they need is made ready alongside the solver, and taken over between two steps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from runtime.config import Settings
from runtime.content.base import ContentSource
from runtime.content.registry import Opener, prepare_content
from runtime.daemon.solver_parts import RunningSolver, ready_predictor
from runtime.errors import InputError, PhasestackError
from runtime.eyes.calibration import load_calibration
from runtime.model.predictor import Predictor
from runtime.optics.stack import PanelStack
from runtime.support import progress
from runtime.support.background import Job
from runtime.support.crash import written
from runtime.support.memory import give_back_later


class Reconfiguration:
    """One change of settings. Nothing changes until all that it needs is ready; where any of it fails, nothing does.

    Begun by whoever asks; `advance` is a task of the solver's thread, until it answers True; then `finished` is
    set, and `problem` says whether it was refused.
    """

    def __init__(self, settings: Settings, old: Settings, stack: PanelStack, *, reload_content: bool = False) -> None:
        """Begins to load; returns at once. reload_content: read it again, though its settings are the same.

        Raises InputError for a bad calibration file, before anything has begun.
        """
        self.settings = settings
        self._calibration = load_calibration(Path(settings.calibration.file) if settings.calibration.file else None)
        self._loading: Job[Opener] | None = None
        self._source: ContentSource | None = None
        self._model: Job[Predictor] | None = None
        self._abandoned = False
        self.progress = f"loading model {settings.model.name}"  # what is being made ready, for the status
        self.problem = ""  # one line, where it can't be done
        self.finished = False
        if reload_content or settings.content != old.content:
            self.progress = f"loading {settings.content.scene}"
            self._loading = Job(settings.content.scene, lambda: self._prepared(stack))
        if _model_part(settings) != _model_part(old):
            self._model = Job("model", lambda: ready_predictor(settings, stack), discard=lambda made: made.close())

    def advance(self, parts: Any) -> bool:
        """True once it was taken over, refused or abandoned. Uploads to GL: for the solver's thread."""
        assert isinstance(parts, RunningSolver)
        if self._loading is not None and self._loading.done:
            self.problem, opener = self._loading.problem, self._loading.take()
            self._loading, self.progress = None, f"loading model {self.settings.model.name}"
            if opener is not None and not self._abandoned:
                self._open(opener, parts.context)
        if self._model is not None and self._model.done:
            self.problem = self.problem or self._model.problem
        if self.problem or self._abandoned:
            self._discard()
            self.finished = True
            return True
        if self._loading is not None or (self._model is not None and not self._model.done):
            return False
        try:
            self._commit(parts)
        except PhasestackError as error:  # another backend was asked for, and can't be had
            self.problem = str(error)
            self._discard()
        self.finished = True
        return True

    def abandon(self) -> None:
        """It is no longer wanted; nothing of it stays."""
        self._abandoned = True

    def _prepared(self, stack: PanelStack) -> Opener:
        """Content, read on the job's thread, where what is said of it is heard; abandoned, it is given up."""

        def tell(what: str, done: int, total: int | None) -> None:
            if self._abandoned:
                raise InputError("content", "scene", "is no longer wanted")
            if what:
                self.progress = f"{what}: {done} of {total}" if total else f"{what}: {done}" if done else what

        with progress.listening(tell):
            return prepare_content(self.settings.content, stack)

    def _open(self, opener: Opener, context: Any) -> None:
        try:
            self._source = opener(context)
        except PhasestackError as error:
            self.problem = str(error)
        except Exception as error:  # a GL driver's or a library's own: the present scene goes on
            self.problem = f"{self.settings.content.scene}: {written(error)}"

    def _commit(self, parts: RunningSolver) -> None:
        """Take over what is ready: one new state, and what it replaces is closed."""
        predictor = self._model.take() if self._model is not None else None
        if predictor is not None:
            try:
                parts.set_backend(predictor, self.settings)
            except PhasestackError:
                predictor.close()
                raise
        changes: dict[str, Any] = {"settings": self.settings, "calibration": self._calibration}
        if self._source is not None:
            changes["content"] = self._source
        if predictor is not None:
            changes["predictor"] = predictor
        before = parts.run.replace(**changes)
        if self._source is not None:
            before.content.close()
        if predictor is not None:
            before.predictor.close()
        give_back_later()

    def _discard(self) -> None:
        if self._source is not None:
            self._source.close()
        if self._model is not None:
            self._model.abandon()
        self._loading = self._source = self._model = None
        give_back_later()


def _model_part(settings: Settings) -> Any:
    """All that decides which predictor there is, but what is asked anew for every solution."""
    return settings.model.model_copy(update={"budget_ms": 0.0, "eye_sigma_mm": "auto"})
