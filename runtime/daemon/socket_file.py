"""Create the status socket's file (mode 0660), replacing a crashed daemon's."""

from __future__ import annotations

import contextlib
import fcntl
import grp
import logging
import os
import socket
import stat
import struct
import time
from collections.abc import Iterator
from pathlib import Path

from runtime.errors import InputError, TransientError

log = logging.getLogger("phasestack.service")

GROUP = "phasestack"  # group whose members may use the socket
BACKLOG = 64  # maximum number of connections waiting to be accepted
LOCKED_WITHIN_S = 2.0  # how long to wait for the folder's lock, which daemons hold only briefly


class SocketInUse(TransientError):
    """Raised when another phasestack process is using the socket. The message gives its ID, if known."""


def listening_socket(path: Path) -> socket.socket:
    """Create a socket that listens on `path`. Raises SocketInUse or InputError."""
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path.parent):
            _remove_dead(path)
            # Use the umask, because with a chmod the file would briefly have another mode.
            mask = os.umask(0o117)
            try:
                made.bind(str(path))
            finally:
                os.umask(mask)
            made.listen(BACKLOG)
    except OSError as error:
        made.close()
        raise InputError("service", "socket", f"{path} cannot be created: {error.strerror or error}") from error
    except BaseException:
        made.close()
        raise
    try:
        group = grp.getgrnam(GROUP).gr_gid
        if path.lstat().st_gid != group:  # a sandbox may refuse a chown even if it would change nothing
            os.chown(path, -1, group)
    except (KeyError, PermissionError):
        log.info("only this user can use the status socket; to share the socket, add this user to the group %s", GROUP)
    return made


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder, so that no two daemons replace a dead socket at the same time, or warn after `LOCKED_WITHIN_S`."""
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until_s = time.monotonic() + LOCKED_WITHIN_S
        while time.monotonic() < until_s:  # stop at some point, because another program may never release the lock
            with contextlib.suppress(BlockingIOError):
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(0.01)
        else:
            log.warning("%s is locked by another program; the status socket is created without the lock", folder)
        yield
    finally:
        os.close(opened)


def _remove_dead(path: Path) -> None:
    """Remove a dead daemon's socket. Raises SocketInUse if it is alive, InputError if the file is no socket."""
    if not os.path.lexists(path):
        return
    if not stat.S_ISSOCK(path.lstat().st_mode):
        raise InputError(
            "service", "socket", f"{path} already exists and is not a socket; delete it or choose another path"
        )
    owner = ""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass  # the backlog is full, so a daemon is listening
        else:
            pid, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            owner = f" (pid {pid})"
    raise SocketInUse(f"service: socket: {path} is in use by another phasestack{owner}")
