"""Store the token for the operator's page in a file that only its owner can read."""

from __future__ import annotations

import hmac
import os
import secrets
import stat
import tempfile
from pathlib import Path

from runtime.errors import InputError

TOKEN_BYTES = 32  # length of a new token
LEAST_CHARACTERS = 16  # minimum length of a token; a shorter one could be guessed
MOST_BYTES = 4096  # maximum number of bytes read from the file


def token_of(path: Path) -> str:
    """Read the token from a file, or create it. Raises InputError if others can access it."""
    token, name = secrets.token_urlsafe(TOKEN_BYTES), ""
    try:
        if not os.path.lexists(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            file, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)  # mode 0600
            with os.fdopen(file, "w", encoding="ascii") as opened:
                opened.write(token + "\n")
            os.link(name, path)  # atomic
            return token
    except FileExistsError:
        pass  # created by another process in the meantime
    except OSError as error:
        raise InputError(path, "", f"cannot be created: {error.strerror}") from None
    finally:
        if name:
            Path(name).unlink(missing_ok=True)
    return _read(path)


def _read(path: Path) -> str:
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise InputError(path, "", f"cannot be read: {error.strerror}") from None
    status = os.fstat(file)
    if not stat.S_ISREG(status.st_mode):
        os.close(file)  # `fdopen` does not open folders
        raise InputError(path, "", "is not a regular file")
    with os.fdopen(file, "rb") as opened:
        if status.st_uid != os.geteuid():
            raise InputError(
                path, "", f"belongs to another user (uid {status.st_uid}) who may know the token; delete the file"
            )
        if status.st_mode & 0o077:
            raise InputError(
                path,
                "",
                f"can be read by other users (mode {status.st_mode & 0o777:o}); set its mode to 600 or delete the file",
            )
        token = (opened.read(MOST_BYTES) or b"").decode("ascii", "replace").strip()
    if len(token) < LEAST_CHARACTERS or not token.isprintable() or " " in token:
        raise InputError(path, "", f"must contain a token of at least {LEAST_CHARACTERS} characters on one line")
    return token


def same(key: str, token: str) -> bool:
    """Compare two tokens in constant time."""
    return hmac.compare_digest(key.encode(), token.encode())
