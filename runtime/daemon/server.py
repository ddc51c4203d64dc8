"""The status and control socket: JSON lines over a local socket of mode 0660, answered alongside the loop."""

from __future__ import annotations

import errno
import fcntl
import grp
import json
import logging
import os
import queue
import socket
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runtime.clock import NS_PER_S, Clock, MonotonicClock
from runtime.config import ServiceSettings
from runtime.daemon.commands import Command, parse
from runtime.daemon.location import user_socket
from runtime.daemon.request_server import Limits, Pending, RequestServer
from runtime.errors import InputError, TransientError
from runtime.support.artifacts import to_json
from runtime.support.foreign import nesting

log = logging.getLogger("phasestack.service")

LINE_MAX_BYTES = 65536
DEPTH_MAX = 8
CLIENTS_MAX = 64
REQUEST_S = 5.0
LOOP_ANSWERS_WITHIN_S = 5.0
LOADED_WITHIN_S = 60.0  # what has begun is waited for so long
OWN_MODE = 0o600


class SocketInUse(TransientError):
    """Another phasestack has the socket; the text says which."""


class StatusServer:
    """Answers `status` from the last published snapshot, and hands everything else to the loop.

    The loop publishes (`publish`) and drains (`commands`); it never waits for a client. Where the loop hangs,
    `status` still answers, and says for how long no turn was completed.
    """

    def __init__(self, path: Path, *, group: str, clock: Clock) -> None:
        """Raises SocketInUse where the socket belongs to a running daemon, InputError where it can't be made."""
        self.path = path
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self.lookups: dict[str, Callable[[], dict[str, Any]]] = {}  # answered at once, on the server's thread
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._snapshot: tuple[int, Callable[[], dict[str, Any]]] = (self._started_ns, dict)
        self._lock = _claim(path)
        try:
            listening = _bound(path, group)
        except BaseException:
            os.close(self._lock)
            raise
        self._own = _identity(path)
        limits = Limits(clients=CLIENTS_MAX, request_bytes=LINE_MAX_BYTES, request_s=REQUEST_S)
        self._server: RequestServer | None = RequestServer(listening, _Lines(self), limits, name="status")

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """The newest account of the loop, once a turn; called (if ever) on the server's thread.

        A callable, so that a turn costs nothing where nobody asks: it must only read what no longer changes.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Stop answering and remove the socket. May be called twice."""
        if self._server is None:
            return
        self._server.close()
        self._server = None
        if _identity(self.path) == self._own:  # where it was deleted, another daemon's may be there
            self.path.unlink(missing_ok=True)
        os.close(self._lock)

    def answer(self, line: bytes) -> dict[str, Any] | Waiting:
        """One request to one answer (`ok` says whether it was done, `error` why not), or to a command's wait."""
        try:
            if nesting(line, most=DEPTH_MAX) > DEPTH_MAX:
                raise ValueError
            request = json.loads(line)
        except ValueError:
            return {"ok": False, "error": "a request is one JSON object on one line"}
        if isinstance(request, dict) and request.get("command") == "status":
            return self._status()
        looked_up = self.lookups.get(str(request.get("command"))) if isinstance(request, dict) else None
        if looked_up is not None:
            return {"ok": True, **looked_up()}
        try:
            command = parse(request)
        except ValueError as error:
            return {"ok": False, "error": str(error)}
        log.info("asked for: %s %s", command.name, "" if command.value is None else command.value)
        self.commands.put(command)
        return Waiting(command)

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


class _Lines:
    """The service of the socket: one JSON object a line, as many as the client likes."""

    one_request = False

    def __init__(self, owner: StatusServer) -> None:
        self._owner = owner

    def cut(self, received: bytes, *, ended: bool) -> tuple[bytes, bytes] | None:
        line, broken, rest = received.partition(b"\n")
        return (line, rest) if broken or (ended and line) else None

    def answer(self, request: bytes) -> bytes | Pending:
        answer = self._owner.answer(request)
        return answer if isinstance(answer, Waiting) else _line(answer)

    def refusal(self, why: str) -> bytes:
        return _line({"ok": False, "error": why})


class Waiting:
    """A client that waits for what becomes of its command."""

    def __init__(self, command: Command) -> None:
        self._command, self._clock = command, MonotonicClock()
        self._asked_ns = self._clock.now_ns()

    def poll(self) -> bytes | None:
        """The answer, once there is one. A command that nobody has taken in time is given up: it is never done."""
        refused = self._command.wait(0.0)
        if refused is not None:
            return _line({"ok": False, "error": refused} if refused else {"ok": True, **self._command.told})
        waited_s = (self._clock.now_ns() - self._asked_ns) / NS_PER_S
        if waited_s > LOOP_ANSWERS_WITHIN_S and self._command.give_up():
            problem = f"the loop did not answer within {LOOP_ANSWERS_WITHIN_S:g} s: nothing was done"
            return _line({"ok": False, "error": problem})
        if waited_s > LOADED_WITHIN_S:
            return _line({"ok": True, "note": f"still loading after {LOADED_WITHIN_S:g} s: ask `phasestack status`"})
        return None

    def abandon(self) -> bytes:
        problem = "the daemon stops" + (": nothing was done" if self._command.give_up() else "")
        return _line({"ok": False, "error": problem})


def _line(answer: dict[str, Any]) -> bytes:
    return to_json(answer).encode() + b"\n"


def _claim(path: Path) -> int:
    """A locked file next to the socket: the daemon that holds it owns the socket, whatever else has crashed.

    A link is never followed, and nothing is written to a file that is not ours alone.
    """
    lock_path = path.with_name(path.name + ".lock")
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = os.open(lock_path, flags, OWN_MODE)
    except OSError as error:
        problem = "is a link" if error.errno == errno.ELOOP else f"can't be made ({error.strerror})"
        raise InputError("service", "socket", f"{lock_path} {problem}") from error
    try:
        found = os.fstat(lock)
        if not stat.S_ISREG(found.st_mode) or found.st_nlink != 1 or found.st_uid != os.geteuid():
            raise InputError("service", "socket", f"{lock_path} is not a file of this user's alone")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.pread(lock, 32, 0).decode(errors="replace").strip()
            raise SocketInUse(
                f"service: socket: {path} is in use by another phasestack (pid {owner if owner.isdigit() else '?'})"
            ) from None
        os.fchmod(lock, OWN_MODE)
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
    except OSError as error:
        os.close(lock)
        raise InputError("service", "socket", f"{lock_path} can't be written ({error.strerror})") from error
    except BaseException:
        os.close(lock)
        raise
    return lock


def _bound(path: Path, group: str) -> socket.socket:
    """The socket at its place. Only a dead one is replaced: with its lock deleted, one may still be listened to."""
    try:
        found = path.lstat() if path.is_symlink() or path.exists() else None
        if found is not None and not stat.S_ISSOCK(found.st_mode):
            raise InputError("service", "socket", f"{path} exists and is not a socket")
        if found is not None and _is_listened_to(path):
            raise SocketInUse(f"service: socket: {path} is in use by another phasestack")
        path.unlink(missing_ok=True)
        made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        # The mode must hold from the first moment, so it is the mask that makes it, not a later chmod.
        mask = os.umask(0o117)
        try:
            made.bind(str(path))
        except BaseException:
            made.close()
            raise
        finally:
            os.umask(mask)
    except OSError as error:
        raise InputError("service", "socket", f"{path} can't be made ({error.strerror or error})") from error
    try:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
    except (KeyError, PermissionError):
        log.info("the status socket is this user's alone: group %s is not there or not ours", group)
    return made


def _is_listened_to(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except BlockingIOError:
            return True  # its backlog is full
        except ConnectionRefusedError:
            return False
        return True


def _identity(path: Path) -> tuple[int, int] | None:
    """What is at a path, whatever it is called later."""
    try:
        found = path.lstat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def open_status_server(settings: ServiceSettings, *, clock: Clock, supervised: bool) -> StatusServer | None:
    """The socket that the settings name; in a person's session, where its default can't be made, their own.

    Under a supervisor it is the socket or nothing: raises SocketInUse where another phasestack has it, InputError
    where it can't be made. A run by hand then goes on without one, and the log says why.
    """
    path = Path(settings.socket)
    own = user_socket()
    if own is not None and path == Path(ServiceSettings().socket) and not _may_write(path.parent):
        path = own
    try:
        return StatusServer(path, group=settings.group, clock=clock)
    except (InputError, SocketInUse) as error:
        if supervised:
            raise
        log.warning("no status socket: %s", error)
        return None


def _may_write(folder: Path) -> bool:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    return os.access(existing, os.W_OK)
