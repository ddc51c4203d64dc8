"""The status and control socket: JSON lines over a local socket of mode 0660, answered beside the loop."""

from __future__ import annotations

import fcntl
import grp
import json
import logging
import os
import queue
import socketserver
import stat
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from runtime.clock import NS_PER_S, Clock
from runtime.config import ServiceSettings
from runtime.daemon.commands import Command, parse
from runtime.daemon.location import user_socket
from runtime.errors import InputError
from runtime.support.artifacts import to_json

log = logging.getLogger("phasestack.service")

LINE_MAX_BYTES = 65536
CLIENTS_MAX = 16
CLIENT_IDLE_S = 5.0
LOOP_ANSWERS_WITHIN_S = 5.0
LOADED_WITHIN_S = 60.0  # what has begun is waited for so long


class StatusServer:
    """Answers `status` from the last published snapshot, and hands everything else to the loop.

    The loop publishes (`publish`) and drains (`commands`); it never waits for a client. Where the loop hangs,
    `status` still answers, and says for how long no turn was completed.
    """

    def __init__(self, path: Path, *, group: str, clock: Clock) -> None:
        """Raises InputError where the socket belongs to a running daemon or can't be made there."""
        self.path = path
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._snapshot: tuple[int, Callable[[], dict[str, Any]]] = (self._started_ns, dict)
        self._slots = threading.BoundedSemaphore(CLIENTS_MAX)
        self._lock = _claim(path)
        try:
            self._server = _listen(path, group, self)
        except BaseException:
            self._lock.close()
            raise
        self._thread = threading.Thread(
            target=self._server.serve_forever, kwargs={"poll_interval": 0.1}, name="status", daemon=True
        )
        self._thread.start()

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """The newest account of the loop, once a turn; called (if ever) on the server's thread.

        A callable, so that a turn costs nothing where nobody asks: it must only read what no longer changes.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Stop answering and remove the socket. May be called twice."""
        if self._lock.closed:
            return
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=2.0)
        self.path.unlink(missing_ok=True)
        self._lock.close()

    def answer(self, line: bytes) -> dict[str, Any]:
        """One request to one answer; `ok` says whether it was done, `error` why not."""
        try:
            request = json.loads(line)
        except ValueError:
            return {"ok": False, "error": "a request is one JSON object on one line"}
        if isinstance(request, dict) and request.get("command") == "status":
            return self._status()
        try:
            command = parse(request)
        except ValueError as error:
            return {"ok": False, "error": str(error)}
        log.info("asked for: %s %s", command.name, "" if command.value is None else command.value)
        self.commands.put(command)
        refused = command.wait(LOOP_ANSWERS_WITHIN_S)
        if refused is None and command.begun:
            refused = command.wait(LOADED_WITHIN_S - LOOP_ANSWERS_WITHIN_S)
            if refused is None:
                return {"ok": True, "note": f"still loading after {LOADED_WITHIN_S:.0f} s: ask `phasestack status`"}
        if refused is None:
            return {"ok": False, "error": f"the loop did not answer within {LOOP_ANSWERS_WITHIN_S:.0f} s"}
        return {"ok": not refused} | ({"error": refused} if refused else {})

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

    def serve(self, stream: socketserver.StreamRequestHandler) -> None:
        """One client, until it hangs up or says nothing for a while."""
        if not self._slots.acquire(blocking=False):
            stream.wfile.write(b'{"ok": false, "error": "too many clients"}\n')
            return
        try:
            while line := stream.rfile.readline(LINE_MAX_BYTES + 1):
                if len(line) > LINE_MAX_BYTES:
                    stream.wfile.write(b'{"ok": false, "error": "the request is too long"}\n')
                    return
                stream.wfile.write(to_json(self.answer(line)).encode() + b"\n")
        except (TimeoutError, BrokenPipeError, ConnectionResetError):
            return
        finally:
            self._slots.release()


class _Handler(socketserver.StreamRequestHandler):
    timeout = CLIENT_IDLE_S

    def handle(self) -> None:
        assert isinstance(self.server, _Server)
        self.server.owner.serve(self)


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True
    block_on_close = False

    def __init__(self, path: Path, owner: StatusServer) -> None:
        self.owner = owner
        super().__init__(str(path), _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.exception("a client of the status socket could not be answered")


def _claim(path: Path) -> TextIO:
    """A locked file beside the socket: the daemon that holds it owns the socket, whatever else has crashed."""
    lock_path = path.with_name(path.name + ".lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = lock_path.open("a+", encoding="utf-8")
    except OSError as error:
        raise InputError("service", "socket", f"{path} can't be made ({error.strerror})") from None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        lock.seek(0)
        owner = lock.read(32).strip() or "unknown"
        lock.close()
        raise InputError("service", "socket", f"{path} is in use by another phasestack (pid {owner})") from None
    lock.truncate(0)
    lock.write(f"{os.getpid()}\n")
    lock.flush()
    return lock


def _listen(path: Path, group: str, owner: StatusServer) -> _Server:
    try:
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            raise InputError("service", "socket", f"{path} exists and is not a socket")
        path.unlink(missing_ok=True)
        # The mode must hold from the first moment, so it is the mask that makes it, not a later chmod.
        mask = os.umask(0o117)
        try:
            server = _Server(path, owner)
        finally:
            os.umask(mask)
    except OSError as error:
        raise InputError("service", "socket", f"{path} can't be made ({error.strerror or error})") from None
    try:
        os.chown(path, -1, grp.getgrnam(group).gr_gid)
    except (KeyError, PermissionError):
        log.info("the status socket is this user's alone: group %s is not there or not ours", group)
    return server


def open_status_server(settings: ServiceSettings, *, clock: Clock, supervised: bool) -> StatusServer | None:
    """The socket that the settings name; in a person's session, where its default can't be made, their own.

    Under a supervisor it is the socket or nothing: raises InputError where another phasestack has it or it
    can't be made. A run by hand then goes on without one, and the log says why.
    """
    path = Path(settings.socket)
    own = user_socket()
    if own is not None and path == Path(ServiceSettings().socket) and not _may_write(path.parent):
        path = own
    try:
        return StatusServer(path, group=settings.group, clock=clock)
    except InputError as error:
        if supervised:
            raise
        log.warning("no status socket: %s", error)
        return None


def _may_write(folder: Path) -> bool:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    return os.access(existing, os.W_OK)
