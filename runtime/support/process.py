"""Run a part of the program in a process that is watched, killed if it hangs, and restarted.

`Worker` is the parent's side, `Parent` the worker's. A worker is a fresh interpreter that ends with its parent. It says
how long its next work may take (`Parent.allow`). If it takes longer, needs too much memory or crashes, it is killed
and started again, and the parent only learns why.
"""

from __future__ import annotations

import contextlib
import faulthandler
import json
import logging
import mmap
import os
import pickle
import resource
import select
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from runtime.clock import NS_PER_S
from runtime.errors import FatalError, PhasestackError, TransientError, one_line
from runtime.support.background import begin, patience_s
from runtime.support.channel import Channel, ChannelClosed, shared_memory
from runtime.support.crash import report_of, written
from runtime.support.interpreter import end_with_parent, log_forwarded, passing_cause, started, take_over
from runtime.support.untrusted_input import LIMITS, MIB

log = logging.getLogger("phasestack.processes")

LOOK_S = 0.1  # interval for checking a worker's time limit and memory
STOPPED_S = 1.0  # if this process was stopped for longer, its workers get time to catch up
WELL_S = 1.0  # a worker that was ready for longer was well, so the next one is started without a delay
AGAIN_S, AGAIN_MAX_S = 0.25, 5.0  # delay before a worker that was never well is started again; doubles each time
ENDS_S = 0.5  # how long a worker gets to end by itself when the run ends
SENT_S = 0.25  # how long a worker waits for its parent to read, before it renews its time limit
TRACE_BYTES = 1 << 16  # most bytes of a crashed worker's stack that are kept
DEADLINE, READY, READ = 0, 1, 2  # indices into the words shared by a worker and its parent


@dataclass(frozen=True, slots=True)
class Role:
    """Work of a worker process, and its limits."""

    name: str  # name in messages, such as `solver`
    main: Callable[..., None]  # called in the worker with its `Parent` and the arguments; at the top level of a module
    niceness: int = 0
    memory_bytes: int = 0  # limit for the worker's own memory; 0: none
    oom_score: int = 500  # raises the kernel's readiness to end this process if memory runs out
    start_s: float = 60.0  # time limit until the worker is ready


@dataclass(frozen=True, slots=True)
class Began:
    """A new worker has been started. All later messages are from it."""

    number: int  # counted from 1


@dataclass(frozen=True, slots=True)
class Ended:
    """A worker has ended. All of its messages have been returned."""

    reason: str


class _Life:
    """One process of a worker, from its start to its end."""

    def __init__(self, number: int, role: Role, arguments: tuple[Any, ...], files: Sequence[int]) -> None:
        """Start the process. Raises OSError if the system cannot."""
        self.number, self.reason = number, ""  # the reason is set before the process is killed
        self.ended: str | None = None  # why it has ended; None while it runs
        self.error: BaseException | None = None  # the exception that ended it
        self.ready_s: float | None = None
        with contextlib.ExitStack() as undo, contextlib.ExitStack() as theirs:
            self.channel, channel = _pair(undo, theirs)
            self.notes, notes = _pair(undo, theirs)
            words, self._trace = shared_memory("words", mmap.PAGESIZE), os.memfd_create("trace")
            theirs.callback(os.close, words)
            undo.callback(os.close, self._trace)
            self.words = memoryview(mmap.mmap(words, mmap.PAGESIZE)).cast("q")
            self.words[DEADLINE] = time.monotonic_ns() + round(role.start_s * NS_PER_S)
            inherited = (channel.fileno(), notes.fileno(), words, self._trace)
            argument = json.dumps([os.getpid(), *inherited])
            # This process's own output may be read by a program.
            self.process = started(__name__, argument, files=(*inherited, *files), output=2)
            undo.callback(self.process.kill)
            self.descriptor = os.pidfd_open(self.process.pid)
            with contextlib.suppress(ChannelClosed):  # it has already ended
                self.channel.send((role, arguments, asdict(LIMITS)))
            undo.pop_all()

    def is_alive(self) -> bool:
        return self.ended is None

    def kill(self, reason: str) -> None:
        """Kill the process, if it has not ended."""
        self.reason = self.reason or reason
        self.process.kill()

    def trace(self) -> str:
        """Return the stacks of the process's threads, which a crash has left."""
        return os.pread(self._trace, TRACE_BYTES, 0).decode(errors="replace")

    def close(self) -> None:
        """Release all descriptors except the channel, whose messages may still be read."""
        self.notes.close()
        os.close(self.descriptor)
        os.close(self._trace)


def _pair(undo: contextlib.ExitStack, theirs: contextlib.ExitStack) -> tuple[Channel, Channel]:
    ours, other = Channel.pair()
    undo.callback(ours.close)
    theirs.callback(other.close)
    return ours, other


class Worker:
    """A part of the program that runs in its own process. All methods are for one thread, such as the
    presenter's, and none of them waits, except `wait_ready`, `close`, and `receive` if asked to. A thread of this
    object's own starts, watches and restarts the process. It also passes on its log lines.
    """

    def __init__(self, role: Role, arguments: Callable[[], tuple[Any, ...]], *, files: Sequence[int] = ()) -> None:
        """Start the process, which inherits file descriptors under the same numbers. `arguments` are created for each
        new process, on this object's thread. Raises TransientError without a thread.
        """
        self.role, self._arguments, self._files = role, arguments, tuple(files)
        self._lives: deque[_Life] = deque()  # oldest first; the oldest may have ended, with messages still to be read
        self._begun = 0  # number of the process whose messages are being read
        self._newest: _Life | None = None
        self._closing, self._ready = threading.Event(), threading.Event()
        self._last_reason = ""  # why the last process ended
        self.error: BaseException | None = None  # why the first process was never ready
        self.restarts = 0
        self._keeper = begin(f"{role.name}'s keeper", self._keep)

    def wait_ready(self, go_on: Callable[[], bool] = lambda: True) -> None:
        """Wait until the first process is ready or `go_on` returns False. Raises the error that ended it."""
        while not self._ready.wait(LOOK_S) and go_on():
            pass
        if self.error is not None:
            raise self.error

    @property
    def is_ready(self) -> bool:
        """True while a process is ready for messages."""
        life = self._newest
        return life is not None and life.is_alive() and life.words[READY] != 0

    @property
    def fault(self) -> str:
        """Why no process is ready, or an empty string."""
        return "" if self.is_ready else f"{self._last_reason or f'the {self.role.name} is starting'}"

    @property
    def descriptor(self) -> int | None:
        """File descriptor that is readable when `receive` has messages, or None while there is no process."""
        return self._lives[0].channel.fileno() if self._lives else None

    def send(self, message: Any) -> bool:
        """Send a message. Return False if the process is not ready or has too many messages unread."""
        life = self._newest
        if life is None or not self.is_ready:
            return False
        try:
            return life.channel.send(message)
        except ChannelClosed:
            return False

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """Return all messages that have arrived, and `Began` and `Ended` for each process. Waits up to
        `timeout_s` for one.
        """
        messages: list[Any] = []
        while self._lives:
            life = self._lives[0]
            if self._begun != life.number:
                self._begun = life.number
                messages.append(Began(life.number))
            ended = life.ended  # read before the channel, because no message arrives after it
            with contextlib.suppress(ChannelClosed):
                arrived = life.channel.receive(0.0 if messages else timeout_s)
                life.words[READ] += len(arrived)
                messages += arrived
            if ended is None:
                break
            messages.append(Ended(ended))
            life.channel.close()
            self._lives.popleft()
        return messages

    def restart(self, reason: str) -> None:
        """Kill the process, so that another one is started. A reason is `has lost its OpenGL context`."""
        if self._newest is not None and self._newest.is_alive():
            self._newest.kill(f"the {self.role.name} {reason}")

    def status(self) -> dict[str, Any]:
        """Return the process and its resources, for the status (docs/contracts.md). For any thread."""
        life = self._newest
        pid = life.process.pid if life is not None and life.is_alive() else None
        return {"role": self.role.name, "restarts": self.restarts, **usage(pid)}

    def close(self) -> None:
        """End the process. May be called more than once."""
        self._closing.set()
        for life in tuple(self._lives):
            with contextlib.suppress(OSError):
                life.channel.close()  # the process ends by itself
        self._keeper.join(patience_s(2 * ENDS_S))
        if self._newest is not None:
            self._newest.process.kill()

    # All methods below run on this object's own thread. It must live as long as the process, because the kernel ends
    # the process with the thread that has started it.

    def _keep(self) -> None:
        delay_s, number = 0.0, 0
        while not self._closing.wait(delay_s):
            number += 1
            try:
                life = _Life(number, self.role, self._arguments(), self._files)
            except OSError as error:
                self._last_reason = f"the {self.role.name} cannot be started: {error.strerror}"
                if not self._ready.is_set():
                    self.error = TransientError(self._last_reason)
                    self._ready.set()
                    return
                delay_s = min(max(AGAIN_S, 2 * delay_s), AGAIN_MAX_S)
                continue
            self._newest = life
            self._lives.append(life)
            self._watch(life)
            reason = self._outcome(life)
            self._last_reason = f"{reason}; it is being restarted"
            if not self._ready.is_set() or self._closing.is_set():
                self.error = life.error or TransientError(reason)
                life.ended = reason
                life.close()
                self._ready.set()
                return
            life.ended = reason
            self.restarts += 1
            self._report(life, reason)
            was_well = life.ready_s is not None and time.monotonic() - life.ready_s > WELL_S
            delay_s = 0.0 if was_well else min(max(AGAIN_S, 2 * delay_s), AGAIN_MAX_S)
            life.close()

    def _watch(self, life: _Life) -> None:
        """Wait for the process to end, and kill it if it takes too long or too much memory."""
        poll = select.poll()
        poll.register(life.descriptor, select.POLLIN)
        poll.register(life.notes, select.POLLIN)
        looked_s, from_s, ends_s = time.monotonic(), 0.0, float("inf")
        while True:
            events = dict(poll.poll(1e3 * LOOK_S))
            if life.notes.fileno() in events and not self._listen(life):
                poll.unregister(life.notes)
            if life.descriptor in events:
                self._listen(life)
                life.process.wait()
                return
            now_s = time.monotonic()
            if life.ready_s is None and life.words[READY]:
                life.ready_s = now_s
                self._ready.set()
            if self._closing.is_set():
                ends_s = min(ends_s, now_s + ENDS_S)
                if now_s > ends_s:
                    life.kill("")
                continue
            if now_s - looked_s > STOPPED_S:  # this process was stopped, and with it perhaps the worker
                from_s = now_s + STOPPED_S
            looked_s = now_s
            late_s = now_s - life.words[DEADLINE] / NS_PER_S
            if late_s > 0 and now_s > from_s:
                life.kill(f"the {self.role.name} has not answered in time")
            elif self.role.memory_bytes and own_bytes(life.process.pid) > self.role.memory_bytes:
                life.kill(f"the {self.role.name} was ended by the memory limit ({self.role.memory_bytes // MIB} MiB)")

    def _listen(self, life: _Life) -> bool:
        """Pass on log lines and take in the error that ends the process. Return False if there will be no more."""
        try:
            notes = life.notes.receive()
        except ChannelClosed:
            return False
        for kind, content in notes:
            if kind == "log":
                log_forwarded(content)
            else:
                life.error, cause = content
                life.error.__cause__ = cause
        return True

    def _outcome(self, life: _Life) -> str:
        """Return why a process has ended."""
        code, role = life.process.returncode, self.role.name
        if life.reason:
            return life.reason
        if life.error is not None:
            return f"the {role} failed: {one_line(str(life.error) or type(life.error).__name__)}"
        if code < 0:
            return f"the {role} was ended by {_signal_name(-code)}"
        return f"the {role} ended with exit status {code}"

    def _report(self, life: _Life, reason: str) -> None:
        trace = life.trace()
        if trace and life.process.returncode != -signal.SIGKILL:
            reason = f"{reason}; {report_of(reason, trace)}"
        log.error("%s; starting another", reason)


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def own_bytes(pid: int) -> int:
    """Return the memory that only a process itself uses, in bytes, or 0 if it has ended."""
    try:
        pages = Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()
    except OSError:
        return 0
    return (int(pages[1]) - int(pages[2])) * mmap.PAGESIZE


def usage(pid: int | None) -> dict[str, Any]:
    """Return a process's `pid`, `memory_mib` (with its part of shared memory, Pss) and `cpu_s`, or None."""
    memory_mib = cpu_s = None
    if pid is not None:
        with contextlib.suppress(OSError, ValueError, IndexError):
            rollup = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii")
            memory_mib = round(
                next(int(line.split()[1]) for line in rollup.splitlines() if line.startswith("Pss:")) / 1024, 1
            )
            times = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace").rpartition(")")[2].split()
            cpu_s = round((int(times[11]) + int(times[12])) / os.sysconf("SC_CLK_TCK"), 2)
    return {"pid": pid, "memory_mib": memory_mib, "cpu_s": cpu_s}


class Parent:
    """The parent process, as its worker sees it. For the worker's main thread."""

    def __init__(self, channel: Channel, words: memoryview) -> None:
        self._channel, self._words = channel, words
        self._allowed_s, self._sent = 0.0, 0

    def allow(self, seconds: float) -> None:
        """Renew the time limit: unless this method is called again before it is over, this process is killed."""
        self._allowed_s = seconds
        self._words[DEADLINE] = time.monotonic_ns() + round(seconds * NS_PER_S)

    def ready(self) -> None:
        """Report to the parent that this process is ready for messages."""
        self._words[READY] = 1

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """Return all messages that have arrived, oldest first, or wait for one. Raises ChannelClosed."""
        return self._channel.receive(timeout_s)

    def send(self, message: Any) -> None:
        """Send a message, if need be waiting, which does not count as hanging. Raises ChannelClosed."""
        while not self._channel.send(message, timeout_s=SENT_S):
            self.allow(self._allowed_s)
        self._sent += 1

    def offer(self, message: Any) -> bool:
        """Send a message without waiting. Return False if the parent has too many messages unread. Raises
        ChannelClosed if the parent has closed the channel.
        """
        is_sent = self._channel.send(message)
        self._sent += is_sent
        return is_sent

    @property
    def unread(self) -> int:
        """Number of messages that the parent has not read."""
        return self._sent - self._words[READ]


def main(parent: int, channel: int, notes: int, words: int, trace: int) -> int:
    """Run a worker's process, and return its exit status. Arguments: the parent's number, and descriptors
    of the channel, of log lines and errors, of words shared with the parent, and for the stacks left by a crash.
    """
    end_with_parent()
    if os.getppid() != parent:  # it has ended already
        return 1
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # sent to the whole group; the parent decides
        signal.signal(number, signal.SIG_IGN)
    faulthandler.enable(trace, all_threads=True)
    notes_to_parent = Channel.of(notes)
    shared = memoryview(mmap.mmap(words, mmap.PAGESIZE)).cast("q")
    os.close(words)
    link = Channel.of(channel)
    (first,) = link.receive(60.0) or [None]
    if first is None:
        return 1
    role, arguments, limits = first
    _limit(role)
    take_over(limits, lambda record: notes_to_parent.send(("log", record)))  # if the parent reads slowly, drop it
    try:
        role.main(Parent(link, shared), *arguments)
    except ChannelClosed:
        return 0
    except BaseException as error:
        _say_why(notes_to_parent, error)
        return 1
    return 0


def _limit(role: Role) -> None:
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, role.niceness)
    with contextlib.suppress(OSError, ValueError):
        score = Path("/proc/self/oom_score_adj")
        score.write_text(str(min(1000, int(score.read_text()) + role.oom_score)))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    if role.memory_bytes:  # a backstop: the parent looks only ten times a second
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        most = 2 * role.memory_bytes if hard == resource.RLIM_INFINITY else min(2 * role.memory_bytes, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (most, hard))


def _say_why(notes: Channel, error: BaseException) -> None:
    """Report the error that ends this process to the parent. An unexpected one is also written to a file."""
    cause = passing_cause(error)
    if not isinstance(error, PhasestackError | SystemExit | MemoryError):
        error = FatalError(written(error))
    error = error.with_traceback(None)
    with contextlib.suppress(ChannelClosed, TypeError, AttributeError, pickle.PicklingError):
        notes.send(("failed", (error, cause)), timeout_s=1.0)


if __name__ == "__main__":
    status = main(*json.loads(sys.argv[1]))
    os._exit(status)
