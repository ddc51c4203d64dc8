"""Creation of the status socket's file (mode 0660), which replaces the file of a crashed daemon."""

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
BACKLOG = 64  # maximum number of connections not yet accepted
LOCKED_WITHIN_S = 2.0  # time limit for locking the folder; daemons hold the lock only briefly


class SocketInUse(TransientError):
    """Raised when another phasestack process owns the socket. The message gives the process ID, if known."""


def listening_socket(path: Path) -> socket.socket:
    """Create a socket that listens at `path`.

    Raises:
        SocketInUse: Another phasestack process owns the socket.
        InputError: The socket cannot be created.
    """
    made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _locked(path.parent):
            _remove_dead(path)
            # Set the mode by umask, because before a chmod the file would have another mode.
            mask = os.umask(0o117)
            try:
                made.bind(str(path))
            finally:
                os.umask(mask)
            made.listen(BACKLOG)
    except OSError as error:
        made.close()
        raise InputError("service", "socket", f"{path} cannot be created ({error.strerror or error})") from error
    except BaseException:
        made.close()
        raise
    try:
        group = grp.getgrnam(GROUP).gr_gid
        if path.lstat().st_gid != group:  # a sandbox may refuse even a chown that changes nothing
            os.chown(path, -1, group)
    except (KeyError, PermissionError):
        log.info("only this user can use the status socket; the group %s does not exist or lacks this user", GROUP)
    return made


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock a folder to prevent two daemons from replacing a dead socket at the same time.

    If the lock is not available within `LOCKED_WITHIN_S`, log a warning and continue without it.
    """
    opened = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until_s = time.monotonic() + LOCKED_WITHIN_S
        while time.monotonic() < until_s:  # limited, because another program may never release the lock
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
    """Remove the socket of a dead daemon.

    Raises:
        SocketInUse: A daemon is listening at the socket.
        InputError: The file is not a socket.
    """
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
            path.unlink()
            return
        except BlockingIOError:
            pass  # the backlog is full, which means that a daemon is listening
        else:
            pid, _, _ = struct.unpack("3i", probe.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            owner = f" (pid {pid})"
    raise SocketInUse(f"service: socket: {path} is in use by another phasestack{owner}")
