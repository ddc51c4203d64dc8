"""Serve the status and control socket, exchanging JSON lines on a separate thread.

The server cannot be blocked by slow or hanging clients or by many clients, because there are time limits for requests
and answers. If all connections are in use, a new client replaces the one whose request has been incomplete for longest.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import os
import queue
import select
import threading
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from runtime.clock import NS_PER_S, Clock
from runtime.config import ServiceSettings
from runtime.daemon.client import DEFAULT_SOCKET, LOADED_WITHIN_S, REQUEST_MAX_BYTES, REQUEST_S, user_socket
from runtime.daemon.commands import Command, parse
from runtime.daemon.socket_file import BACKLOG, SocketInUse, listening_socket
from runtime.errors import InputError, one_line, without_secrets
from runtime.records import State
from runtime.support.artifacts import to_json
from runtime.support.background import begin, patience_s

log = logging.getLogger("phasestack.service")

CLIENTS_MAX = 64  # maximum number of simultaneous connections
LOOP_ANSWERS_WITHIN_S = 5.0  # how long to wait for the loop to start a command
LOOKED_AGAIN_S = 0.1  # interval for checking that the client is still connected


class Refusal(Exception):
    """Raised to disconnect a client. The message is sent to the client as the reason."""


class StatusServer:
    """Answers `status` from the latest published snapshot, and queues commands for the loop. The
    presenter's loop calls `publish` and takes from `commands`, and never waits for a client. Even if the loop hangs,
    status requests are answered, and each answer gives the time since the loop's last turn.
    """

    def __init__(self, path: Path, *, clock: Clock) -> None:
        """Create the socket and start serving. Raises SocketInUse, InputError, or TransientError without a thread."""
        self.path = path
        self.commands: queue.SimpleQueue[Command] = queue.SimpleQueue()
        self.lookups: dict[str, Callable[[], dict[str, Any]]] = {}  # by request; called on the server's thread
        self._clock = clock
        self._started_ns = clock.now_ns()
        self._snapshot: tuple[int, Callable[[], dict[str, Any]]] = (self._started_ns, dict)
        self._clients: set[asyncio.Task[None]] = set()
        self._reading: dict[asyncio.Task[None], None] = {}  # clients whose request is incomplete, longest first
        listening = listening_socket(path)
        self._own = path.lstat().st_ino
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(_log_error)
        serving = asyncio.start_unix_server(self._serve, sock=listening, limit=REQUEST_MAX_BYTES, backlog=BACKLOG)
        self._server = self._loop.run_until_complete(serving)
        self._thread: threading.Thread | None = begin("status", self._run)

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """Set the function that creates the status. Called once per loop turn. The function is called on the
        server's thread, and only when a client requests the status, so without requests a turn costs nothing. It may
        read only values that no longer change.
        """
        self._snapshot = (self._clock.now_ns(), snapshot)

    def close(self) -> None:
        """Answer all connected clients, stop the server and remove the socket. May be called more than once."""
        thread, self._thread = self._thread, None
        if thread is None:
            return
        self._loop.call_soon_threadsafe(self._loop.stop)
        thread.join(patience_s(2.0))
        with contextlib.suppress(OSError):
            if self.path.lstat().st_ino == self._own:  # if not, another daemon has replaced it
                self.path.unlink()

    def answer(self, line: bytes) -> dict[str, Any] | Command:
        """Return the answer to a request, or a command for the loop to carry out."""
        try:
            request = json.loads(line)
        except (ValueError, RecursionError):
            return {"ok": False, "error": "a request must be one JSON object on one line"}
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

    # All methods below run on the server's thread.

    def _run(self) -> None:
        self._loop.run_forever()
        self._loop.run_until_complete(self._end())
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        for _ in range(16):  # for clients that have only just connected
            await asyncio.sleep(0)
        clients = asyncio.all_tasks() - {asyncio.current_task()}
        for client in clients:
            client.cancel("the daemon is stopping")
        await asyncio.gather(*clients, return_exceptions=True)
        await asyncio.sleep(0)  # so that asyncio can close the connections

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Answer requests from one client until it disconnects."""
        task = asyncio.current_task()
        assert task is not None
        writer.transport.set_write_buffer_limits(high=0)  # so that `drain` waits until all of an answer is sent
        try:
            self._make_room()
            self._clients.add(task)
            while line := await self._request(reader, task):
                writer.write(await self._reply(line, writer))
                async with asyncio.timeout(REQUEST_S):
                    await writer.drain()
        except (Refusal, asyncio.CancelledError) as why:
            writer.write(_line({"ok": False, "error": why.args[0]}))
        except (OSError, TimeoutError):  # the client has disconnected or is not reading
            writer.transport.abort()
        finally:
            self._clients.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            writer.close()

    def _make_room(self) -> None:
        """If all connections are in use, disconnect the one with the oldest incomplete request, or raise Refusal."""
        if len(self._clients) >= CLIENTS_MAX:
            longest = next(iter(self._reading), None)
            if longest is None:
                raise Refusal("too many clients are connected")
            self._reading.pop(longest)
            self._clients.discard(longest)  # not only when its task ends, because more clients may connect
            longest.cancel("too many clients are connected")

    async def _request(self, reader: StreamReader, task: asyncio.Task[None]) -> bytes:
        """Return the next request with its newline, or what remains at end of input. Raises Refusal if long or late."""
        self._reading[task] = None
        try:
            async with asyncio.timeout(REQUEST_S):
                return await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError as cut:
            return cut.partial
        except asyncio.LimitOverrunError:
            raise Refusal("the request is too long") from None
        except TimeoutError:
            raise Refusal("the request did not arrive in time") from None
        finally:
            self._reading.pop(task, None)

    async def _reply(self, line: bytes, writer: StreamWriter) -> bytes:
        try:
            answer = self.answer(line)
        except Exception:
            log.exception("request failed")
            answer = {"ok": False, "error": "the request failed; see the log"}
        if isinstance(answer, Command):
            if _is_gone(writer):
                raise Refusal("the command was not run")
            value = "" if answer.value is None else f" {answer.value}"
            log.info(f"command: {answer.name}{value}")
            self.commands.put(answer)
            outcome = await _outcome(answer, writer)
            return _line(outcome or {"ok": False, "error": f"{self._silence()}, so the command was not run"})
        return _line(answer)

    def _silence(self) -> str:
        """Return why the loop has not answered."""
        status = self._snapshot[1]()
        if status.get("state") == State.STARTING:
            return f"the display is still starting ({status.get('reason', '')})"
        return f"the display loop did not answer within {LOOP_ANSWERS_WITHIN_S:g} s"


def _log_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error in the event loop, such as a shortage of file descriptors. Asyncio then tries again."""
    log.warning("status socket: %s", one_line(f"{context.get('message')} ({context.get('exception')})"))


def _line(answer: dict[str, Any]) -> bytes:
    return without_secrets(to_json(answer)).encode() + b"\n"


def _is_gone(writer: StreamWriter) -> bool:
    """Return True if a client has disconnected, or False if it has only stopped sending."""
    if writer.is_closing():
        return True
    hung_up = select.poll()
    hung_up.register(writer.get_extra_info("socket"), 0)
    return bool(hung_up.poll(0))


async def _outcome(command: Command, writer: StreamWriter) -> dict[str, Any] | None:
    """Wait for a command's outcome. None, and the command is cancelled, if it is not started in time or the client
    leaves. Raises Refusal if the server is stopped.
    """
    answer = asyncio.wrap_future(command.answer)
    until_s = time.monotonic() + LOOP_ANSWERS_WITHIN_S
    try:
        done: set[Any] = set()
        while not done and time.monotonic() < until_s and not _is_gone(writer):
            done, _ = await asyncio.wait({answer}, timeout=min(LOOKED_AGAIN_S, LOOP_ANSWERS_WITHIN_S))
        if not done and command.answer.cancel():
            return None
        done, _ = await asyncio.wait({answer}, timeout=LOADED_WITHIN_S)
    except asyncio.CancelledError as stops:
        raise Refusal(stops.args[0] + ("; the command was not run" if command.answer.cancel() else "")) from None
    if done:
        return answer.result()
    return {"ok": True, "note": f"still loading after {LOADED_WITHIN_S:g} s; see `phasestack status`"}


def open_status_server(settings: ServiceSettings, *, clock: Clock, supervised: bool) -> StatusServer | None:
    """Open the configured socket and start serving. If the default socket is configured but its folder is
    not writable, the user's session socket is used instead. If no socket can be opened, a run that systemd did not
    start logs a warning and continues without one; otherwise, raises SocketInUse or InputError.
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
        log.warning("running without a status socket: %s", error)
        return None


def _may_write(folder: Path) -> bool:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    return os.access(existing, os.W_OK)
