"""Run each command so that any failure becomes an exit code and at most one line on stderr.

The exit codes are 0 (success), 1 (a check failed), 2 (wrong usage or input), 70 (a bug; the line names a file that
contains the traceback), 75 (a failure that may be temporary), 130 (Ctrl-C) and 141 (stdout was closed).
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import faulthandler
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any

INTERRUPTED, BAD_INPUT, OWN_ERROR, MAY_PASS, STDOUT_CLOSED = 130, 2, 70, 75, 141


def run_guarded(*, interrupts_leave: bool) -> None:
    """Run the command named on the command line, then exit the process. `interrupts_leave`: Ctrl-C has
    ended the process immediately up to now, and raises KeyboardInterrupt in the command.
    """
    _fill_standard_descriptors()
    faulthandler.enable()  # if a library crashes, every thread's Python stack is in the log
    try:
        from runtime.commands.app import app
        from runtime.support.crash import watch_threads
        from runtime.support.progress import ShownProgress, listening

        if interrupts_leave:
            signal.signal(signal.SIGINT, _interrupted)
        watch_threads()
        with listening(ShownProgress(sys.stderr)):
            code = _code_of(app)
    except BaseException as error:
        code = _reported(error)
    if interrupts_leave:  # on a second interrupt, exit immediately
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    code = _flushed(code)
    if _has_hung_thread():
        from runtime.support import logs

        logs.flush()
    else:
        atexit._run_exitfuncs()
    # Skip Python's teardown, which takes time and would abort the process if a library's thread were still running.
    os._exit(code)


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt, or exit if in the middle of an import, where Python would swallow it."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            os._exit(INTERRUPTED)
        frame = frame.f_back
    raise KeyboardInterrupt


def _has_hung_thread() -> bool:
    """Return True if a background job is still running."""
    return any(thread.name.startswith("job ") for thread in threading.enumerate())


def _code_of(app: Any) -> int:
    try:
        code = app(standalone_mode=False)
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # typer turns a closed stdout into SystemExit
            return STDOUT_CLOSED
        return int(error.code or 0)
    except Exception as error:
        if not hasattr(error, "format_message"):
            raise
        return _misused(error)
    return code if isinstance(code, int) else 0


def _misused(error: Any) -> int:
    """Report one of typer's usage errors in one line. Without arguments, it is the help."""
    message, context = error.format_message(), getattr(error, "ctx", None)
    if "\n" not in message:
        command = context.command_path if context is not None else "phasestack"
        message = f"phasestack: {message.rstrip('.')}; see `{command} --help`"
    print(message, file=sys.stderr)
    return int(error.exit_code)


def _reported(error: BaseException) -> int:
    """Print, in one line, the error that ended a command, and return the exit code."""
    from runtime.errors import PhasestackError, TransientError, is_out_of_memory, one_line
    from runtime.support.extras import missing_extra

    error = missing_extra(error) or error
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if isinstance(error, BrokenPipeError):
        return STDOUT_CLOSED
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        _say(f"phasestack: {error.filename or 'output'}: cannot be written: {error.strerror}")
        return BAD_INPUT
    if isinstance(error, PhasestackError):
        _say(f"phasestack: {one_line(str(error), most=2000)}")
        return MAY_PASS if isinstance(error, TransientError) else BAD_INPUT
    if is_out_of_memory(error):
        _say("phasestack: out of memory; close other programs and try again")
        return MAY_PASS
    from runtime.support.crash import written

    _say(f"phasestack: {written(error)}")
    return OWN_ERROR


def _say(line: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # if stderr is closed, only the exit code is left
        print(line, file=sys.stderr, flush=True)
    if "NOTIFY_SOCKET" in os.environ:  # so that `phasestack status` can show it if the service fails
        with contextlib.suppress(ImportError):
            import sdnotify

            sdnotify.SystemdNotifier().notify(f"STATUS={line}")


def _flushed(code: int) -> int:
    """Flush stdout and return the exit code, or that of a failure, which would print a traceback at exit."""
    try:
        sys.stdout.flush()
    except OSError as error:
        code = code or _reported(error)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return code


def _fill_standard_descriptors() -> None:
    """Open /dev/null in place of any closed standard stream, so that its descriptor is not reused."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name) or os.fdopen(number, "w", encoding="utf-8", closefd=False)
        stream.reconfigure(errors="backslashreplace")  # file names may not be UTF-8
        setattr(sys, name, stream)
