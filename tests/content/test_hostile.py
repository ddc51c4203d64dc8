"""Files that promise too much, nest too deep or are no files: refused from their headers, in one line, in no time."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import time
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from runtime.config import ContentSettings
from runtime.content.mesh import load_mesh
from runtime.content.pictures import open_frames
from runtime.content.registry import prepare_content
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.support.artifacts import read_image
from runtime.support.progress import listening
from runtime.support.untrusted_input import LIMITS
from tests.content.gltf_files import Buffer

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
HANG_S = 30  # what took minutes, or for ever


def png(width: int, height: int) -> bytes:
    """A whole grey PNG."""
    file = io.BytesIO()
    Image.new("L", (width, height)).save(file, "PNG")
    return file.getvalue()


def png_header(width: int, height: int) -> bytes:
    """As much of it as says the size."""
    small = png(1, 1)
    body = b"IHDR" + struct.pack(">II", width, height) + small[24:29]
    return small[:12] + body + struct.pack(">I", zlib.crc32(body)) + small[33:]


def refused(path: Path, **settings: Any) -> str:
    """The one line with which content is refused."""
    with pytest.raises(InputError) as caught:
        prepare_content(ContentSettings(scene=str(path), **settings), STACK)
    line = str(caught.value)
    assert "\n" not in line and "\0" not in line and len(line) < 1000
    return line


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (32_000, 32_000), (12000, 12000), (70_000, 2)])
def test_a_large_picture_is_refused_by_its_header_with_the_figure_and_the_limit(
    tmp_path: Path, width: int, height: int
) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png_header(width, height))
    told = f"{path}: has {width} x {height} pixels; at most 134,217,728"
    assert refused(path) == told
    with pytest.raises(InputError) as caught:
        read_image(path)
    assert str(caught.value) == told


@pytest.mark.parametrize("suffix", [".png", ".mp4", ".glb", ".obj", ".ply"])
@pytest.mark.parametrize("what", ["fifo", "folder", "zero"])
def test_only_files_are_read_and_nothing_waits(tmp_path: Path, suffix: str, what: str) -> None:
    path = tmp_path / f"a{suffix}"
    if what == "fifo":
        os.mkfifo(path)
    elif what == "folder":
        path.mkdir()
    else:
        path.symlink_to("/dev/zero")
    start = time.monotonic()
    line = refused(path)
    assert time.monotonic() - start < HANG_S
    assert {"fifo": "is a FIFO", "folder": "the folder holds no pictures", "zero": "is a device"}[what] in line


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_pictures_of_a_folder_that_are_turned_by_exif_are_one_size_with_those_that_are_not(
    tmp_path: Path, kind: str
) -> None:
    for number, orientation in enumerate((1, 6, 8, 3)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        turned = orientation in (6, 8)
        size = (20, 60) if turned else (60, 20)
        picture = Image.new("RGB", size, (200, 10 * number, 0))
        picture.save(tmp_path / f"{number}.{kind.lower()[:4]}", kind, exif=exif)
    frames = open_frames(tmp_path, ContentSettings())
    assert {frames.frame(index).shape for index in range(frames.count)} == {(20, 60, 3)}


def video(path: Path, size: tuple[int, int]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, size)
    for value in (10, 200):
        writer.write(np.full((size[1], size[0], 3), value, np.uint8))
    writer.release()
    return path


def test_a_large_video_is_refused_and_one_of_the_right_size_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = video(tmp_path / "a.mp4", (320, 240))
    assert open_frames(path, ContentSettings()).count == 2
    monkeypatch.setattr(LIMITS, "pixels", 50_000)
    assert "320 x 240 pixels; at most 50,000" in refused(path)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_playlist_under_a_videos_name_opens_no_other_file(tmp_path: Path, name: str) -> None:
    """FFmpeg tells a container by its content, and a playlist names files and addresses."""
    other = video(tmp_path / "secret.mp4", (64, 48))
    for text in (
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n",
        f"ffconcat version 1.0\nfile {other}\n",
    ):
        (tmp_path / name).write_text(text)
        assert "is not a video that can be decoded" in refused(tmp_path / name)


def ply(folder: Path, vertices: Any, faces: Any, form: str = "binary_little_endian") -> Path:
    path = folder / "a.ply"
    head = f"ply\nformat {form} 1.0\nelement vertex {vertices}\n"
    head += "property float x\nproperty float y\nproperty float z\n"
    head += f"element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    path.write_bytes(head.encode("latin-1") + bytes(200))
    return path


@pytest.mark.parametrize(
    ("vertices", "faces", "told"),
    [
        (9, 10_000_000, "element face: 10,000,000 is over the limit of 2,000,000"),
        (10**18, 1, "is over the limit of 6,000,000"),
        (9, 1_999_999, "the file is cut off: 1,999,999 are promised in"),
        ("²", 1, "element vertex: is not a whole number: ²"),
        (9, "²", "element face: is not a whole number: ²"),
        ("9" * 5000, 1, "element vertex: is a number of 5000 digits"),
        (9, "-4", "element face: is not a whole number: -4"),
    ],
)
@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_ply_that_promises_too_much_is_refused(
    tmp_path: Path, vertices: Any, faces: Any, told: str, form: str
) -> None:
    start = time.monotonic()
    assert told in refused(ply(tmp_path, vertices, faces, form))
    assert time.monotonic() - start < HANG_S


def test_an_obj_of_too_many_triangles_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LIMITS, "triangles", 100)
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\n" + "f 1 2 3 1 2\n" * 40)
    assert "faces: 120 is over the limit of 100" in refused(tmp_path / "a.obj")


def gltf(**changes: Any) -> dict[str, Any]:
    """A triangle, embedded."""
    b = Buffer()
    attributes = {"POSITION": b.add([[0, 0, 0], [1, 0, 0], [0, 1, 0]])}
    return b.table({"attributes": attributes, "indices": b.add([0, 1, 2], np.uint32)}, **changes)


def textured(material_texture: Any, textures: Any, images: Any) -> dict[str, Any]:
    table = gltf(images=images, textures=textures)
    table["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": material_texture}}}]
    table["meshes"][0]["primitives"][0]["material"] = 0
    return table


PNG_TYPE = "data:image/png;base64,"
PNG_URI = PNG_TYPE + base64.b64encode(png(4, 4)).decode()
GLTFS: dict[str, tuple[dict[str, Any], str]] = {
    "20,000 instances": (
        gltf(nodes=[{"mesh": 0}] * 20_000, scenes=[{"nodes": list(range(20_000))}]),
        "nodes: 2,001 is over the limit of 2,000",
    ),
    "a chain of nodes": (
        gltf(nodes=[*({"children": [k + 1]} for k in range(99)), {"mesh": 0}]),
        "nodes: are nested deeper than 64",
    ),
    "a circle of nodes": (gltf(nodes=[{"children": [0], "mesh": 0}]), ""),
    "a child before the first": (gltf(nodes=[{"children": [-1]}]), "-1 is no index, count or size"),
    "a count": (
        gltf(accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}] * 2),
        "accessors[0].count: 1,000,000,000 is over the limit of 20,000,000",
    ),
    "a negative count": (gltf(accessors=[{"componentType": 5126, "count": -1, "type": "VEC3"}] * 2), "-1 is no index"),
    "a buffer that is not there": (
        gltf(buffers=[{"uri": "gone.bin", "byteLength": 9}]),
        "buffers[0].uri: gone.bin is not there",
    ),
    "a short buffer": (
        gltf(buffers=[{"uri": "data:base64,MTI=", "byteLength": 9}]),
        "buffers[0]: its 2 bytes are fewer than the 9 promised",
    ),
    "a number for a list": (gltf(buffers=5), "is damaged, or no glTF (TypeError"),
    "nothing": (gltf(meshes=[], nodes=[], scenes=[]), "faces: there are none"),
    "a URI with NUL": (gltf(buffers=[{"byteLength": 48, "uri": "a%00b.bin"}]), "buffers[0].uri: the path holds a NUL"),
    "a long name": (
        gltf(buffers=[{"byteLength": 48, "uri": "a" * 300}]),
        "buffers[0].uri: is no path (File name too long)",
    ),
    "an address": (gltf(buffers=[{"byteLength": 48, "uri": "http://localhost/a.bin"}]), "only files beside this one"),
    "an absolute path": (gltf(buffers=[{"byteLength": 48, "uri": "/etc/passwd"}]), "is an absolute path"),
    "a device": (gltf(buffers=[{"byteLength": 48, "uri": "zero.bin"}]), "buffers[0].uri: is a device"),
    "a missing texture": (textured(0, [{"source": 0}], [{"uri": "gone.png"}]), "texture: gone.png is not there"),
    "a broken texture": (
        textured(0, [{"source": 0}], [{"uri": "data:image/png;base64,iVBORw0KGgo="}]),
        "texture: images[0] is not an image that can be decoded",
    ),
    "a large texture": (
        textured(0, [{"source": 0}], [{"uri": PNG_TYPE + base64.b64encode(png_header(32_000, 32_000)).decode()}]),
        "texture: images[0] has 32000 x 32000 pixels; at most",
    ),
    "a texture without a picture": (
        textured(0, [{"extensions": {"KHR_texture_basisu": {"source": 0}}}], [{"uri": PNG_URI}]),
        "textures: hold a picture in a format that is not understood",
    ),
    "a compression": (
        gltf(extensionsRequired=["KHR_draco_mesh_compression"]),
        "extensionsRequired: KHR_draco_mesh_compression is not understood",
    ),
}


@pytest.mark.parametrize("name", GLTFS)
def test_a_gltf_is_refused_by_what_it_says_of_itself(tmp_path: Path, name: str) -> None:
    table, told = GLTFS[name]
    (tmp_path / "zero.bin").symlink_to("/dev/zero")
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(table))
    start = time.monotonic()
    if told:
        assert told in refused(path)
    else:  # strange, and bounded
        load_mesh(path)
    assert time.monotonic() - start < HANG_S


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '{"nodes":' + "[" * 70 + "]" * 70 + "}"])
def test_json_that_nests_too_deep_is_refused(tmp_path: Path, suffix: str, text: str) -> None:
    path, data = tmp_path / f"a{suffix}", text.encode()
    chunk = struct.pack("<I", len(data)) + b"JSON" + data
    path.write_bytes(data if suffix == ".gltf" else b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk)
    assert refused(path).endswith("JSON is nested deeper than 64")


def test_what_lies_beside_an_obj_is_read_only_where_it_is_a_file(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.png")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    for line, told in (
        ("map_Kd gone.png", "texture: gone.png is not there"),
        ("map_Kd fifo.png", "is a FIFO"),
        ("map_Kd /etc/passwd", "absolute"),
        ("map_Kd a\0b", "NUL"),
    ):
        (tmp_path / "a.mtl").write_text(f"newmtl a\n{line}\n")
        assert told in refused(tmp_path / "a.obj")


def test_a_loading_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.gltf").write_text(json.dumps(gltf()))
    monkeypatch.setattr(LIMITS, "load_s", 1e-9)
    line = refused(tmp_path / "a.gltf")
    assert "takes longer to load than 1e-09 s" in line


def test_loading_tells_how_far_it_is_and_can_be_stopped(tmp_path: Path) -> None:
    nodes = [{"mesh": 0, "translation": [k, 0, 0]} for k in range(50)]
    (tmp_path / "a.gltf").write_text(json.dumps(gltf(nodes=nodes, scenes=[{"nodes": list(range(50))}])))
    told: list[tuple[str, int, int | None]] = []
    with listening(lambda *what: told.append(what)):
        load_mesh(tmp_path / "a.gltf")
    assert ("a.gltf: parts", 49, 50) in told

    def stop(what: str, done: int, total: int | None) -> None:
        if done == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), listening(stop):
        load_mesh(tmp_path / "a.gltf")
