"""Process untrusted files in a child process with limits on memory and time.

Parsers hold Python's global lock, and even a small file can make a parser use all memory. The child returns arrays in
shared memory. Progress, log lines and errors are forwarded as if the work ran in this process.
"""

from __future__ import annotations

import errno
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from runtime.errors import InputError, PhasestackError, TransientError, one_line
from runtime.support import progress
from runtime.support.channel import Channel, ChannelClosed
from runtime.support.extras import missing_extra
from runtime.support.interpreter import end_with_parent, log_forwarded, passing_cause, started, take_over
from runtime.support.untrusted_input import LIMITS, MIB

MEMORY_MAX = 4 << 30  # default memory limit in bytes, enough for a scene that reaches every limit
LOOK_S = 0.05  # interval between checks for cancellation
SENT_S = 600.0  # how long a result waits for the parent to read
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
T = TypeVar("T")


def in_child(
    work: Callable[..., T], *args: Any, source: str | Path, seconds: float, memory_bytes: int | None = None
) -> T:
    """Call `work(*args)`, both picklable, in a child process limited to `seconds` and `memory_bytes`.

    If this thread's progress listener raises an exception, the child is killed and it propagates. Raises `work`'s
    PhasestackError, InputError if it exceeded a limit, raised another exception or ended the process, and
    TransientError if no process can be started.
    """
    memory_bytes = memory_bytes or MEMORY_MAX
    with ExitStack() as cleanup:
        try:
            ours, theirs = Channel.pair()
            cleanup.callback(ours.close)
            with closing(theirs):
                end = theirs.fileno()
                child = started(__name__, str(end), files=(end,), output=subprocess.DEVNULL, **ONE_THREAD)
        except OSError as error:
            raise TransientError(f"{source}: cannot start a process to read the file: {error.strerror}") from error
        cleanup.enter_context(child)
        cleanup.callback(child.kill)
        with suppress(ChannelClosed):
            ours.send((work, args, str(source), asdict(LIMITS), (memory_bytes, seconds)))
        try:
            return _outcome(ours, str(source), seconds)  # type: ignore[no-any-return]
        except ChannelClosed:
            limit = f"needs more than {memory_bytes // MIB} MiB of memory"
            raise InputError(
                source, "", f"{limit} or crashed the process that read the file (exit status {child.wait()})"
            ) from None


def _outcome(channel: Channel, source: str, seconds: float) -> Any:
    """Wait for the child's result, forwarding its progress, log lines and errors. Raises ChannelClosed if it has ended
    without a result.
    """
    end_s, step = time.monotonic() + seconds, (f"reading {Path(source).name}", 0, None)
    while True:
        for kind, *content in channel.receive(LOOK_S):
            match kind:
                case "done":
                    return content[0]
                case "refused":
                    raise content[0] from content[1]
                case "log":
                    log_forwarded(content[0])
                case "progress":
                    step = content[0]
                    progress.tell(*step)
        progress.tell(*step)  # the listener may raise
        if time.monotonic() > end_s:
            raise InputError(source, "", f"was not loaded within {seconds:g} s")


def main(channel: Channel) -> None:
    """Run the child process: set the limits, do the work and send the result or the error."""
    end_with_parent()
    work, args, source, limits, (memory_bytes, seconds) = channel.receive(60.0)[0]
    take_over(limits, lambda record: channel.send(("log", record), timeout_s=LOOK_S))
    processor_s = (os.cpu_count() or 1) * int(seconds) + 10  # in case the parent cannot kill the child
    for kind, most in (
        (resource.RLIMIT_DATA, memory_bytes),
        (resource.RLIMIT_CPU, processor_s),
        (resource.RLIMIT_CORE, 0),
    ):
        hard = resource.getrlimit(kind)[1]  # inherited limit, in case the parent is itself such a child
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")

    def tell(*step: Any) -> None:
        channel.send(("progress", step))

    try:
        with progress.listening(tell):
            result = work(*args)
        channel.send(("done", result), timeout_s=SENT_S)
    except MemoryError:
        os._exit(1)
    except PhasestackError as error:
        cause = passing_cause(error)
        if isinstance(cause, MemoryError):
            os._exit(1)
        is_own_limit = cause is not None and cause.errno == errno.ENOMEM
        channel.send(("refused", error, None if is_own_limit else cause), timeout_s=SENT_S)
    except Exception as error:
        if missing := missing_extra(error):
            channel.send(("refused", missing, None), timeout_s=SENT_S)
            return
        problem = one_line(f"cannot be read: {type(error).__name__}: {error}")
        channel.send(("refused", InputError(source, "", problem), None), timeout_s=SENT_S)


if __name__ == "__main__":
    main(Channel.of(int(sys.argv[1])))
    os._exit(0)
