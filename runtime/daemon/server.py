"""The status and control socket: JSON lines over a local socket of mode 0660, on its own thread."""

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

GROUP = "phasestack"  # that may use the socket
LOOP_ANSWERS_WITHIN_S = 5.0  # a command that the loop has not begun by then is refused
LOOKED_AGAIN_S = 0.1  # between checks whether the client is still connected
ALONE_WITHIN_S = 2.0  # the folder's lock is waited for: nobody holds it longer who takes a socket over


class SocketInUse(TransientError):
    """Another phasestack has the socket; the text says which."""


class StatusServer(Listener):
    """Answers `status` from the last published snapshot, and hands everything else to the loop.

    The loop publishes (`publish`) and drains (`commands`); it never waits for a client. Where the loop hangs,
    `status` still answers, and says for how long no turn was completed.
    """

    def __init__(self, path: Path, *, clock: Clock) -> None:
        """Raises SocketInUse where the socket belongs to a running daemon, InputError where it can't be made."""
        self.path = path
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self.lookups: dict[str, Callable[[], dict[str, Any]]] = {}  # answered at once, on the server's thread
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._snapshot: tuple[int, Callable[[], dict[str, Any]]] = (self._started_ns, dict)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with _alone_in(path.parent):
                _check_dead(path)
                # The mode must hold from the first moment, so it is the mask that makes it, not a later chmod.
                mask = os.umask(0o117)
                try:
                    super().__init__("status", lambda serve: asyncio.start_unix_server(serve, path, **LIMITED))
                finally:
                    os.umask(mask)
                self._own = path.lstat().st_ino
        except OSError as error:
            raise InputError("service", "socket", f"{path} can't be made ({error.strerror or error})") from error
        try:
            wanted = grp.getgrnam(GROUP).gr_gid
            if path.lstat().st_gid != wanted:  # a service's sandbox may refuse even what changes nothing
                os.chown(path, -1, wanted)
        except (KeyError, PermissionError):
            log.info("the status socket is this user's alone: group %s is not there or not ours", GROUP)
        self.start()

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """The newest account of the loop, once a turn; called (if ever) on the server's thread.

        A callable, so that a turn costs nothing where nobody asks: it must only read what no longer changes.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Answer what waits, stop, and remove the socket. May be called twice."""
        if self._thread is None:
            return
        super().close()
        with contextlib.suppress(OSError):
            if self.path.lstat().st_ino == self._own:  # where it was deleted, another daemon's may be there
                self.path.unlink()

    def answer(self, line: bytes) -> dict[str, Any] | Command:
        """The answer to a request (`ok`; `error` says why not), or a command for the loop."""
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
        """As many requests as the client likes."""
        while line := await self.request(reader, b"\n"):
            await self.send(writer, await self._reply(line, writer))

    def refuse(self, writer: StreamWriter, why: str) -> None:
        writer.write(_line({"ok": False, "error": why}))

    async def _reply(self, line: bytes, writer: StreamWriter) -> bytes:
        try:
            answer = self.answer(line)
        except Exception:
            log.exception("a request could not be answered")
            answer = {"ok": False, "error": "the request could not be answered: see the log"}
        if isinstance(answer, Command):
            if _is_gone(writer):
                raise Refusal("nothing was done")
            log.info("asked for: %s", answer.name if answer.value is None else f"{answer.name} {answer.value}")
            self.commands.put(answer)
            answer = await _outcome(answer, writer)
        return _line(answer)


def _line(answer: dict[str, Any]) -> bytes:
    return without_secrets(to_json(answer)).encode() + b"\n"


def _is_gone(writer: StreamWriter) -> bool:
    """Whether a client has gone; one that only sends no more has not."""
    if writer.is_closing():
        return True
    hung_up = select.poll()
    hung_up.register(writer.get_extra_info("socket"), 0)
    return bool(hung_up.poll(0))


async def _outcome(command: Command, writer: StreamWriter) -> dict[str, Any]:
    """What becomes of a command. One that the loop has not taken in time, or before its asker went, is given up: it is
    never done."""
    answer = asyncio.wrap_future(command.answer)
    until_s = time.monotonic() + LOOP_ANSWERS_WITHIN_S
    try:
        done: set[Any] = set()
        while not done and time.monotonic() < until_s and not _is_gone(writer):
            done, _ = await asyncio.wait({answer}, timeout=min(LOOKED_AGAIN_S, LOOP_ANSWERS_WITHIN_S))
        if not done and command.answer.cancel():
            problem = f"the loop did not answer within {LOOP_ANSWERS_WITHIN_S:g} s: nothing was done"
            return {"ok": False, "error": problem}
        done, _ = await asyncio.wait({answer}, timeout=LOADED_WITHIN_S)
    except asyncio.CancelledError as stops:
        raise Refusal(stops.args[0] + (": nothing was done" if command.answer.cancel() else "")) from None
    if done:
        return answer.result()
    return {"ok": True, "note": f"still loading after {LOADED_WITHIN_S:g} s: ask `phasestack status`"}


@contextlib.contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Of several that look for a dead socket and put their own in its place, one at a time."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until_s = time.monotonic() + ALONE_WITHIN_S
        while time.monotonic() < until_s:  # for ever, where somebody holds it who need not
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(0.01)
        yield
    finally:
        os.close(opened)


def _check_dead(path: Path) -> None:
    """Raise InputError where something else than a socket is there, SocketInUse where one is listened to."""
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
    """The socket that the settings name; in a user's session, where that fails, the user's own.

    Under a supervisor it is the socket or nothing: raises SocketInUse where another phasestack has it, InputError
    where it can't be made. A run by hand then goes on without one, and the log says why.
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
