"""Pictures from another process through shared memory: docs/external-content.md is the protocol.

The client is trusted with nothing: the memory is sealed against resizing, a picture counts only if its numbers
fit before and after it was copied, and the loop never waits.
"""

from __future__ import annotations

import errno
import fcntl
import json
import mmap
import os
import socket
import struct
from collections import OrderedDict
from pathlib import Path

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import ContentSettings
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.images import WarpedPicture, image_from_view
from runtime.errors import ContentFailure, InputError
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

SLOTS = 2
HEADER_BYTES = 4096
SLOT_HEADER = struct.Struct("<QQQ")  # begin, end, request
PIXELS_AT = 4096  # in a slot
FLAT_AFTER_NS = 2 * NS_PER_S  # without a new picture both eyes see the same one
REQUESTS_KEPT = 64
HEARD_BYTES = 65536  # of what a client says on the socket; nothing it says there is used


class ExternalSource(ContentSource):
    """The last whole picture of whichever program is connected, warped to where the eyes are now."""

    def __init__(self, settings: ContentSettings, *, stack: PanelStack) -> None:
        """Listens at `settings.external`. Raises InputError where that can't be."""
        self._width, self._height = stack.width_px, stack.height_px
        self._background = settings.background
        self._memory, self._descriptor = _sealed_memory(self._slot_bytes * SLOTS + HEADER_BYTES)
        self._path = Path(settings.external)
        self._listener = _listen(self._path)
        self._client: socket.socket | None = None
        self._asked: OrderedDict[int, tuple[F64, F64]] = OrderedDict()  # request: two projections
        self._request = 0
        self._taken = 0  # newest sequence that was looked at
        self._arrived = 0
        self._pictures: list[WarpedPicture] = []
        self._projections: tuple[F64, F64] | None = None
        self._fresh_ns: int | None = None
        self._looked_ns: int | None = None  # when the memory was last looked at
        self._left_view: View | None = None  # drawn last, and no right one since
        self._wanted: tuple[View, View] | None = None  # which pictures the client is to draw
        self._asked_this_frame = False
        self.rejected = 0  # pictures that were torn, or nobody had asked for
        self.status = "waiting for a client"
        self.info = ContentInfo(name="external", moving=True, background=settings.background)

    @property
    def _picture_bytes(self) -> int:
        return self._width * self._height * 4

    @property
    def _slot_bytes(self) -> int:
        whole = PIXELS_AT + 2 * self._picture_bytes
        return -(-whole // mmap.PAGESIZE) * mmap.PAGESIZE

    def revision(self, *, time_ns: int) -> int:
        """Changes with each picture that arrives, and when the source goes flat. Looks for a new one.

        Called once a frame, drawn or not: a client hears of every frame, or it would wait for us and we for it.
        """
        self._serve()
        self._take(time_ns)
        if not self._asked_this_frame and self._wanted is not None:
            self._ask(*self._wanted, time_ns)
        self._asked_this_frame = False
        return self._arrived * 2 + int(self._is_flat(time_ns))

    def render(self, view: View, *, time_ns: int) -> U8:
        """The newest whole picture for this eye. Raises ContentFailure until there has been one."""
        self._serve()
        if view.side == 0:
            # The left one before had no right one after it: a flat picture, or a frame that failed half way.
            if self._left_view is not None:
                self._wanted = (view, view)
            self._left_view = view
        elif self._left_view is not None:
            self._wanted, self._left_view = (self._left_view, view), None
        if self._left_view is None and self._wanted is not None:
            self._ask(*self._wanted, time_ns)
        # Every picture of one frame comes of one handover: eyes that saw two would see depth that isn't there.
        if time_ns != self._looked_ns:
            self._take(time_ns)
        if self._projections is None:
            raise ContentFailure(f"external: {self.status}")
        side = 0 if self._is_flat(time_ns) else view.side
        matrix = image_from_view(self._projections[side], view.pixels_from_stack, x_m=0.0)
        picture = self._pictures[side]
        return picture.warped(matrix, width_px=view.width_px, height_px=view.height_px, side=view.side)

    def is_empty(self, view: View, *, time_ns: int) -> bool:
        return False  # the client is asked for the eyes that look, and for no others

    @property
    def problem(self) -> str:
        return "" if self.status == "connected" else f"external: {self.status}"

    def close(self) -> None:
        self._drop("closed")
        self._listener.close()
        self._path.unlink(missing_ok=True)
        self._forget_memory()

    def _forget_memory(self) -> None:
        if not self._memory.closed:
            self._memory.close()
            os.close(self._descriptor)

    def _is_flat(self, time_ns: int) -> bool:
        return self._fresh_ns is not None and time_ns - self._fresh_ns > FLAT_AFTER_NS

    def _serve(self) -> None:
        """Let a client in, notice one that left; never waits."""
        try:
            while True:
                client, _ = self._listener.accept()
                if self._client is None:
                    self._welcome(client)
                else:
                    client.setblocking(False)
                    _send(client, b'{"error": "busy"}\n')
                    client.close()
        except BlockingIOError:
            pass
        except OSError:
            return
        if self._client is None:
            return
        try:
            if not self._client.recv(HEARD_BYTES):
                self._drop("the client is gone")
        except BlockingIOError:
            pass
        except OSError as error:
            self._drop(f"the client is gone ({error.strerror})")

    def _welcome(self, client: socket.socket) -> None:
        client.setblocking(False)
        # Fresh memory for each client: an earlier one may still be writing into its own.
        self._forget_memory()
        self._memory, self._descriptor = _sealed_memory(self._slot_bytes * SLOTS + HEADER_BYTES)
        self._taken = 0
        hello = {
            "phasestack_content": 1,
            "width_px": self._width,
            "height_px": self._height,
            "bytes": len(self._memory),
            "first_slot": HEADER_BYTES,
            "slots": SLOTS,
            "slot_bytes": self._slot_bytes,
            "pixels": PIXELS_AT,
        }
        try:
            socket.send_fds(client, [json.dumps(hello).encode() + b"\n"], [self._descriptor])
        except OSError:
            client.close()
            return
        self._client, self.status = client, "connected"

    def _drop(self, why: str) -> None:
        if self._client is not None:
            self._client.close()
        self._client, self.status = None, why

    def _ask(self, left: View, right: View, time_ns: int) -> None:
        """Tell the client for which eyes to draw next; one that doesn't read loses requests, not our time."""
        if self._client is None or self._memory.closed:
            return
        self._request += 1
        projections = tuple(self._whole(view) for view in (left, right))
        self._asked[self._request] = (projections[0], projections[1])
        while len(self._asked) > REQUESTS_KEPT:
            self._asked.popitem(last=False)
        line = {
            "request": self._request,
            "time_ns": time_ns,
            "eyes_m": [left.eye_m.tolist(), right.eye_m.tolist()],
            "pixels_from_stack": [matrix.tolist() for matrix in projections],
        }
        if not _send(self._client, json.dumps(line).encode() + b"\n"):
            self._drop("the client is gone")
        self._asked_this_frame = True

    def _whole(self, view: View) -> F64:
        """The view's projection, scaled to the pictures' fixed size."""
        scale = np.diag([self._width / view.width_px, self._height / view.height_px, 1.0])
        return scale @ view.pixels_from_stack

    def _take(self, time_ns: int) -> None:
        """Copy the newest whole picture, if there is one that was asked for."""
        self._looked_ns = time_ns
        if self._memory.closed:
            return
        slots = [self._numbers(slot) for slot in range(SLOTS)]
        whole = [(end, slot) for slot, (begin, end, _) in enumerate(slots) if begin == end and end > self._taken]
        if not whole:
            return
        sequence, slot = max(whole)
        start = HEADER_BYTES + slot * self._slot_bytes + PIXELS_AT
        flat = np.frombuffer(self._memory, np.uint8, 2 * self._picture_bytes, start).copy()
        request = slots[slot][2]
        # Written again while it was copied: the next one will do.
        if self._numbers(slot) != (sequence, sequence, request):
            self.rejected += 1
            return
        self._taken = sequence
        if request not in self._asked:
            self.rejected += 1
            self.status = "connected; the last picture answered no request of ours"
            return
        pictures = flat.reshape(2, self._height, self._width, 4)
        self._pictures = [WarpedPicture(picture, background=self._background) for picture in pictures]
        self._projections = self._asked[request]
        self._arrived += 1
        self._fresh_ns, self.status = time_ns, "connected"

    def _numbers(self, slot: int) -> tuple[int, int, int]:
        begin, end, request = SLOT_HEADER.unpack_from(self._memory, HEADER_BYTES + slot * self._slot_bytes)
        return begin, end, request


def _sealed_memory(size: int) -> tuple[mmap.mmap, int]:
    """Anonymous memory that others can write but not resize: a client can't make the daemon's reads fault."""
    descriptor = os.memfd_create("phasestack-content", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(descriptor, size)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    return mmap.mmap(descriptor, size), descriptor


def _listen(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
                if other.connect_ex(str(path)) == 0:
                    raise OSError(errno.EADDRINUSE, "another daemon listens there")
            path.unlink()
        listener.bind(str(path))
        path.chmod(0o660)
        listener.listen(1)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise InputError("content", "external", f"{path}: {error.strerror}") from None
    return listener


def _send(client: socket.socket, data: bytes) -> bool:
    """Whole or not at all as far as the buffer lets us; False where the other end is gone."""
    try:
        sent = client.send(data, socket.MSG_NOSIGNAL)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return sent == len(data)
