"""The inner loops of the OpenCV backend: compiled ones where their compiler is installed and works, else OpenCV's."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import metadata, resources
from pathlib import Path

from runtime.model.fade import FadeCodes, fade_codes
from runtime.model.pyramid_level import PyramidLevel
from runtime.model.wanted import fill_wanted
from runtime.support.cache import digest, user_cache

log = logging.getLogger("phasestack.model")

SOURCES = (
    "sampling.py",
    "passes.py",
    "enlarge.py",
    "fade.py",
    "pixels.py",
    "warp.py",
    "sight.py",
    "unseen.py",
    "wanted.py",
)


@dataclass(frozen=True, slots=True)
class Loops:
    """What does corrections, and why."""

    level: type[PyramidLevel]
    why: str  # one line
    fill_wanted: Callable[..., None] = fill_wanted
    fade_codes: FadeCodes = fade_codes

    @property
    def compiled(self) -> bool:
        """Whether they are compiled ones."""
        return self.level is not PyramidLevel


@cache
def inner_loops() -> Loops:
    """Those of this machine. The first call on it compiles, which takes some ten seconds and is kept."""
    try:
        import numba  # noqa: PLC0415 - half a second that only models need

        folder = _kept()
        numba.config.CACHE_DIR = str(folder or "")  # type: ignore[attr-defined]
        if folder is not None and not any(folder.iterdir()):
            log.debug("inner loops are compiled, once: some ten seconds")
        from runtime.model.compiled import fade, wanted  # noqa: PLC0415 - imports numba
        from runtime.model.compiled.level import CompiledLevel, warm_up  # noqa: PLC0415

        warm_up()
    except ImportError as error:
        return Loops(PyramidLevel, f"OpenCV's, for want of compiled ones ({error})")
    except Exception as error:  # a compiler has no list of what it may fail with
        log.warning("inner loops: OpenCV's, the compiled ones failed (%s: %s)", type(error).__name__, error)
        return Loops(PyramidLevel, f"OpenCV's, the compiled ones failed ({type(error).__name__}: {error})")
    why = f"compiled, kept in {folder}" if folder else "compiled, at every start anew"
    return Loops(CompiledLevel, why, wanted.fill_wanted, fade.fade_codes)


def _kept() -> Path | None:
    """The folder for compiled code, named by what it follows from; None where none can be written."""
    package = resources.files("runtime.model") / "compiled"
    sources = [Path(str(package / name)) for name in SOURCES]
    folder = user_cache("compiled") / digest(sources, metadata.version("numba"))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError:
        return None
    return folder if os.access(folder, os.W_OK) else None
