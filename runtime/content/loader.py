"""Loading off the loop: another scene is read in the background while the present one goes on."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

from runtime.config import ContentSettings, LimitSettings
from runtime.content.base import ContentSource
from runtime.content.registry import Opener, prepare_content
from runtime.errors import PhasestackError
from runtime.optics.stack import PanelStack
from runtime.support import progress
from runtime.support.crash import written


@dataclass(frozen=True, slots=True)
class Loaded:
    """What came of a request: a source that is ready to draw, or why there is none."""

    scene: str
    source: ContentSource | None
    problem: str = ""


class _Skipped(Exception):
    """A newer request made this one needless."""


class ContentLoader:
    """One request at a time; a newer one skips an older. `poll` belongs to the thread with the GL context."""

    def __init__(self, stack: PanelStack, *, limits: LimitSettings | None = None) -> None:
        """limits: of what files may hold; None: the defaults."""
        self._stack, self._limits = stack, limits
        self._lock = threading.Lock()
        self._wanted = 0
        self._result: tuple[int, str, Opener | None, str] | None = None
        self.progress = ""  # one line for the status; empty: nothing is being loaded

    def request(self, settings: ContentSettings) -> None:
        """Begin to load; returns at once."""
        with self._lock:
            self._wanted += 1
            number = self._wanted
            self.progress = f"loading {settings.scene}"
        threading.Thread(target=self._load, args=(number, settings), name="content-loader", daemon=True).start()

    def poll(self, context: Any) -> Loaded | None:
        """The newest request's outcome, once; None while it is under way. Uploads to GL."""
        with self._lock:
            if self._result is None:
                return None
            _, scene, opener, problem = self._result
            self._result, self.progress = None, ""
        if opener is None:
            return Loaded(scene, None, problem)
        try:
            return Loaded(scene, opener(context))
        except PhasestackError as error:
            return Loaded(scene, None, str(error))
        except Exception as error:  # a GL driver's or a library's own: the present scene goes on
            return Loaded(scene, None, f"{scene}: {written(error)}")

    def _load(self, number: int, settings: ContentSettings) -> None:
        opener: Opener | None = None
        problem = ""

        def tell(what: str, done: int, total: int | None) -> None:
            with self._lock:
                if number != self._wanted:
                    raise _Skipped
                self.progress = f"{what}: {done} of {total}" if total else f"{what}: {done}" if done else what

        try:
            with progress.listening(tell):
                opener = prepare_content(settings, self._stack, limits=self._limits)
        except _Skipped:
            return
        except PhasestackError as error:
            problem = str(error)
        except Exception as error:  # whatever a file provokes in a loader, the loop goes on
            problem = f"{settings.scene}: {written(error)}"
        with self._lock:
            if number == self._wanted:
                self._result = (number, settings.scene, opener, problem)
