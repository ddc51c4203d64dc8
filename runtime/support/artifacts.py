"""Files written atomically: under a temporary name, synced and renamed; and pictures."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
import stat
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from runtime.errors import InputError
from runtime.records import U8

STAGING = ".phasestack-staging-"


def sync(path: Path) -> None:
    """Sync a file's data or a folder's names to disk, against power cuts. Raises OSError."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def put_in_place(part: Path, path: Path) -> None:
    """Rename a file to its name for good. Raises OSError."""
    sync(part)
    part.replace(path)
    sync(path.parent)


def write_bytes(path: Path, data: bytes, *, like: Path | None = None) -> None:
    """Write a file atomically, creating its parents. Raises InputError.

    like: the file whose owner and readers it has; None: the one that it replaces, where there is one.
    """
    like = like or path
    try:
        before = like.stat() if like.is_file() else None
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise InputError(path, "", f"cannot be written ({error.strerror})") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        if before is not None:
            with suppress(PermissionError):  # somebody else's: it becomes ours
                os.chown(name, before.st_uid, before.st_gid)
        Path(name).chmod(0o644 if before is None else stat.S_IMODE(before.st_mode))
        if any(part.startswith(STAGING) for part in path.parts):  # an OutputFolder has it on the disk at its end
            Path(name).replace(path)
        else:
            put_in_place(Path(name), path)
    except BaseException as error:
        Path(name).unlink(missing_ok=True)
        if isinstance(error, OSError):  # a full or failing disk
            raise InputError(path, "", f"cannot be written ({error.strerror})") from None
        raise


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def to_json(value: Any) -> str:
    """JSON text; arrays become lists, non-finite numbers null (JSON has none)."""
    try:
        return json.dumps(value, allow_nan=False, default=_listed)
    except (ValueError, TypeError):  # there is such a number somewhere, or a key that is no text
        return json.dumps(_finite(value), allow_nan=False)


def _listed(item: Any) -> Any:
    """What the encoder itself does not know."""
    if isinstance(item, np.ndarray | np.generic):
        return item.tolist()
    raise TypeError(f"{type(item).__name__} is nothing that JSON has")


def _finite(item: Any) -> Any:
    if isinstance(item, dict):
        return {str(key): _finite(child) for key, child in item.items()}
    if isinstance(item, list | tuple):
        return [_finite(child) for child in item]
    if isinstance(item, np.ndarray | np.generic):
        return _finite(item.tolist())
    return None if isinstance(item, float) and not np.isfinite(item) else item


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically, one object, readable."""
    write_text(path, json.dumps(json.loads(to_json(value)), indent=1) + "\n")


def png_bytes(image: U8) -> bytes:
    """An (h, w, 3 or 4) RGB(A) or (h, w) grey image as PNG; alpha is dropped."""
    import cv2

    bgr = image if image.ndim == 2 else np.ascontiguousarray(image[..., 2::-1])
    done, buffer = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise ValueError("PNG encoding failed")
    return buffer.tobytes()


def write_png(path: Path, image: U8) -> None:
    """Write a PNG atomically; alpha is dropped."""
    write_bytes(path, png_bytes(image))


class OutputFolder:
    """A folder whose new files appear together at the end, or not at all.

    Used as a context manager: write into `staging`; on success every file is renamed into `target`,
    replacing those of the same names; on an error nothing new is left. What a killed process left staged is cleared
    away by the next one that writes here.
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
            fcntl.flock(self._held, fcntl.LOCK_EX)  # for as long as this process lives
        except OSError as error:
            raise InputError(self.target, "", f"cannot be written ({error.strerror})") from None
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
        if isinstance(error, InputError) and error.source.startswith(str(self.staging)):  # a name that nobody gave
            file = self.target / Path(error.source).relative_to(self.staging)
            raise InputError(file, error.field, error.problem) from None
        if isinstance(error, OSError) and str(error.filename or "").startswith(str(self.staging)):
            raise InputError(self.target, "", f"cannot be written ({error.strerror})") from None

    def _put_in_place(self) -> None:
        """Rename every staged file. Raises InputError, with nothing replaced, where something is in the way of one."""
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
            raise InputError(self.target, "", f"cannot be written ({error.strerror})") from None

    def discard(self) -> None:
        """Remove what was staged so far, before the end."""
        shutil.rmtree(self.staging, ignore_errors=True)
        if self._held >= 0:
            os.close(self._held)
            self._held = -1


def _sweep(target: Path) -> None:
    """What killed processes left staged: nobody holds it any more, in whichever namespace they were."""
    for left in target.glob(f"{STAGING}*"):
        with suppress(OSError):
            opened = os.open(left, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(left, ignore_errors=True)
            finally:
                os.close(opened)


def _check_free(place: Path, *, within: Path) -> None:
    """Raise InputError where a folder is in a file's place, or a file in that of a folder it needs."""
    for folder in place.parents:
        if folder == within:
            break
        if folder.exists() and not folder.is_dir():
            raise InputError(folder, "", "is no folder: it is in the way of an output")
    if place.is_dir():
        raise InputError(place, "", "is a folder: it is in the way of an output")


@dataclass(slots=True)
class Held:
    """What was written, once the block is left."""

    text: str = ""

    @property
    def first_line(self) -> str:
        """Empty where there is none."""
        return next((line.strip() for line in self.text.splitlines() if line.strip()), "")


@contextmanager
def held_back() -> Iterator[Held]:
    """Hold back what this block's libraries write to the file descriptor of stderr.

    Only where this is the sole thread: the descriptor is the whole process's, and another's lines would be held too.
    """
    held = Held()
    if threading.active_count() > 1:
        yield held
        return
    kept = os.dup(2)
    buffer = os.memfd_create("stderr")
    os.dup2(buffer, 2)
    try:
        yield held
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        data = os.pread(buffer, 1 << 16, 0)
        os.close(buffer)
        held.text = data.decode(errors="replace")
