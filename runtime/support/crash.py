"""An exception that nobody expected: whole in a file, one line for people."""

from __future__ import annotations

import contextlib
import os
import platform
import sys
import tempfile
import threading
import traceback
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

from runtime.errors import one_line
from runtime.support.folders import state_folder

APPLICATION = "phasestack"
KEPT = 20  # files in a folder; older ones make way


def written(error: BaseException) -> str:
    """Write the exception down, and answer the line that tells it with the file's name. Never raises."""
    what = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    text = _report(error)
    for folder in _folders():
        try:
            path = _write(folder, text)
        except OSError:
            continue
        return f"unexpected error ({what}); the whole of it is in {path}"
    return f"unexpected error ({what}); it could be written down nowhere"


def _report(error: BaseException) -> str:
    from runtime.support.version import version

    return (
        f"phasestack {version()}, Python {platform.python_version()}, {platform.platform()}\n"
        f"{datetime.now(UTC).isoformat(timespec='seconds')}, process {os.getpid()}\n"
        f"arguments: {sys.argv[1:]!r}\n\n" + "".join(traceback.format_exception(error))
    )


def _folders() -> Iterator[Path]:
    """Where such a file belongs, the best place first."""
    yield state_folder()
    yield Path(tempfile.gettempdir())


def _write(folder: Path, text: str) -> Path:
    """A new file that only its owner reads: a path or a name in it may be private. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    stem = f"{APPLICATION}-error-{datetime.now(UTC):%Y%m%dT%H%M%S}-{os.getpid()}-"
    file, path = tempfile.mkstemp(".log", stem, folder)
    with os.fdopen(file, "w", encoding="utf-8", errors="backslashreplace") as opened:
        opened.write(text)
    _make_room(folder)
    return Path(path)


def _make_room(folder: Path) -> None:
    """A service that fails again and again must not fill the disk."""
    files = sorted(folder.glob(f"{APPLICATION}-error-*.log"))
    for path in files[:-KEPT]:
        try:
            path.unlink()
        except OSError:
            return  # another user's


def watch_threads() -> None:
    """Exceptions that end a thread, and those that Python can't raise, are told like others: never a traceback."""
    threading.excepthook = lambda hook: _say(hook.exc_value, hook.exc_type)
    sys.unraisablehook = lambda hook: _say(hook.exc_value, hook.exc_type)


def _say(error: BaseException | None, kind: type[BaseException]) -> None:
    if issubclass(kind, SystemExit):
        return
    if issubclass(kind, KeyboardInterrupt):
        # It fell into a finaliser or a callback, where Python drops it: send it again.
        import signal

        signal.raise_signal(signal.SIGINT)
        return
    if sys.is_finalizing():
        return
    with contextlib.suppress(OSError, ValueError):
        print(f"phasestack: {written(error or kind())}", file=sys.stderr, flush=True)
