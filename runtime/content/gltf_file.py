"""Read the JSON, buffers, accessors and pictures in a glTF 2.0 file.

No existing library is suitable: trimesh drops samplers, sparse accessors and normalized integers, pygltflib does not
decode accessors, and assimp-py does not return embedded pictures.
"""

from __future__ import annotations

import base64
import binascii
import math
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote_to_bytes

import numpy as np
from numpy.typing import NDArray

from runtime.content.parts import texture_of
from runtime.errors import InputError
from runtime.records import F32, U8
from runtime.support import untrusted_input
from runtime.support.picture_header import check_size, decoded_picture, picture_size
from runtime.support.untrusted_input import LIMITS

Table = dict[str, Any]
Array = NDArray[Any]
Read = Callable[[str], bytes]  # reads a file that the scene refers to, given its URI or name

ELEMENTS_PER_TRIANGLE = 10  # most elements in all accessors together, per triangle allowed by the limits
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
SHAPES = {"SCALAR": (1,), "VEC2": (2,), "VEC3": (3,), "VEC4": (4,), "MAT2": (2, 2), "MAT3": (3, 3), "MAT4": (4, 4)}
PICTURE_EXTENSIONS = ("EXT_texture_webp", "EXT_texture_avif")  # formats that are decoded, unlike KTX2
COMPRESSED = {
    "KHR_draco_mesh_compression": "Draco",
    "EXT_meshopt_compression": "meshopt",
    "KHR_meshopt_compression": "meshopt",
    "KHR_texture_basisu": "KTX2",
}
BEFORE_JSON = b"\xef\xbb\xbf\xff\xfe\0 \t\r\n"  # byte-order marks and spaces
WAY_OUT = "save the model without that compression, with Blender or `gltf-transform`"


class GltfFile:
    """Reads objects in a glTF 2.0 file by number. All methods raise LookupError, TypeError or ValueError
    if the file is malformed, and InputError if data are missing, unsupported or larger than a limit.
    """

    def __init__(self, path: Path, data: bytes, read: Read) -> None:
        if data[:4] != b"glTF" and not data.lstrip(BEFORE_JSON).startswith((b"{", b"[")):
            raise InputError(path, "", "is not a glTF file, or is damaged; export it again")
        text, self._binary = (data, b"") if data[:4] != b"glTF" else _chunks(path, data)
        self.path, self._read = path, read
        self.table: Table = untrusted_input.parsed_json(text, source=path, most_depth=LIMITS.depth)
        if str(self.table["asset"]["version"]).startswith("1"):
            raise InputError(path, "asset.version", VERSION_1)
        self._buffers: dict[int, bytes] = {}
        self._pictures: dict[int, U8] = {}
        elements = 0
        for number, accessor in enumerate(self.all("accessors")):
            elements += _count(accessor)
            most = ELEMENTS_PER_TRIANGLE * LIMITS.triangles
            untrusted_input.within(elements, most, source=path, field=f"accessors[{number}].count")

    def all(self, kind: str) -> list[Table]:
        """Return all objects of a given kind, such as `meshes`. The list is empty if the file has none."""
        objects: list[Table] = self.table.get(kind, [])
        return objects

    def item(self, kind: str, index: int) -> Table:
        """Return an object by kind and index. Raises IndexError if the index is negative or too large."""
        items = self.all(kind)
        return items[range(len(items))[index]]

    def count(self, accessor: int) -> int:
        return _count(self.item("accessors", accessor))

    def accessor(self, index: int, *, rows: Array | None = None, as_float: bool = True) -> Array:
        """Return an accessor's elements (n, ...), or those of `rows`, as float32 by `fractions` or as stored."""
        accessor = self.item("accessors", index)
        values = self._stored(accessor)
        if "sparse" in accessor:
            values = values.copy()
            sparse = accessor["sparse"]
            common = {"count": sparse["count"], "type": accessor["type"], "componentType": accessor["componentType"]}
            places = self._stored({**common, **sparse["indices"], "type": "SCALAR"})[:, 0]
            values[places] = self._stored({**common, **sparse["values"]})
        values = values if rows is None else values[rows]
        return fractions(values, accessor) if as_float else values

    def _stored(self, accessor: Table) -> Array:
        """Return a strided view of an accessor's bytes, or zeros if it has no buffer view."""
        count, shape = _count(accessor), SHAPES[accessor["type"]]
        dtype = np.dtype(COMPONENTS[accessor["componentType"]])
        column = shape[0] * dtype.itemsize
        # Each column of a matrix starts at a multiple of four bytes.
        steps = (column,) if len(shape) == 1 else (-(-column // 4) * 4, dtype.itemsize)
        size = column if len(shape) == 1 else steps[0] * shape[1]
        strides = (dtype.itemsize,) if len(shape) == 1 else steps
        if "bufferView" not in accessor:
            return np.zeros((count, *shape), dtype)
        data, stride = self.view(accessor["bufferView"])
        stride, first = stride or size, accessor.get("byteOffset", 0)
        if not (first >= 0 and dtype.itemsize <= stride) or (count and first + stride * (count - 1) + size > len(data)):
            raise ValueError("an accessor extends beyond its buffer view")
        if not count:
            return np.zeros((0, *shape), dtype)
        return np.ndarray((count, *shape), dtype, data, first, (stride, *strides))

    def view(self, index: int) -> tuple[memoryview, int]:
        """Return a buffer view's bytes, and its stride in bytes (0 if its elements are contiguous)."""
        view = self.item("bufferViews", index)
        number, first, size = view["buffer"], view.get("byteOffset", 0), view["byteLength"]
        buffer = self._buffer(number)
        if not (0 <= first <= first + size <= len(buffer)):
            raise ValueError(f"bufferViews[{index}] extends beyond its buffer")
        return memoryview(buffer)[first : first + size], view.get("byteStride", 0)

    def _buffer(self, number: int) -> bytes:
        if number not in self._buffers:
            buffer = self.item("buffers", number)
            if "uri" in buffer:
                self._buffers[number] = self._of_uri(buffer["uri"])
            elif number == 0 and self._binary:
                self._buffers[number] = self._binary
            else:
                self._buffers[number] = self._without_data(number, buffer)
        return self._buffers[number]

    def _without_data(self, number: int, buffer: Table) -> bytes:
        if any(name in buffer.get("extensions", {}) for name in COMPRESSED):
            raise InputError(self.path, f"buffers[{number}]", f"is compressed with meshopt; {WAY_OUT}")
        raise InputError(self.path, f"buffers[{number}].uri", "is missing, so the file is incomplete")

    def _of_uri(self, uri: str) -> bytes:
        if not uri.startswith("data:"):
            return self._read(uri)
        head, _, coded = uri.partition(",")
        if not head.endswith(";base64"):
            return unquote_to_bytes(coded)
        try:
            return base64.b64decode(coded)
        except binascii.Error as error:
            raise ValueError(f"a data URI is not valid base64: {error}") from None

    def picture(self, texture: Table) -> U8:
        """Return a texture as RGBA (h, w, 4), after `check_pictures`. Raises InputError."""
        number = self._image_of(texture)
        if number not in self._pictures:
            image = decoded_picture(self._coded(number), source=self.path, field="texture", name=f"images[{number}]")
            self._pictures[number] = texture_of(image)
        return self._pictures[number]

    def check_pictures(self, textures: list[Table]) -> None:
        """Check all pictures' headers. Raises InputError if one, or all together, have too many pixels."""
        pixels = 0
        for number in sorted({self._image_of(texture) for texture in textures}):
            coded = self._coded(number)
            with suppress(ValueError):
                size = picture_size(coded)
                check_size(*size, source=self.path, field="texture", name=f"images[{number}]", head=coded)
                pixels += math.prod(size)
            untrusted_input.within(pixels, LIMITS.texture_pixels, source=self.path, field="textures' pixels")

    def _image_of(self, texture: Table) -> int:
        """Return the number of a texture's image, preferring formats added by extensions. Raises InputError."""
        own: Table = texture.get("extensions", {})
        for offered in (*(own[name] for name in PICTURE_EXTENSIONS if name in own), texture):
            if offered.get("source") is not None:
                number: int = range(len(self.all("images")))[offered["source"]]
                return number
        known = [f"{COMPRESSED[name]} pictures; {WAY_OUT}" for name in own if name in COMPRESSED]
        problem = "hold " + "".join(known[:1] or ["a picture in an unsupported format"])
        raise InputError(self.path, "textures", problem)

    def _coded(self, number: int) -> bytes:
        """Return an image's encoded bytes."""
        image = self.item("images", number)
        return self._of_uri(image["uri"]) if "uri" in image else bytes(self.view(image["bufferView"])[0])


def fractions(values: Array, accessor: Table) -> F32:
    """Convert an accessor's numbers to float32. Normalized integers become fractions (section 3.6.2.2)."""
    floats = np.asarray(values, np.float32)
    if accessor.get("normalized", False) and values.dtype.kind in "iu":
        floats = np.maximum(floats / np.float32(np.iinfo(values.dtype).max), np.float32(-1.0))
    return floats


def _count(accessor: Table) -> int:
    count = accessor["count"]
    if not isinstance(count, int) or count < 0:
        raise ValueError("an accessor's count is not a whole number")
    return count


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Return a GLB file's JSON text and binary buffer (section 4.4.3). Raises InputError if the file is cut off."""
    if int.from_bytes(data[4:8], "little") == 1:
        raise InputError(path, "asset.version", VERSION_1)
    size = int.from_bytes(data[12:16], "little")
    if data[16:20] != b"JSON" or len(data) < 20 + size:
        raise InputError(path, "", "is truncated or malformed: a GLB file must begin with a JSON chunk")
    text, first = data[20 : 20 + size].rstrip(b"\0 "), 20 + size  # some writers pad with zeros instead of spaces
    while first + 8 <= len(data):
        size = int.from_bytes(data[first : first + 4], "little")
        if data[first + 4 : first + 8] == b"BIN\0":
            return text, data[first + 8 : first + 8 + size]
        first += 8 + size
    return text, b""


VERSION_1 = (
    "is 1.0, which is not supported; convert it to glTF 2.0 with Blender or `gltf-pipeline -i old.gltf -o new.glb`"
)
