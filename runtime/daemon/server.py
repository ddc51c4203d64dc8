"""The status and control socket: JSON lines over a local socket of mode 0660, answered alongside the loop.

Whoever trickles, hangs or comes in crowds holds up nobody: a request has so long to arrive, an answer so long to be
read, and where all places are taken the client that has waited longest for a whole request goes.
"""

from __future__ import annotations

import asyncio
import contextlib
import grp
import json
import logging
import os
import queue
import socket
import stat
import struct
import threading
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runtime.clock import NS_PER_S, Clock
from runtime.config import ServiceSettings
from runtime.daemon.client import DEFAULT_SOCKET, user_socket
from runtime.daemon.commands import Command, parse
from runtime.errors import InputError, TransientError
from runtime.support.artifacts import to_json
from runtime.support.background import BACKGROUND_NICENESS, set_niceness

log = logging.getLogger("phasestack.service")

GROUP = "phasestack"  # that may use the socket
LINE_MAX_BYTES = 65536
BACKLOG = 64
CLIENTS_MAX = 64
REQUEST_S = 5.0  # for a whole request to come, and for its answer to be read
LOOP_ANSWERS_WITHIN_S = 5.0
LOADED_WITHIN_S = 60.0  # what has begun is waited for so long


class SocketInUse(TransientError):
    """Another phasestack has the socket; the text says which."""


class _Refusal(Exception):
    """Why a client is sent away."""


class StatusServer:
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
        self._clients: set[asyncio.Task[None]] = set()
        self._reading: dict[asyncio.Task[None], None] = {}  # who waits for a whole request, the longest first
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            _check_dead(path)
            self._loop = asyncio.new_event_loop()
            # The mode must hold from the first moment, so it is the mask that makes it, not a later chmod.
            mask = os.umask(0o117)
            try:
                self._server = self._loop.run_until_complete(
                    asyncio.start_unix_server(self._serve, path, limit=LINE_MAX_BYTES, backlog=BACKLOG)
                )
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
        self._thread: threading.Thread | None = threading.Thread(target=self._run, name="status", daemon=True)
        self._thread.start()

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """The newest account of the loop, once a turn; called (if ever) on the server's thread.

        A callable, so that a turn costs nothing where nobody asks: it must only read what no longer changes.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Answer what waits, stop, and remove the socket. May be called twice."""
        if self._thread is None:
            return
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=2.0)
        self._thread = None
        with contextlib.suppress(OSError):
            if self.path.lstat().st_ino == self._own:  # where it was deleted, another daemon's may be there
                self.path.unlink()

    def answer(self, line: bytes) -> dict[str, Any] | Command:
        """One request to one answer (`ok` says whether it was done, `error` why not), or to a command for the loop."""
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

    def _run(self) -> None:
        set_niceness(BACKGROUND_NICENESS)
        self._loop.run_forever()
        self._loop.run_until_complete(self._end())
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        for _ in range(16):  # who has just come in is served by then, and is told too
            await asyncio.sleep(0)
        clients = asyncio.all_tasks() - {asyncio.current_task()}
        for client in clients:
            client.cancel("the daemon stops")
        await asyncio.gather(*clients, return_exceptions=True)
        await asyncio.sleep(0)  # their channels are closed in the loop's next turn

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        """One client, as many requests as it likes."""
        task = asyncio.current_task()
        assert task is not None
        writer.transport.set_write_buffer_limits(high=0)  # `drain` waits until all of an answer is on its way
        try:
            self._make_room()
            self._clients.add(task)
            while line := await self._request(task, reader):
                await self._reply(line, writer)
        except _Refusal as error:
            self._send(writer, {"ok": False, "error": str(error)})
        except asyncio.CancelledError as error:
            self._send(writer, {"ok": False, "error": error.args[0]})
        except (OSError, TimeoutError):  # it is gone, or does not read
            writer.transport.abort()
        finally:
            self._clients.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            writer.close()

    def _make_room(self) -> None:
        """Send away who has waited longest for a whole request; raises _Refusal where all are being answered."""
        if len(self._clients) >= CLIENTS_MAX:
            longest = next(iter(self._reading), None)
            if longest is None:
                raise _Refusal("too many clients")
            self._reading.pop(longest)
            self._clients.discard(longest)  # at once: many may come before it runs again
            longest.cancel("too many clients")

    async def _request(self, task: asyncio.Task[None], reader: StreamReader) -> bytes:
        """The next line; what there is of it where nothing more will come."""
        self._reading[task] = None
        try:
            async with asyncio.timeout(REQUEST_S):
                return await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError as end:
            return end.partial
        except asyncio.LimitOverrunError:
            raise _Refusal("the request is too long") from None
        except TimeoutError:
            raise _Refusal("the request did not come in time") from None
        finally:
            self._reading.pop(task, None)

    async def _reply(self, line: bytes, writer: StreamWriter) -> None:
        try:
            answer = self.answer(line)
        except Exception:
            log.exception("a request could not be answered")
            answer = {"ok": False, "error": "the request could not be answered: see the log"}
        if isinstance(answer, Command):
            log.info("asked for: %s %s", answer.name, "" if answer.value is None else answer.value)
            self.commands.put(answer)
            answer = await _outcome(answer)
        self._send(writer, answer)
        async with asyncio.timeout(REQUEST_S):
            await writer.drain()

    @staticmethod
    def _send(writer: StreamWriter, answer: dict[str, Any]) -> None:
        writer.write(to_json(answer).encode() + b"\n")


async def _outcome(command: Command) -> dict[str, Any]:
    """What becomes of a command. One that the loop has not taken in time is given up: it is never done."""
    answer = asyncio.wrap_future(command.answer)
    try:
        done, _ = await asyncio.wait({answer}, timeout=LOOP_ANSWERS_WITHIN_S)
        if not done and command.answer.cancel():
            problem = f"the loop did not answer within {LOOP_ANSWERS_WITHIN_S:g} s: nothing was done"
            return {"ok": False, "error": problem}
        done, _ = await asyncio.wait({answer}, timeout=LOADED_WITHIN_S)
    except asyncio.CancelledError as stops:
        raise _Refusal(stops.args[0] + (": nothing was done" if command.answer.cancel() else "")) from None
    if done:
        return answer.result()
    return {"ok": True, "note": f"still loading after {LOADED_WITHIN_S:g} s: ask `phasestack status`"}


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
    """The socket that the settings name; in a person's session, where its default can't be made, their own.

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
