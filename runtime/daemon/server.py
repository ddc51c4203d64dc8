"""Status and control socket: JSON lines over a local socket of mode 0660, on its own thread."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import grp
import json
import logging
import os
import queue
import select
import socket
import stat
import struct
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from runtime.clock import NS_PER_S, Clock
from runtime.config import ServiceSettings
from runtime.daemon.client import DEFAULT_SOCKET, LOADED_WITHIN_S, user_socket
from runtime.daemon.commands import Command, parse
from runtime.daemon.listener import LIMITED, Listener, Refusal
from runtime.errors import InputError, TransientError, without_secrets
from runtime.support.artifacts import to_json

log = logging.getLogger("phasestack.service")

GROUP = "phasestack"  # members may use the socket
LOOP_ANSWERS_WITHIN_S = 5.0  # a command not begun by then is refused
LOOKED_AGAIN_S = 0.1  # between checks whether the client is still connected
LOCKED_WITHIN_S = 2.0  # to wait for the folder's lock, which is only held briefly


class SocketInUse(TransientError):
    """Another phasestack owns the socket; the text names it."""


class StatusServer(Listener):
    """Answers `status` from the last published snapshot, and queues commands for the loop.

    The presenter's loop calls `publish` and takes `commands`, and never waits for a client. `status` also answers when
    the loop hangs, and gives the age of its last turn.
    """

    def __init__(self, path: Path, *, clock: Clock) -> None:
        """Raises SocketInUse if a running daemon owns the socket, InputError if it cannot be created."""
        self.path = path
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self.lookups: dict[str, Callable[[], dict[str, Any]]] = {}  # called on the server's thread
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._snapshot: tuple[int, Callable[[], dict[str, Any]]] = (self._started_ns, dict)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with _locked(path.parent):
                _check_dead(path)
                # By the mask, not by chmod: the mode must be right from the first moment.
                mask = os.umask(0o117)
                try:
                    super().__init__("status", lambda serve: asyncio.start_unix_server(serve, path, **LIMITED))
                finally:
                    os.umask(mask)
                self._own = path.lstat().st_ino
        except OSError as error:
            raise InputError("service", "socket", f"{path} cannot be created ({error.strerror or error})") from error
        try:
            group = grp.getgrnam(GROUP).gr_gid
            if path.lstat().st_gid != group:  # a service's sandbox may refuse even a chown without effect
                os.chown(path, -1, group)
        except (KeyError, PermissionError):
            log.info("only this user can use the status socket: no group %s, or not a member", GROUP)
        self.start()

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """Replace the snapshot, once a turn; called on the server's thread when a client asks.

        A callable, so that a turn without clients costs nothing: it must only read values that no longer change.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Answer pending requests, stop, and remove the socket. May be called twice."""
        if self._thread is None:
            return
        super().close()
        with contextlib.suppress(OSError):
            if self.path.lstat().st_ino == self._own:  # otherwise it is another daemon's
                self.path.unlink()

    def answer(self, line: bytes) -> dict[str, Any] | Command:
        """Return the answer to a request, or a command for the loop."""
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return {"ok": False, "error": "a request is one JSON object on one line"}
        name = request.get("command") if isinstance(request, dict) else None
        if name == "status":
            return self._status()
        if isinstance(name, str) and name in self.lookups:
            return {"ok": True, **self.lookups[name]()}
        try:
            return parse(request)
        except ValueError as error:
            return {"ok": False, "error": str(error)}

    def _status(self) -> dict[str, Any]:
        published_ns, snapshot = self._snapshot
        now_ns = self._clock.now_ns()
        return {
            "ok": True,
            "pid": os.getpid(),
            "uptime_s": (now_ns - self._started_ns) / NS_PER_S,
            "turn_age_s": (now_ns - published_ns) / NS_PER_S,
            **snapshot(),
        }

    # On the server's thread.

    async def converse(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Answer requests until the client disconnects."""
        while line := await self.request(reader, b"\n"):
            await self.send(writer, await self._reply(line, writer))

    def refuse(self, writer: StreamWriter, why: str) -> None:
        writer.write(_line({"ok": False, "error": why}))

    async def _reply(self, line: bytes, writer: StreamWriter) -> bytes:
        try:
            answer = self.answer(line)
        except Exception:
            log.exception("request failed")
            answer = {"ok": False, "error": "the request failed: see the log"}
        if isinstance(answer, Command):
            if _is_gone(writer):
                raise Refusal("nothing was done")
            log.info("command: %s", answer.name if answer.value is None else f"{answer.name} {answer.value}")
            self.commands.put(answer)
            answer = await _outcome(answer, writer)
        return _line(answer)


def _line(answer: dict[str, Any]) -> bytes:
    return without_secrets(to_json(answer)).encode() + b"\n"


def _is_gone(writer: StreamWriter) -> bool:
    """True if a client has disconnected, and not only stopped sending."""
    if writer.is_closing():
        return True
    hung_up = select.poll()
    hung_up.register(writer.get_extra_info("socket"), 0)
    return bool(hung_up.poll(0))


async def _outcome(command: Command, writer: StreamWriter) -> dict[str, Any]:
    """Wait for a command's outcome; cancel it if it does not begin in time, or the client is gone."""
    answer = asyncio.wrap_future(command.answer)
    until_s = time.monotonic() + LOOP_ANSWERS_WITHIN_S
    try:
        done: set[Any] = set()
        while not done and time.monotonic() < until_s and not _is_gone(writer):
            done, _ = await asyncio.wait({answer}, timeout=min(LOOKED_AGAIN_S, LOOP_ANSWERS_WITHIN_S))
        if not done and command.answer.cancel():
            problem = f"no answer from the display loop within {LOOP_ANSWERS_WITHIN_S:g} s: nothing was done"
            return {"ok": False, "error": problem}
        done, _ = await asyncio.wait({answer}, timeout=LOADED_WITHIN_S)
    except asyncio.CancelledError as stops:
        raise Refusal(stops.args[0] + (": nothing was done" if command.answer.cancel() else "")) from None
    if done:
        return answer.result()
    return {"ok": True, "note": f"still loading after {LOADED_WITHIN_S:g} s: see `phasestack status`"}


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder, so that one daemon at a time replaces a dead socket."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until_s = time.monotonic() + LOCKED_WITHIN_S
        while time.monotonic() < until_s:  # another program may never release it
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(0.01)
        yield
    finally:
        os.close(opened)


def _check_dead(path: Path) -> None:
    """Raise InputError if the path is not a socket, SocketInUse if a daemon listens on it."""
    if not os.path.lexists(path):
        return
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise InputError("service", "socket", f"{path} exists and is not a socket")
    owner = ""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            return
        except BlockingIOError:
            pass  # its backlog is full
        else:
            pid, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            owner = f" (pid {pid})"
    raise SocketInUse(f"service: socket: {path} is in use by another phasestack{owner}")


def open_status_server(settings: ServiceSettings, *, clock: Clock, supervised: bool) -> StatusServer | None:
    """Open the configured socket; in a user's session without permission, the user's own.

    Under a supervisor, raises SocketInUse if another phasestack owns it, InputError if it cannot be created. A run by
    hand logs a warning and continues without one.
    """
    path = Path(settings.socket)
    own = user_socket()
    if own is not None and path == Path(DEFAULT_SOCKET) and not _may_write(path.parent):
        path = own
    try:
        return StatusServer(path, clock=clock)
    except (InputError, SocketInUse) as error:
        if supervised:
            raise
        log.warning("no status socket: %s", error)
        return None


def _may_write(folder: Path) -> bool:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    return os.access(existing, os.W_OK)
