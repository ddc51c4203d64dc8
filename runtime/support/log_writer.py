"""Lines to a descriptor, written by a thread of their own: who logs never waits for who reads."""

from __future__ import annotations

import os
import queue
import select
import threading
import time
from collections.abc import Callable

from runtime.support.priority import BACKGROUND_NICENESS, set_niceness

QUEUED_MAX = 4096  # lines that wait for a reader
LINE_MAX_BYTES = 16384  # a longer line is cut
PIECE_BYTES = select.PIPE_BUF  # a pipe that is ready takes so much without waiting
LOOK_MS = 100  # between two looks whether to stop, while the reader takes nothing


class LogWriter:
    """Where nobody reads, the disk is full or the descriptor is closed, lines are dropped and counted."""

    def __init__(self, descriptor: int, *, told: Callable[[int], bytes]) -> None:
        """descriptor: duplicated, -1: there is none; told: the line that says how many lines were lost."""
        self._told = told
        self._queue: queue.Queue[bytes | Callable[[], bytes] | None] = queue.Queue(QUEUED_MAX)
        self._lock = threading.Lock()
        self._untold = 0
        self._cut_off = False  # a line was left half written
        self._give_up_s = float("inf")  # on the machine's clock: after this nothing is waited for
        self.lost = 0
        try:
            self._descriptor = os.dup(descriptor)
        except OSError:
            self._descriptor = -1
        self._thread = threading.Thread(target=self._run, name="log", daemon=True)
        self._thread.start()

    def put(self, line: bytes | Callable[[], bytes]) -> None:
        """One line, with its line break, or what makes it on the writer's thread. Never waits."""
        try:
            if self._thread.is_alive():
                self._queue.put_nowait(line)
                return
        except queue.Full:
            pass
        self._lose()

    def flush(self, timeout_s: float) -> bool:
        """Wait until everything so far is written or lost; False where that takes longer."""
        deadline_s = time.monotonic() + timeout_s
        while self._queue.unfinished_tasks and self._thread.is_alive():
            if time.monotonic() >= deadline_s:
                return False
            time.sleep(0.005)
        return True

    def close(self, timeout_s: float) -> None:
        """Write what waits, for so long at most; then stop. May be called twice."""
        if self._give_up_s == float("inf"):
            self._give_up_s = time.monotonic() + timeout_s
            self.flush(timeout_s)
            try:
                self._queue.put_nowait(None)
            except queue.Full:
                return  # the thread sees that it is time to give up
            self._thread.join(timeout_s)

    def _run(self) -> None:
        set_niceness(BACKGROUND_NICENESS)
        while True:
            line = self._queue.get()
            if line is not None:
                self._take(line if isinstance(line, bytes) else line())
            self._queue.task_done()
            if line is None or (time.monotonic() > self._give_up_s and self._queue.empty()):
                break
        if self._descriptor >= 0:
            os.close(self._descriptor)

    def _take(self, line: bytes) -> None:
        if len(line) > LINE_MAX_BYTES:
            line = line[: LINE_MAX_BYTES - 5] + b" ...\n"
        if not self._written(line):
            self._lose()
        elif self._untold and self._queue.empty():
            with self._lock:
                count, self._untold = self._untold, 0
            if not self._written(self._told(count)):
                with self._lock:
                    self._untold += count

    def _lose(self) -> None:
        with self._lock:
            self.lost += 1
            self._untold += 1

    def _written(self, line: bytes) -> bool:
        """False where the line, or the rest of it, can't be written."""
        if self._descriptor < 0:
            return False
        data = (b"\n" if self._cut_off else b"") + line
        whole = len(data)
        poll = select.poll()
        poll.register(self._descriptor, select.POLLOUT)
        while data and time.monotonic() <= self._give_up_s:
            try:
                if poll.poll(LOOK_MS):
                    data = data[os.write(self._descriptor, data[:PIECE_BYTES]) :]
            except BlockingIOError:
                time.sleep(LOOK_MS / 1000)
            except OSError:
                break
        self._cut_off = self._cut_off if len(data) == whole else bool(data)
        return not data
