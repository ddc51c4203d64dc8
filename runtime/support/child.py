"""Work on untrusted files in a process of its own, limited in memory and time, that can be killed.

Parsers hold Python's lock, and a small file may make them take all memory. The arrays of a result come back in memory
that both processes have mapped; progress, warnings and refusals are as if the work had been done here.
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

MEMORY_MAX = 4 << 30  # of data; what a scene at every limit takes
LOOK_S = 0.05  # between two looks at whether it is still wanted
ALIGNED = 64  # bytes, of an array's place
PR_SET_PDEATHSIG = 1  # prctl.h of Linux
SMALL = 1 << 16  # bytes of an array that is copied
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), "1")
T = TypeVar("T")


def in_child(
    work: Callable[..., T], *given: Any, source: str | Path, seconds: float, memory_bytes: int | None = None
) -> T:
    """What `work`, a function of a module, answers to `given`.

    memory_bytes: that it may take; None: `MEMORY_MAX`. It is ended where the progress's listener raises. Raises what
    `work` raises on purpose; InputError, naming `source`, where it is over a limit, fails or ends the process;
    TransientError where no process can be started.
    """
    memory_bytes = memory_bytes or MEMORY_MAX
    ours, theirs = Pipe()
    memory = os.memfd_create("result")
    command = [sys.executable, "-P", "-m", __name__, str(theirs.fileno()), str(memory)]
    places = os.pathsep.join([str(Path(__file__).parents[2]), *filter(None, sys.path)])  # ours before a namesake
    environment = os.environ | ONE_THREAD | {"PYTHONPATH": places}
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
        raise TransientError(f"{source}: no process can be started for it ({error.strerror})") from error
    finally:
        theirs.close()
    with child, ours:
        try:
            with suppress(BrokenPipeError):
                ours.send((work, given, str(source), asdict(LIMITS), (memory_bytes, seconds)))
            result = _outcome(ours, str(source), seconds)
            if result is None:
                why = f"takes more than {memory_bytes // MIB} MiB, or ends the process that reads it ({child.wait()})"
                raise InputError(source, "", why)
            return pickle.loads(result[0], buffers=_mapped(memory, result[1]))  # type: ignore[no-any-return]
        finally:
            child.kill()
            os.close(memory)


def _outcome(channel: Connection, source: str, seconds: float) -> tuple[bytes, list[int]] | None:
    """A result's pickle and the sizes of its arrays; None where the child has ended without one."""
    end_s, told = time.monotonic() + seconds, (f"reading {Path(source).name}", 0, None)
    while True:
        try:
            kind, *said = channel.recv() if channel.poll(LOOK_S) else ("nothing",)
        except (EOFError, ConnectionResetError):
            return None
        match kind:
            case "done":
                return said[0], said[1]
            case "refused":
                raise said[0] from said[1]
            case "log":
                logging.getLogger(said[0]).log(said[1], "%s", said[2])
            case "progress":
                told = said[0]
        progress.tell(*told)  # who listens may raise
        if time.monotonic() > end_s:
            raise InputError(source, "", f"is not ready after {seconds:g} s")


def _mapped(memory: int, sizes: list[int]) -> list[memoryview | bytearray]:
    """The arrays, one after the other; written to, they are copied; a small one holds nothing else."""
    total = sum(map(_room, sizes))
    whole = memoryview(mmap.mmap(memory, total, flags=mmap.MAP_PRIVATE) if total else b"")
    ends = [sum(map(_room, sizes[: number + 1])) for number in range(len(sizes))]
    views = [whole[end - _room(size) :][:size] for end, size in zip(ends, sizes, strict=True)]
    return [bytearray(view) if view.nbytes < SMALL else view for view in views]


def _room(size: int) -> int:
    return -(-size // ALIGNED) * ALIGNED


class _Forwarded(logging.Handler):
    """Records go to the process that waits."""

    def __init__(self, channel: Connection) -> None:
        super().__init__()
        self._channel = channel

    def emit(self, record: logging.LogRecord) -> None:
        self._channel.send(("log", record.name, record.levelno, record.getMessage()))


def main(channel: Connection, memory: int) -> None:
    """Entry point of the child process."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)  # nobody waits for a child whose parent was killed
    work, given, source, limits, (memory_bytes, seconds) = channel.recv()
    for name, limit in limits.items():
        setattr(LIMITS, name, limit)
    processor_s = (os.cpu_count() or 1) * int(seconds) + 10  # where nobody is left to kill it
    for kind, most in (
        (resource.RLIMIT_DATA, memory_bytes),
        (resource.RLIMIT_CPU, processor_s),
        (resource.RLIMIT_CORE, 0),
    ):
        held = resource.getrlimit(kind)[1]  # by whoever began it, another child at times
        most = most if held == resource.RLIM_INFINITY else min(most, held)
        resource.setrlimit(kind, (most, most))
    with suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    logging.getLogger().addHandler(_Forwarded(channel))
    logging.getLogger().setLevel(logging.INFO)
    try:
        with progress.listening(lambda *told: channel.send(("progress", told))):
            result = work(*given)
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
        problem = one_line(f"cannot be read ({type(error).__name__}: {error})")
        channel.send(("refused", InputError(source, "", problem), None))


def _passing(error: BaseException | None) -> OSError | None:
    """The machine's trouble of the moment behind a refusal, as `is_retryable` looks for it.

    Ends the process for want of memory: that is its own limit.
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
