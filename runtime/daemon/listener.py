"""A small server on its own thread that slow, hanging or numerous clients cannot block.

Requests and answers have time limits. When all connections are in use, a new client replaces the one that has waited
longest to complete its request. No client costs a thread.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from abc import ABC, abstractmethod
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Coroutine
from typing import Any

from runtime.errors import one_line
from runtime.support.background import BACKGROUND_NICENESS, begin, patience_s, set_niceness

log = logging.getLogger("phasestack.service")

REQUEST_MAX_BYTES = 65536  # of one request, of a client or a page: limits the memory that a client can use
BACKLOG = 64  # connections waiting to be accepted
CLIENTS_MAX = 64  # simultaneous connections
REQUEST_S = 5.0  # for a whole request to arrive, and for its answer to be read

LIMITED: Any = {"limit": REQUEST_MAX_BYTES, "backlog": BACKLOG}  # of asyncio's servers
Opened = Callable[[Callable[[StreamReader, StreamWriter], Any]], Coroutine[Any, Any, asyncio.Server]]


class Refusal(Exception):
    """Reason for disconnecting a client."""


class Listener(ABC):
    """Server of clients, from `start` to `close`. All but these two runs on its own thread."""

    def __init__(self, name: str, opened: Opened) -> None:
        """opened: starts the server, given the function that serves a client. Raises OSError, TransientError."""
        self._name = name
        self._clients: set[asyncio.Task[None]] = set()
        self._reading: dict[asyncio.Task[None], None] = {}  # waiting for a whole request, longest first
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._log_error)
        self._thread: threading.Thread | None = None
        try:
            self._server = self._loop.run_until_complete(opened(self._serve))
        except BaseException:
            self._loop.close()
            raise

    def start(self) -> None:
        """Start serving. Raises TransientError."""
        self._thread = begin(self._name, self._run)

    def close(self) -> None:
        """Answer pending requests and stop. May be called twice."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._loop.call_soon_threadsafe(self._loop.stop)
            thread.join(patience_s(2.0))

    # On the server's thread.

    @abstractmethod
    async def converse(self, reader: StreamReader, writer: StreamWriter) -> None:
        """Serve one client to its last answer. Raises Refusal, OSError, TimeoutError."""

    @abstractmethod
    def refuse(self, writer: StreamWriter, why: str) -> None:
        """Send a last answer to a client before disconnecting it."""

    async def request(self, reader: StreamReader, end: bytes) -> bytes:
        """Return the next request including its end, or a partial one at the end of input. Raises Refusal."""
        task = asyncio.current_task()
        assert task is not None
        self._reading[task] = None
        try:
            async with asyncio.timeout(REQUEST_S):
                return await reader.readuntil(end)
        except asyncio.IncompleteReadError as cut:
            return cut.partial
        except asyncio.LimitOverrunError:
            raise Refusal("the request is too long") from None
        except TimeoutError:
            raise Refusal("the request did not arrive in time") from None
        finally:
            self._reading.pop(task, None)

    async def send(self, writer: StreamWriter, answer: bytes) -> None:
        """Send an answer and wait until it has been read."""
        writer.write(answer)
        async with asyncio.timeout(REQUEST_S):
            await writer.drain()

    def _run(self) -> None:
        set_niceness(BACKGROUND_NICENESS)
        self._loop.run_forever()
        self._loop.run_until_complete(self._end())
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        for _ in range(16):  # lets new clients begin, to be answered, too
            await asyncio.sleep(0)
        clients = asyncio.all_tasks() - {asyncio.current_task()}
        for client in clients:
            client.cancel("the daemon stops")
        await asyncio.gather(*clients, return_exceptions=True)
        await asyncio.sleep(0)  # closes their connections

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        writer.transport.set_write_buffer_limits(high=0)  # `drain` waits until the whole answer has been sent
        try:
            self._make_room()
            self._clients.add(task)
            await self.converse(reader, writer)
        except Refusal as error:
            self.refuse(writer, str(error))
        except asyncio.CancelledError as error:
            self.refuse(writer, error.args[0])
        except (OSError, TimeoutError):  # disconnected, or not reading
            writer.transport.abort()
        finally:
            self._clients.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            writer.close()

    def _make_room(self) -> None:
        """Disconnect the client that has waited longest for a request. Raises Refusal if none waits."""
        if len(self._clients) >= CLIENTS_MAX:
            longest = next(iter(self._reading), None)
            if longest is None:
                raise Refusal("too many clients")
            self._reading.pop(longest)
            self._clients.discard(longest)  # now: many may connect before it runs again
            longest.cancel("too many clients")

    def _log_error(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an error such as a lack of descriptors, after which asyncio retries in a second."""
        log.warning("%s: %s", self._name, one_line(f"{context.get('message')} ({context.get('exception')})"))
