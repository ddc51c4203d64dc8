"""Read untrusted input (paths, files, JSON, numbers) within limits.

All untrusted bytes are read through this module. For invalid input, the functions raise InputError with a one-line
message that names the file (`source`, by default the path), the `field` and, if applicable, the limit that was
exceeded.
"""

from __future__ import annotations

import errno
import json
import os
import stat
import unicodedata
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from runtime.errors import InputError

JSON_DEPTH_MAX = 64  # maximum depth of nested objects, well within Python's recursion limit
JSON_BYTES_MAX = 64 << 20  # maximum size of a JSON file
DIGITS_MAX = 19  # maximum number of decimal digits: enough for a 63-bit number
MIB = 1 << 20


@dataclass(slots=True)
class Limits:
    """Limits for untrusted files, which are checked before memory is allocated."""

    file_bytes: int = 1 << 30  # size of a content file or of a recording
    pixels: int = 134_217_728  # number of pixels in one picture: 16384 x 8192
    texture_pixels: int = 134_217_728  # total number of pixels in all of a scene's pictures
    triangles: int = 2_000_000  # number of triangles in a scene, summed over all instances
    splats: int = 3_000_000
    instances: int = 10_000  # number of placed meshes in a glTF scene
    json_values: int = 4_000_000  # number of values in one JSON text; this many take a gigabyte in Python
    depth: int = 64  # nesting depth in JSON or in a glTF scene
    load_s: float = 120.0  # time for loading one piece of content
    start_s: float = 600.0  # time for startup, which loads the content and the model
    recording_s: float = 21_600.0  # length of a replayed recording
    chunk_bytes: int = 32 << 20  # unpacked size of one chunk or message in a recording


LIMITS = Limits()  # not configurable; tests lower them


def checked_path(path: str | Path, *, source: str | Path = "", field: str = "") -> Path:
    """Return a path, which need not exist. Raises InputError if it is too long or not UTF-8."""
    try:
        os.lstat(path)
    except ValueError:
        raise InputError(source or str(path), field, "the path contains a NUL character or is not UTF-8") from None
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            raise InputError(source or str(path), field, f"is not a valid path: {error.strerror}") from None
    return Path(path)


def path_within_folder(path: str, *, source: str | Path, field: str) -> Path:
    """Return the normalized relative path, which need not exist, from an untrusted file in the same
    folder. Symbolic links are not resolved, because the owner of the folder has put them there. Raises InputError if
    the path is invalid, absolute, or leads out of the folder.
    """
    name = Path(os.path.normpath(checked_path(path, source=source, field=field)))
    if name.is_absolute():
        problem = "is an absolute path"
    elif name.parts[:1] == (os.pardir,):
        problem = "is outside this file's folder"
    else:
        return name
    raise InputError(
        source, field, f"{shown(path, most=200)} {problem}; only files in this folder or below it are read"
    )


def spelled(folder: Path, name: Path) -> Path | None:
    """Return the existing file with a relative name in a folder, or None. As on systems that write such
    names, letter case and the Unicode form of letters such as é may differ.
    """
    if (folder / name).exists():
        return folder / name
    for step in name.parts:
        alike = {_folded(other.name): other for other in folder.iterdir()} if folder.is_dir() else {}
        folder = alike.get(_folded(step), folder / step)
    return folder if folder.exists() else None


def _folded(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def is_there(path: str | Path, *, folder: bool = False) -> bool:
    """Return True if a path exists and, for `folder`, is one. Raises InputError if it cannot be checked."""
    checked = checked_path(path)
    try:
        return checked.is_dir() if folder else checked.exists()
    except OSError as error:
        raise InputError(path, "", f"cannot be read: {error.strerror}") from None


def open_regular(
    path: str | Path, *, most_bytes: int | None = None, source: str | Path = "", field: str = ""
) -> IO[bytes]:
    """Open a regular file of at most `most_bytes` for reading. Raises InputError if that fails. Never
    blocks, unlike `open` on a FIFO without a writer. The open file is checked, so that it cannot be exchanged in the
    meantime.
    """
    name = source or str(path)
    checked = checked_path(path, source=source, field=field)
    try:
        number = os.open(checked, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY)
    except OSError as error:
        raise InputError(name, field, f"cannot be read: {error.strerror}") from None
    try:
        status = os.fstat(number)
        if not stat.S_ISREG(status.st_mode):
            raise InputError(name, field, f"is {_kind(status.st_mode)}, not a file")
        if most_bytes is not None and status.st_size > most_bytes:
            raise InputError(name, field, f"has {_size(status.st_size)}, but the maximum is {_size(most_bytes)}")
        return os.fdopen(number, "rb")
    except BaseException:
        os.close(number)
        raise


def read_bytes(path: str | Path, *, most_bytes: int, source: str | Path = "", field: str = "") -> bytes:
    """Read a regular file, with the arguments and errors of `open_regular`."""
    name = source or str(path)
    with open_regular(path, most_bytes=most_bytes, source=source, field=field) as file:
        try:
            size = min(os.fstat(file.fileno()).st_size, most_bytes)
            data = file.read(size + 1)  # allocates only the current size
            if len(data) > size:  # the file has grown since it was opened
                data += file.read(most_bytes + 1 - len(data))
        except OSError as error:
            raise InputError(name, field, f"cannot be read: {error.strerror}") from None
    if len(data) > most_bytes:
        raise InputError(name, field, f"exceeds the maximum size of {_size(most_bytes)}")
    return data


def read_text(path: str | Path, *, most_bytes: int = JSON_BYTES_MAX) -> str:
    """Read a text file in UTF-8, or in UTF-16 with a byte-order mark. Raises InputError for others."""
    return decoded(read_bytes(path, most_bytes=most_bytes), source=path)


def decoded(data: bytes, *, source: str | Path) -> str:
    """Decode UTF-8 text, or UTF-16 with a byte-order mark as some Windows programs save it, and drop the
    mark. Raises InputError if the data are neither.
    """
    try:
        return data.decode("utf-16" if data.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(source, "", f"is not valid {error.encoding.upper()} at byte {error.start}") from None


def read_json(path: str | Path, *, most_bytes: int = JSON_BYTES_MAX) -> Any:
    """Read a JSON file of at most `most_bytes`. Raises InputError as `parsed_json` does."""
    return parsed_json(read_bytes(path, most_bytes=most_bytes), source=path)


def parsed_json(text: str | bytes, *, source: str | Path, most_depth: int = JSON_DEPTH_MAX) -> Any:
    """Parse strict JSON, which excludes NaN, Infinity and repeated keys. Raises InputError if it is
    malformed, contains too many values or is nested deeper than `most_depth`.
    """
    data = text if isinstance(text, bytes) else text.encode(errors="surrogatepass")
    within(sum(map(data.count, (b",", b"{", b"["))), LIMITS.json_values, source=source, field="JSON values")
    try:
        value = json.loads(
            decoded(data, source=source), parse_constant=_no_constant, parse_int=_whole, object_pairs_hook=_object
        )
        if _depth(value) <= most_depth:
            return value
    except json.JSONDecodeError as error:
        raise InputError(
            source, "", f"malformed JSON at line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except ValueError as error:
        raise InputError(source, "", f"malformed JSON: {error}") from None
    except RecursionError:
        pass
    raise InputError(source, "", f"the JSON is nested more than {most_depth} levels deep")


def _depth(value: Any) -> int:
    """Return the nesting depth of lists and objects."""
    if isinstance(value, dict):
        return 1 + max(map(_depth, value.values()), default=0)
    if isinstance(value, list):
        return 1 + max(map(_depth, value), default=0)
    return 0


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    value: dict[str, Any] = {}
    for key, item in pairs:
        if key in value:
            raise ValueError(f'the key "{shown(key)}" is repeated')
        value[key] = item
    return value


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a JSON number")


def _whole(digits: str) -> int | float:
    # Python raises ValueError for more than 4,300 digits, and needs quadratic time for fewer digits.
    return int(digits) if len(digits) <= 400 else float(digits)


def whole_from_text(text: str, *, source: str | Path, field: str) -> int:
    """Parse a non-negative integer. Raises InputError for other text and for more than DIGITS_MAX digits."""
    # `isdigit` alone accepts a superscript two, and `int` accepts digits from other scripts.
    if not (text.isascii() and text.isdigit()):
        raise InputError(source, field, f"must be a non-negative whole number, not {shown(text)}")
    if len(text) > DIGITS_MAX:
        raise InputError(source, field, f"has {len(text)} digits, but the maximum is {DIGITS_MAX}")
    return int(text)


def within(count: int | float, most: int | float, *, source: str | Path, field: str) -> None:
    """Check a count against a limit. Raises InputError with the `field` counted, such as `JSON values`."""
    if count > most:
        raise InputError(source, field, f"{count:,} exceeds the limit of {most:,}")


def shown(value: Any, *, most: int = 40) -> str:
    """Return an untrusted value as printable text of about `most` characters or fewer."""
    if isinstance(value, int) and value.bit_length() > 256:
        return f"a number of about {int(value.bit_length() * 0.30103) + 1} digits"
    text = value if isinstance(value, str) else repr(value)
    safe = "".join(c if c.isprintable() else "?" for c in text[: most + 1])
    return safe if len(safe) <= most else safe[:most] + "..."


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFCHR: "a device",
        stat.S_IFBLK: "a device",
        stat.S_IFSOCK: "a socket",
    }
    return kinds.get(stat.S_IFMT(mode), "something else")


def _size(count: int) -> str:
    return f"{count / MIB:.1f} MiB" if count >= MIB else f"{count} bytes"
