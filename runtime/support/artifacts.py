"""Files that are whole or not there: written under a temporary name and renamed."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from runtime.errors import InputError
from runtime.records import U8


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically, making its parents. Raises InputError where the folder can't be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    except OSError as error:
        raise InputError(path, "", f"cannot be written ({error.strerror})") from None
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
        Path(name).chmod(0o644)
        Path(name).replace(path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    write_bytes(path, text.encode())


def to_json(value: Any) -> str:
    """JSON text; arrays become lists, non-finite numbers null (JSON has none)."""

    def plain(item: Any) -> Any:
        if isinstance(item, dict):
            return {str(key): plain(child) for key, child in item.items()}
        if isinstance(item, list | tuple):
            return [plain(child) for child in item]
        if isinstance(item, np.ndarray):
            return plain(item.tolist())
        if isinstance(item, np.generic):
            return plain(item.item())
        if isinstance(item, float) and not np.isfinite(item):
            return None
        return item

    return json.dumps(plain(value), allow_nan=False)


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


def read_image(path: Path) -> U8:
    """(h, w, 3) RGB of any format that OpenCV reads. Raises InputError, naming the file."""
    import cv2

    from runtime.support.picture_header import read_coded

    data = read_coded(path)
    # libpng would write a line of its own to stderr about a file that is cut off.
    cut_off = data.startswith(b"\x89PNG") and b"IEND" not in data
    image = None if cut_off or not data else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(path, "", "is not an image that can be decoded")
    return np.ascontiguousarray(image[..., ::-1])


class OutputFolder:
    """A folder whose new files appear together at the end, or not at all.

    Used as a context manager: write into `staging`; on success every file is renamed into `target`,
    replacing those of the same names; on an error nothing new is left.
    """

    def __init__(self, target: Path) -> None:
        self.target = target

    def __enter__(self) -> Self:
        try:
            missing = [folder for folder in (self.target, *self.target.parents) if not folder.exists()]
            self.target.mkdir(parents=True, exist_ok=True)
            self.staging = Path(tempfile.mkdtemp(prefix=".phasestack-", dir=self.target))
        except OSError as error:
            raise InputError(self.target, "", f"cannot be written ({error.strerror})") from None
        self._made = missing
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is None:
            for path in sorted(self.staging.rglob("*")):
                if path.is_file():
                    destination = self.target / path.relative_to(self.staging)
                    destination.parent.mkdir(parents=True, exist_ok=True)
                    path.replace(destination)
        shutil.rmtree(self.staging, ignore_errors=True)
        if kind is not None:
            for folder in self._made:
                if not any(folder.iterdir()):
                    folder.rmdir()
