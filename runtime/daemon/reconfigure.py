"""Change a solver's content or model: load in the background, then adopt between two solutions."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from runtime.config import PLACING, ContentSettings, Settings
from runtime.content.placed import placed_source, placing_of
from runtime.content.registry import Opener, prepare_content
from runtime.errors import PhasestackError, Stopped
from runtime.frame.solver import Solver
from runtime.model.base import warm_up
from runtime.model.buffers import LayerSlots
from runtime.model.device import SolverBackend
from runtime.model.predictor import SHIPPED, Predictor, load_predictor
from runtime.optics.stack import PanelStack
from runtime.support.background import BackgroundJob
from runtime.support.child import in_child
from runtime.support.crash import written
from runtime.support.memory import give_back
from runtime.support.progress import listening

MODEL_S = 30.0  # long enough to load a model and solve twice at 1920x1080 on a slow PC
Ready = tuple[Opener | None, Predictor | None]  # new content and model; None: unchanged


class Reconfiguration:
    """A change of settings that takes effect as a whole once everything is loaded, or not at all. The new
    content and model are loaded by a background job and then adopted by `advance` on the solver's thread.
    """

    def __init__(
        self,
        settings: Settings,
        old: Settings,
        stack: PanelStack,
        *,
        reload_content: bool = False,
        slots: LayerSlots | None = None,
    ) -> None:
        """Start loading; `reload_content` even with equal settings. Layers go to `slots`, if given."""
        self.settings, self._old, self._stack = settings, old, stack
        self._reload_content, self._slots = reload_content, slots
        self.abandoned = False
        self.progress = ""  # content or model being loaded, for the status
        self.problem = ""  # why the change was refused, in one line
        self._job = BackgroundJob("reconfiguration", self._make_ready)

    def abandon(self) -> None:
        """Cancel the change and discard anything loaded."""
        self.abandoned = True

    def advance(self, solver: Solver, context: Any, backend: SolverBackend) -> bool:
        """Adopt the loaded parts between steps. Returns True once the change is adopted, refused or
        discarded.
        """
        if not self._job.done:
            return False
        self.problem = self._job.problem
        ready = self._job.take()
        if ready is not None:
            opener, predictor = ready
            if self.abandoned:
                self.problem = "superseded by a newer change"
                if predictor is not None:
                    predictor.close()
            else:
                self._take_over(solver, opener, predictor, context=context, backend=backend)
        give_back()  # the replaced parts' memory
        return True

    def _make_ready(self) -> Ready:
        """Load new content and a new model if the settings require it, on the job's thread."""
        opener = predictor = None
        settings = self.settings
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
            predictor = ready_predictor(settings, self._stack, slots=self._slots)
        return opener, predictor

    def _listen(self, what: str, done: int, total: int | None) -> None:
        if self.abandoned:
            raise Stopped("superseded by a newer change")
        if what:
            self.progress = f"{what}: {done} of {total}" if total else f"{what}: {done}" if done else what

    def _take_over(
        self,
        solver: Solver,
        opener: Opener | None,
        predictor: Predictor | None,
        *,
        context: Any,
        backend: SolverBackend,
    ) -> None:
        """Replace the solver's state and close replaced parts, or keep it and set `problem` if the new ones fail."""
        now, moved = solver.state.settings.content, {}
        if now.scene == self.settings.content.scene:  # another scene is placed as configured
            moved = moved_since(self._old.content, now)
        placed = self.settings.content.model_copy(update=moved)
        changes: dict[str, Any] = {"settings": self.settings.model_copy(update={"content": placed})}
        with ExitStack() as undo:
            try:
                if predictor is not None:
                    undo.callback(predictor.close)
                if opener is not None:
                    changes["content"] = opener(context=context)
                    undo.callback(changes["content"].close)
                    if moved:
                        changes["content"] = placed_source(changes["content"], placing_of(placed))
                if predictor is not None:
                    changes["predictor"] = predictor.bound(backend=backend)
            except PhasestackError as error:
                self.problem = str(error)
                return
            except (Exception, SystemExit) as error:  # raised by a GL driver or a library; the scene is kept
                self.problem = f"{self.settings.content.scene}: {written(error)}"
                return
            undo.pop_all()
            if predictor is not None:
                predictor.close()  # it was warmed up on the processor
        before = solver.replace(**changes)
        if opener is not None:
            before.content.close()
        if predictor is not None:
            before.predictor.close()


def ready_predictor(
    settings: Settings, stack: PanelStack, *, slots: LayerSlots | None = None, warmed: bool = True
) -> Predictor:
    """Load the configured model and warm it up. Raises InputError if it cannot be used, or MissingPart.
    Layers go to memory shared with the presenter, if given. Unless `warmed`, the first solutions take longer.
    """
    predictor = load_predictor(settings.model.name, stack, settings.model)
    if slots is not None:
        predictor = predictor.bound(slots=slots)
    try:
        if warmed:
            warm_up(predictor)
    except BaseException:
        predictor.close()
        raise
    return predictor


def _tried(settings: Settings) -> None:
    """Load an untrusted model and solve with it, in a child process that may crash."""
    ready_predictor(settings, settings.stack.stack()).close()


def moved_since(before: ContentSettings, now: ContentSettings) -> dict[str, Any]:
    """Return all placement settings in `now` that differ from those in `before`."""
    return {key: getattr(now, key) for key in PLACING if getattr(now, key) != getattr(before, key)}


def _model_part(settings: Settings) -> Any:
    """Return the model settings to compare, with constants in place of any that need no new predictor."""
    return settings.model.model_copy(update={"budget_ms": 0.0, "eye_sigma_mm": "auto"})
