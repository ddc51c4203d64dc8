"""Atomic output: files are written under a temporary name, synced to disk and renamed."""

from __future__ import annotations

import errno
import fcntl
import io
import json
import os
import secrets
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from runtime.errors import InputError
from runtime.records import F32, U8

STAGING = ".phasestack-staging-"


def sync(path: Path) -> None:
    """Sync a file's data or a folder's entries to disk. Raises OSError if syncing fails."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put_in_place(part: Path, path: Path) -> None:
    """Sync the finished file `part`, rename it to `path`, and sync the folder. Raises OSError on failure."""
    sync(part)
    part.replace(path)
    sync(path.parent)


def write_bytes(path: Path, data: bytes | memoryview, *, like: Path | None = None) -> None:
    """Write a file atomically and create missing folders. Raises InputError if that fails. Owner and mode
    are those of the file `like`, by default of the replaced file.
    """
    like = like or path
    try:
        before = like.stat() if like.is_file() else None
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        name = path.parent / f".{path.name}.{secrets.token_hex(4)}"
        handle = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600 if before else 0o666)
    except OSError as error:
        raise InputError(path, "", f"cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        if before is not None:
            with suppress(PermissionError):  # the replaced file may belong to another user
                os.chown(name, before.st_uid, before.st_gid)
            name.chmod(stat.S_IMODE(before.st_mode))
        if any(part.startswith(STAGING) for part in path.parts):  # OutputFolder syncs its files when it exits
            name.replace(path)
        else:
            put_in_place(name, path)
    except BaseException as error:
        name.unlink(missing_ok=True)
        if isinstance(error, OSError):  # for example because the disk is full
            raise InputError(path, "", f"cannot be written: {error.strerror}") from None
        raise


def write_text(path: Path, text: str) -> None:
    """Write a UTF-8 text file atomically. Raises InputError if the file cannot be written."""
    write_bytes(path, text.encode())


def to_json(value: Any) -> str:
    """Format a value as JSON on one line. Arrays become lists, and non-finite numbers become null."""
    try:
        return json.dumps(value, allow_nan=False, default=_listed)
    except (ValueError, TypeError):  # a non-finite number, or a key that is not a string
        return json.dumps(_finite(value), allow_nan=False)


def _listed(item: Any) -> Any:
    """Convert NumPy arrays and scalars for the JSON encoder, which does not support them."""
    if isinstance(item, np.ndarray | np.generic):
        return item.tolist()
    raise TypeError(f"objects of type {type(item).__name__} cannot be written as JSON")


def _finite(item: Any) -> Any:
    if isinstance(item, dict):
        return {str(key): _finite(child) for key, child in item.items()}
    if isinstance(item, list | tuple):
        return [_finite(child) for child in item]
    if isinstance(item, np.ndarray | np.generic):
        return _finite(item.tolist())
    return None if isinstance(item, float) and not np.isfinite(item) else item


def write_json(path: Path, value: Any) -> None:
    """Write an indented JSON file atomically. Raises InputError if the file cannot be written."""
    write_text(path, json.dumps(json.loads(to_json(value)), indent=1) + "\n")


def png_bytes(image: U8) -> bytes:
    """Encode an image (h, w), (h, w, 3) or (h, w, 4), whose alpha is dropped, as PNG."""
    import cv2

    bgr = image if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])
    done, buffer = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("OpenCV could not encode a picture as PNG")
    return buffer.tobytes()


def write_png(path: Path, image: U8) -> None:
    """Write an image as a PNG file atomically (`png_bytes`). Raises InputError if it cannot be written."""
    write_bytes(path, png_bytes(image))


def write_npy(path: Path, array: F32) -> None:
    """Write an array as a NumPy file atomically. Raises InputError if it cannot be written."""
    buffer = io.BytesIO()
    np.save(buffer, array, allow_pickle=False)
    write_bytes(path, buffer.getbuffer())


def refuse_unwritable(out: Path) -> None:
    """Raise InputError if an output folder cannot be written, before time is spent on its contents."""
    if out.exists() and not out.is_dir():
        raise InputError(out, "--out", "is a file; pass the name of a folder")
    with suppress(_Tried), OutputFolder(out):
        raise _Tried


class _Tried(Exception):
    """Leaves an output folder without writing to it."""


class OutputFolder:
    """Output folder whose new files appear all together at the end, or not at all.

    Use the class as a context manager, and write the files to `staging`. On success, all files are moved to `target`,
    replacing any files of the same names. If the block raises an exception, no new files remain. If a process is
    killed, the next process that writes to the folder removes its staged files.
    """

    def __init__(self, target: Path) -> None:
        self.target = target

    def __enter__(self) -> Self:
        try:
            self._made = [folder for folder in (self.target, *self.target.parents) if not folder.exists()]
            self.target.mkdir(parents=True, exist_ok=True)
            _sweep(self.target)
            self.staging = Path(tempfile.mkdtemp(prefix=STAGING, dir=self.target))
            self._held = os.open(self.staging, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
            fcntl.flock(self._held, fcntl.LOCK_EX)  # released by `discard`, or by the system when this process ends
        except OSError as error:
            raise InputError(self.target, "", f"cannot be written: {error.strerror}") from None
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._put_in_place()
        finally:
            self.discard()
        if kind is None:
            return
        for folder in self._made:
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
        # In messages, name the final file instead of the staged one.
        if isinstance(error, InputError) and error.source.startswith(str(self.staging)):
            file = self.target / Path(error.source).relative_to(self.staging)
            raise InputError(file, error.field, error.problem) from None
        if isinstance(error, OSError) and str(error.filename or "").startswith(str(self.staging)):
            raise InputError(self.target, "", f"cannot be written: {error.strerror}") from None

    def _put_in_place(self) -> None:
        """Move all staged files to the target folder, after checking all destinations. Raises InputError."""
        files = sorted(path for path in self.staging.rglob("*") if path.is_file())
        places = {path: self.target / path.relative_to(self.staging) for path in files}
        for place in places.values():
            _check_free(place, within=self.target)
        try:
            for path in files:
                sync(path)
            for path, place in places.items():
                place.parent.mkdir(parents=True, exist_ok=True)
                path.replace(place)
            for folder in {place.parent for place in places.values()}:
                sync(folder)
        except OSError as error:
            raise InputError(self.target, "", f"cannot be written: {error.strerror}") from None

    def discard(self) -> None:
        """Remove the staged files and release the lock. Repeated calls have no effect."""
        shutil.rmtree(self.staging, ignore_errors=True)
        if self._held >= 0:
            os.close(self._held)
            self._held = -1


def _sweep(target: Path) -> None:
    """Remove killed processes' staging folders: a live one holds a lock on its folder, also across namespaces."""
    for stale in target.glob(f"{STAGING}*"):
        with suppress(OSError):
            opened = os.open(stale, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(stale, ignore_errors=True)
            finally:
                os.close(opened)


def _check_free(place: Path, *, within: Path) -> None:
    """Raise InputError if a folder exists where a file must go, or a file where a folder must go, inside `within`."""
    for folder in place.parents:
        if folder == within:
            break
        if folder.exists() and not folder.is_dir():
            raise InputError(folder, "", "is not a folder, so the output cannot be written there")
    if place.is_dir():
        raise InputError(place, "", "is a folder, so the output file of that name cannot be written")


@contextmanager
def held_back() -> Iterator[None]:
    """Suppress what libraries write to stderr's file descriptor, unless other threads are running."""
    if threading.active_count() > 1:
        yield
        return
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
