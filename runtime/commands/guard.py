"""Around every command: whatever happens in it ends in an exit code and at most one line on stderr.

0 done, 1 a check has failed, 2 bad usage or input, 70 an error of ours (its whole story is in a file that the line
names), 75 what may pass, 130 Ctrl-C, 141 nobody reads what is printed.
"""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import threading
from typing import Any

INTERRUPTED, BAD_INPUT, OWN_ERROR, MAY_PASS, NOBODY_READS = 130, 2, 70, 75, 141


def run_guarded(*, interrupts_leave: bool) -> None:
    """Run the command that the arguments name; never returns. interrupts_leave: until now (`cli`); then they raise."""
    _fill_standard_descriptors()
    try:
        from runtime.commands.app import app
        from runtime.support.crash import watch_threads
        from runtime.support.progress import ShownProgress, listening

        if interrupts_leave:
            signal.signal(signal.SIGINT, signal.default_int_handler)
        watch_threads()
        with listening(ShownProgress(sys.stderr)):
            code = _code_of(app)
        _interrupts_leave(interrupts_leave)
    except BaseException as error:
        _interrupts_leave(interrupts_leave)
        code = _reported(error)
    code = _flushed(code)
    if _has_hung_thread():  # taking down what a library's own thread still runs in would end in an abort
        from runtime.support import logs

        logs.flush()
        os._exit(code)
    sys.exit(code)


def _interrupts_leave(wanted: bool) -> None:
    """From now on a second interrupt finds nothing to unwind: it ends the process at once."""
    if wanted:
        signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))


def _has_hung_thread() -> bool:
    """Whether a solver's thread (`frame.solver_thread`) or a job (`support.background`) is in a call that hangs."""
    return any(thread.name.startswith(("solver-", "job ")) for thread in threading.enumerate())


def _code_of(app: Any) -> int:
    from runtime.support.removed import removed_command

    if gone := removed_command(sys.argv[1:]):
        _say(f"phasestack: {gone[0]}: is gone: {gone[1]}")
        return BAD_INPUT
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

    if _is_interrupt(error):
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


def _is_interrupt(error: BaseException | None) -> bool:
    """An interrupt, or what a library made of one that fell into its import."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


def _say(line: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # where nobody reads stderr either, the exit code has to do
        print(line, file=sys.stderr, flush=True)
    if "NOTIFY_SOCKET" in os.environ:  # what `phasestack status` tells of a service that has failed
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
