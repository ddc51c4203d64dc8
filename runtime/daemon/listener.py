"""A small server on its own thread that slow, hanging or numerous clients cannot block.

A request has so long to arrive, an answer so long to be read, and where all places are taken the client that has
waited longest for a whole request goes. No client costs a thread.
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

REQUEST_MAX_BYTES = 65536  # of one request, of a client or a page: bounds the memory that anybody can take
BACKLOG = 64  # connections that wait to be accepted
CLIENTS_MAX = 64  # connections at once; a newer one takes the place of the one that has waited longest
REQUEST_S = 5.0  # for a whole request to come, and for its answer to be read

LIMITED: Any = {"limit": REQUEST_MAX_BYTES, "backlog": BACKLOG}  # of asyncio's servers
Opened = Callable[[Callable[[StreamReader, StreamWriter], Any]], Coroutine[Any, Any, asyncio.Server]]


class Refusal(Exception):
    """Reason for disconnecting a client."""


class Listener(ABC):
    """Serves clients until it is closed."""

    def __init__(self, name: str, opened: Opened) -> None:
        """opened: the listening server, for a function that serves a client. Raises OSError, TransientError."""
        self._name = name
        self._clients: set[asyncio.Task[None]] = set()
        self._reading: dict[asyncio.Task[None], None] = {}  # who waits for a whole request, the longest first
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(self._told)
        self._thread: threading.Thread | None = None
        try:
            self._server = self._loop.run_until_complete(opened(self._serve))
        except BaseException:
            self._loop.close()
            raise

    def start(self) -> None:
        """Answer from now on. Raises TransientError."""
        self._thread = begin(self._name, self._run)

    def close(self) -> None:
        """Answer what waits, and stop. May be called twice."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._loop.call_soon_threadsafe(self._loop.stop)
            thread.join(patience_s(2.0))

    # On the server's thread.

    @abstractmethod
    async def converse(self, reader: StreamReader, writer: StreamWriter) -> None:
        """One client, until it has had its last answer. Raises Refusal, OSError, TimeoutError."""

    @abstractmethod
    def refuse(self, writer: StreamWriter, why: str) -> None:
        """Send a last answer to a client before disconnecting it."""

    async def request(self, reader: StreamReader, end: bytes) -> bytes:
        """The next request, with its end; what there is of it where nothing more will come. Raises Refusal."""
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
            raise Refusal("the request did not come in time") from None
        finally:
            self._reading.pop(task, None)

    async def send(self, writer: StreamWriter, answer: bytes) -> None:
        """An answer, until it has been read."""
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
        for _ in range(16):  # who has just come in is served by then, and is told too
            await asyncio.sleep(0)
        clients = asyncio.all_tasks() - {asyncio.current_task()}
        for client in clients:
            client.cancel("the daemon stops")
        await asyncio.gather(*clients, return_exceptions=True)
        await asyncio.sleep(0)  # their channels are closed in the loop's next turn

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        writer.transport.set_write_buffer_limits(high=0)  # `drain` waits until all of an answer is on its way
        try:
            self._make_room()
            self._clients.add(task)
            await self.converse(reader, writer)
        except Refusal as error:
            self.refuse(writer, str(error))
        except asyncio.CancelledError as error:
            self.refuse(writer, error.args[0])
        except (OSError, TimeoutError):  # it is gone, or does not read
            writer.transport.abort()
        finally:
            self._clients.discard(task)
            if writer.transport.get_write_buffer_size():
                writer.transport.abort()
            writer.close()

    def _make_room(self) -> None:
        """Send away who has waited longest for a whole request; raises Refusal where all are being answered."""
        if len(self._clients) >= CLIENTS_MAX:
            longest = next(iter(self._reading), None)
            if longest is None:
                raise Refusal("too many clients")
            self._reading.pop(longest)
            self._clients.discard(longest)  # at once: many may come before it runs again
            longest.cancel("too many clients")

    def _told(self, loop: asyncio.AbstractEventLoop, what: dict[str, Any]) -> None:
        """No descriptor for another client, for example: asyncio tries again a second later."""
        log.warning("%s: %s", self._name, one_line(f"{what.get('message')} ({what.get('exception')})"))
