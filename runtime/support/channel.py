"""Messages between two processes of one run. Large arrays are passed in shared memory."""

from __future__ import annotations

import array
import contextlib
import fcntl
import mmap
import os
import pickle
import select
import socket
import time
from typing import Any

SMALL = 1 << 15  # size in bytes from which an array, or a whole message, is passed in shared memory
ALIGNED = 64  # alignment of arrays in bytes
PACKET_MAX = 1 << 16
FLAGS = socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL


class ChannelClosed(Exception):
    """The other process has ended or closed its end of the channel."""


class Channel:
    """One end of a two-way channel of picklable values, which arrive whole, in order, or not at all. Both
    processes are trusted, because a message is unpickled. Only one thread at a time may receive at each end.
    """

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._received = bytearray(PACKET_MAX)

    @classmethod
    def pair(cls) -> tuple[Channel, Channel]:
        """Return the two ends of a new channel. Raises OSError if the system has no descriptor left."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(ours), cls(theirs)

    @classmethod
    def of(cls, descriptor: int) -> Channel:
        """Return the end with this file descriptor, which was inherited from the parent process."""
        return cls(socket.socket(fileno=descriptor))

    def fileno(self) -> int:
        """Return the file descriptor, for `select.poll`."""
        return self._socket.fileno()

    def send(self, message: Any, *, timeout_s: float = 0.0) -> bool:
        """Send a message. False if too many are unread for `timeout_s`. Raises ChannelClosed."""
        large: list[memoryview] = []

        def aside(buffer: pickle.PickleBuffer) -> bool:
            raw = buffer.raw()
            if raw.nbytes >= SMALL:
                large.append(raw)
            return raw.nbytes < SMALL

        packet = pickle.dumps(message, protocol=5, buffer_callback=aside)
        if not large and len(packet) < SMALL:
            return self._sent(b"\0" + packet, (), timeout_s)
        memory = _memory([memoryview(packet), *large])
        try:
            sizes = [len(packet), *(raw.nbytes for raw in large)]
            return self._sent(b"\1" + pickle.dumps(sizes), (memory,), timeout_s)
        finally:
            os.close(memory)

    def receive(self, timeout_s: float = 0.0) -> list[Any]:
        """Return all messages that have arrived, oldest first, after waiting up to `timeout_s` for one.
        Raises ChannelClosed once the other process has ended and its messages have been returned.
        """
        messages: list[Any] = []
        while True:
            try:
                size, ancillary, _, _ = self._socket.recvmsg_into(
                    [self._received], socket.CMSG_LEN(4), socket.MSG_DONTWAIT | socket.MSG_CMSG_CLOEXEC
                )
            except BlockingIOError:
                if messages or not timeout_s or not _ready(self._socket, select.POLLIN, timeout_s):
                    return messages
                timeout_s = 0.0
                continue
            except ConnectionError:
                size, ancillary = 0, []
            if not size:
                if messages:
                    return messages
                raise ChannelClosed
            data = memoryview(self._received)[1:size]
            messages.append(_attached(data, ancillary) if self._received[0] else pickle.loads(data))

    def close(self) -> None:
        """Close this end. May be called more than once."""
        self._socket.close()

    def _sent(self, packet: bytes, descriptors: tuple[int, ...], timeout_s: float) -> bool:
        attached = [(socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", descriptors))] if descriptors else []
        until_s = time.monotonic() + timeout_s
        while True:
            try:
                self._socket.sendmsg([packet], attached, FLAGS)
                return True
            except BlockingIOError:
                left_s = until_s - time.monotonic()
                if left_s <= 0 or not _ready(self._socket, select.POLLOUT, left_s):
                    return False
            except OSError as error:
                raise ChannelClosed from error


def shared_memory(name: str, size: int) -> int:
    """Return the descriptor of new shared memory, zeros, used as it is written. Raises OSError.

    Its size is sealed: a process that reads beyond the end of a mapping that shrank would be ended.
    """
    memory = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(memory, size)
    fcntl.fcntl(memory, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return memory


def _ready(end: socket.socket, events: int, timeout_s: float) -> bool:
    poll = select.poll()
    poll.register(end, events)
    return bool(poll.poll(1e3 * timeout_s))


def _memory(parts: list[memoryview]) -> int:
    """Return new shared memory that contains the parts, each aligned to `ALIGNED` bytes."""
    memory = os.memfd_create("message", os.MFD_CLOEXEC)
    try:
        at = 0
        for part in parts:
            left, place = part, at
            while left.nbytes:
                written = os.pwrite(memory, left, place)
                left, place = left[written:], place + written
            at += _room(part.nbytes)
        os.ftruncate(memory, max(at, 1))
    except BaseException:
        os.close(memory)
        raise
    return memory


def _room(size: int) -> int:
    return -(-size // ALIGNED) * ALIGNED


def _attached(data: memoryview, ancillary: list[tuple[int, int, bytes]]) -> Any:
    (memory,) = array.array("i", ancillary[0][2])
    try:
        whole = memoryview(mmap.mmap(memory, 0, flags=mmap.MAP_PRIVATE))
    finally:
        with contextlib.suppress(OSError):
            os.close(memory)
    parts, at = [], 0
    for size in pickle.loads(data):
        parts.append(whole[at : at + size])
        at += _room(size)
    return pickle.loads(parts[0], buffers=parts[1:])
