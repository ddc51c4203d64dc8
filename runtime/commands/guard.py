"""Around every command: whatever happens in it ends in an exit code and at most one line on stderr.

0 done, 1 a check has failed, 2 bad usage or input, 70 an error of ours (its whole story is in a file that the line
names), 75 what may pass, 130 Ctrl-C, 141 nobody reads what is printed.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any

INTERRUPTED, BAD_INPUT, OWN_ERROR, MAY_PASS, NOBODY_READS = 130, 2, 70, 75, 141


def run_guarded(*, interrupts_leave: bool) -> None:
    """Run the command named by the arguments; never returns. interrupts_leave: Ctrl-C exited so far."""
    _fill_standard_descriptors()
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
    if interrupts_leave:  # a second interrupt finds nothing to unwind
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    code = _flushed(code)
    if _has_hung_thread():
        from runtime.support import logs

        logs.flush()
    else:
        atexit._run_exitfuncs()
    # Modules are not taken down: that takes time, and where a library's own thread still runs it would end in an abort.
    os._exit(code)


def _interrupted(number: int, frame: FrameType | None) -> None:
    """While a module is imported Python would drop what is raised, and there is nothing to unwind."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            os._exit(INTERRUPTED)
        frame = frame.f_back
    raise KeyboardInterrupt


def _has_hung_thread() -> bool:
    """Whether a solver's thread (`frame.solver_thread`) or a job (`support.background`) is in a call that hangs."""
    return any(thread.name.startswith(("solver-", "job ")) for thread in threading.enumerate())


def _code_of(app: Any) -> int:
    try:
        app()
    except SystemExit as error:
        if isinstance(error.__context__, BrokenPipeError):  # typer ends them so
            return NOBODY_READS
        return int(error.code or 0)
    return 0


def _reported(error: BaseException) -> int:
    """The exit code of what a command was ended by, told in one line."""
    from runtime.errors import PhasestackError, TransientError, one_line
    from runtime.support.extras import missing_extra

    error = missing_extra(error) or error
    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED
    if isinstance(error, BrokenPipeError):
        return NOBODY_READS
    if isinstance(error, OSError) and error.errno == errno.ENOSPC:
        _say(f"phasestack: {error.filename or 'output'}: cannot be written ({error.strerror})")
        return BAD_INPUT
    if isinstance(error, PhasestackError):
        _say(f"phasestack: {one_line(str(error), most=2000)}")
        return MAY_PASS if isinstance(error, TransientError) else BAD_INPUT
    if isinstance(error, MemoryError):
        _say("phasestack: out of memory (this may pass: start again)")
        return MAY_PASS
    from runtime.support.crash import written

    _say(f"phasestack: {written(error)}")
    return OWN_ERROR


def _say(line: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # where nobody reads stderr either, the exit code has to do
        print(line, file=sys.stderr, flush=True)
    if "NOTIFY_SOCKET" in os.environ:  # what `phasestack status` tells of a service that has failed
        with contextlib.suppress(ImportError):
            import sdnotify

            sdnotify.SystemdNotifier().notify(f"STATUS={line}")


def _flushed(code: int) -> int:
    """The exit code once all that was printed is out: Python's own last flush would tell a failure in a traceback."""
    try:
        sys.stdout.flush()
    except OSError as error:
        code = code or _reported(error)
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return code


def _fill_standard_descriptors() -> None:
    """Where stdin, stdout or stderr is closed, it leads nowhere: no file that is opened later takes its place."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    for name in ("stdout", "stderr"):
        stream: Any = getattr(sys, name) or os.fdopen(number, "w", encoding="utf-8", closefd=False)
        stream.reconfigure(errors="backslashreplace")  # a file's name need not be UTF-8
        setattr(sys, name, stream)
