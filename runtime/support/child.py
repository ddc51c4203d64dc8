"""Process untrusted files in a child process with limits on memory and time.

Parsers hold Python's global lock, and even a small file can make a parser use all memory. The child returns arrays in
shared memory. Progress, log lines and errors are forwarded as if the work ran in this process.
"""

from __future__ import annotations

import ctypes
import errno
import logging
import mmap
import os
import pickle
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from runtime.errors import PASSING, InputError, PhasestackError, TransientError, one_line
from runtime.support import progress
from runtime.support.extras import missing_extra
from runtime.support.untrusted_input import LIMITS, MIB

MEMORY_MAX = 4 << 30  # default memory limit in bytes, enough for a scene that reaches every limit
LOOK_S = 0.05  # interval between checks for cancellation
ALIGNED = 64  # alignment of arrays in bytes
PR_SET_PDEATHSIG = 1  # constant from Linux's prctl.h
SMALL = 1 << 16  # size in bytes below which arrays are copied
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
T = TypeVar("T")


def in_child(
    work: Callable[..., T], *args: Any, source: str | Path, seconds: float, memory_bytes: int | None = None
) -> T:
    """Call `work(*args)` in a child process and return the result.

    If this thread's progress listener (`progress.listening`) raises an exception, the child is killed and the exception
    propagates.

    Args:
        work: Function at the top level of a module.
        args: Arguments for `work`. They must be picklable.
        seconds: Time limit.
        memory_bytes: Memory limit, by default `MEMORY_MAX`.

    Raises:
        PhasestackError: `work` raised this error.
        InputError: `work` exceeded a limit, raised any other exception, or ended the process.
        TransientError: No process can be started.
    """
    memory_bytes = memory_bytes or MEMORY_MAX
    ours, theirs = Pipe()
    memory = os.memfd_create("result")
    command = [sys.executable, "-P", "-m", __name__, str(theirs.fileno()), str(memory)]
    # Put this copy of phasestack first.
    python_path = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": python_path}
    try:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            pass_fds=(theirs.fileno(), memory),
            env=environment,
        )
    except OSError as error:
        os.close(memory)
        raise TransientError(f"{source}: cannot start a process to read the file: {error.strerror}") from error
    finally:
        theirs.close()
    with child, ours:
        try:
            with suppress(BrokenPipeError):
                ours.send((work, args, str(source), asdict(LIMITS), (memory_bytes, seconds)))
            result = _outcome(ours, str(source), seconds)
            if result is None:
                limit = f"needs more than {memory_bytes // MIB} MiB of memory"
                raise InputError(
                    source, "", f"{limit} or crashed the process that read the file (exit status {child.wait()})"
                )
            return pickle.loads(result[0], buffers=_mapped(memory, result[1]))  # type: ignore[no-any-return]
        finally:
            child.kill()
            os.close(memory)


def _outcome(channel: Connection, source: str, seconds: float) -> tuple[bytes, list[int]] | None:
    """Wait for the child's result, forwarding its progress, log lines and errors.

    Returns the pickled result and the sizes of its arrays in bytes, or None if the child ended without a result.
    """
    end_s, step = time.monotonic() + seconds, (f"reading {Path(source).name}", 0, None)
    while True:
        try:
            kind, *content = channel.recv() if channel.poll(LOOK_S) else ("nothing",)
        except (EOFError, ConnectionResetError):
            return None
        match kind:
            case "done":
                return content[0], content[1]
            case "refused":
                raise content[0] from content[1]
            case "log":
                logging.getLogger(content[0]).log(content[1], "%s", content[2])
            case "progress":
                step = content[0]
        progress.tell(*step)  # the listener may raise
        if time.monotonic() > end_s:
            raise InputError(source, "", f"was not loaded within {seconds:g} s")


def _mapped(memory: int, sizes: list[int]) -> list[memoryview | bytearray]:
    """Return the arrays in shared memory, mapped copy-on-write.

    Small arrays are copied, because keeping a small array would otherwise keep the whole mapping alive.
    """
    total = sum(map(_room, sizes))
    whole = memoryview(mmap.mmap(memory, total, flags=mmap.MAP_PRIVATE) if total else b"")
    ends = [sum(map(_room, sizes[: number + 1])) for number in range(len(sizes))]
    views = [whole[end - _room(size) :][:size] for end, size in zip(ends, sizes, strict=True)]
    return [bytearray(view) if view.nbytes < SMALL else view for view in views]


def _room(size: int) -> int:
    return -(-size // ALIGNED) * ALIGNED


class _Forwarded(logging.Handler):
    """Handler that sends the child's log records to the parent process."""

    def __init__(self, channel: Connection) -> None:
        super().__init__()
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        self._channel.send(("log", record.name, record.levelno, record.getMessage()))


def main(channel: Connection, memory: int) -> None:
    """Run the child process: set the limits, do the work and send the result or the error.

    Args:
        channel: Connection to the parent.
        memory: File descriptor of the shared memory for the result's arrays.
    """
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # end when the parent ends
    work, args, source, limits, (memory_bytes, seconds) = channel.recv()
    for name, limit in limits.items():
        setattr(LIMITS, name, limit)
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
    logging.getLogger().addHandler(_Forwarded(channel))
    logging.getLogger().setLevel(logging.INFO)
    try:
        with progress.listening(lambda *step: channel.send(("progress", step))):
            result = work(*args)
        sizes: list[int] = []

        def keep(buffer: pickle.PickleBuffer) -> None:
            raw = buffer.raw()
            os.lseek(memory, sum(map(_room, sizes)), os.SEEK_SET)
            sizes.append(raw.nbytes)
            while raw.nbytes:
                raw = raw[os.write(memory, raw) :]

        data = pickle.dumps(result, protocol=5, buffer_callback=keep)
        os.ftruncate(memory, sum(map(_room, sizes)))
        channel.send(("done", data, sizes))
    except MemoryError:
        os._exit(1)
    except PhasestackError as error:
        channel.send(("refused", error, _passing(error)))
    except Exception as error:
        if missing := missing_extra(error):
            channel.send(("refused", missing, None))
            return
        problem = one_line(f"cannot be read: {type(error).__name__}: {error}")
        channel.send(("refused", InputError(source, "", problem), None))


def _passing(error: BaseException | None) -> OSError | None:
    """Return the transient system error that caused a project error, for `is_retryable`, or None.

    If the cause is a MemoryError, the process has reached its memory limit, so it ends.
    """
    while error is not None:
        if isinstance(error, MemoryError):
            os._exit(1)
        if isinstance(error, OSError) and error.errno in PASSING - {errno.ENOMEM}:
            return OSError(error.errno, error.strerror)
        error = error.__cause__ or error.__context__
    return None


if __name__ == "__main__":
    main(Connection(int(sys.argv[1])), int(sys.argv[2]))
    os._exit(0)
