"""Report unexpected exceptions: write the traceback to a file, and show the user one line."""

from __future__ import annotations

import contextlib
import os
import platform
import signal
import sys
import tempfile
import threading
import traceback
from datetime import UTC, datetime
from pathlib import Path

from runtime.errors import one_line, without_secrets
from runtime.support.folders import state_folder

STEM = "phasestack-error-"
ROOMS = "runtime", "phasestack", "calib", "model_export"
REPORT = "please report this bug with the file "
KEPT = 20  # maximum number of reports; a service that fails repeatedly must not fill the disk


def written(error: BaseException) -> str:
    """Write an exception report, and return a line that names the file or its failure. Never raises."""
    summary = one_line(f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
    if place := _user_code(error):
        report = report_of("", "".join(traceback.format_exception(error))).removeprefix(REPORT)
        return f"{summary} in {place}; the trace is in {report}"
    return f"unexpected error: {summary}; {report_of('', ''.join(traceback.format_exception(error)))}"


def _user_code(error: BaseException) -> str:
    """Return the file and line of a user's class that raised an error, or "" if phasestack or a package did."""
    root = Path(__file__).resolve().parents[2]
    own, installed = [root / name for name in ROOMS], [Path(sys.prefix), Path(sys.base_prefix)]
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        path = Path(frame.filename)
        if any(path.is_relative_to(folder) for folder in own):
            return ""
        if path.is_file() and not any(path.is_relative_to(folder) for folder in installed):
            return f"{path}:{frame.lineno}"
    return ""


def report_of(summary: str, trace: str) -> str:
    """Write a report of stacks to a file, and return the part of a message that names it. Never raises.
    `summary` says what has happened, such as the end of another process, unless the trace does.
    """
    from runtime.support.version import version

    now = datetime.now(UTC)
    text = (
        f"phasestack {version()}, Python {platform.python_version()}, {platform.platform()}\n"
        f"{now.isoformat(timespec='seconds')}, process {os.getpid()}\n"
        f"arguments: {sys.argv[1:]!r}\n\n" + (f"{summary}\n" if summary else "") + trace
    )
    for folder in (state_folder(), Path(tempfile.gettempdir())):
        with contextlib.suppress(OSError):
            folder.mkdir(parents=True, exist_ok=True)
            # The report may contain private paths and names. A file created by mkstemp can be read only by its owner.
            file, path = tempfile.mkstemp(".log", f"{STEM}{now:%Y%m%dT%H%M%S}-{os.getpid()}-", folder)
            try:
                with os.fdopen(file, "w", encoding="utf-8", errors="backslashreplace") as opened:
                    opened.write(without_secrets(text))
            except OSError:
                Path(path).unlink()
                raise
            with contextlib.suppress(OSError):  # some files may belong to another user
                for old in sorted(folder.glob(f"{STEM}*.log"))[:-KEPT]:
                    old.unlink()
            return f"{REPORT}{path}"
    return "the crash report could not be written"


def watch_threads() -> None:
    """Install hooks that report exceptions that end a thread, or that Python cannot raise."""
    threading.excepthook = lambda hook: _say(hook.exc_value, hook.exc_type)
    sys.unraisablehook = lambda hook: _say(hook.exc_value, hook.exc_type)


def _say(error: BaseException | None, kind: type[BaseException]) -> None:
    if issubclass(kind, SystemExit):
        return
    if issubclass(kind, KeyboardInterrupt):
        # Send the signal again, because Python drops an interrupt that arrives in a finaliser or callback.
        again = threading.Timer(0.01, signal.raise_signal, (signal.SIGINT,))
        again.daemon = True
        again.start()
        return
    if sys.is_finalizing():
        return
    with contextlib.suppress(OSError, ValueError):
        print(f"phasestack: {written(error or kind())}", file=sys.stderr, flush=True)
