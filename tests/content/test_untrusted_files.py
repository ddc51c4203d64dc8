"""Tests that files beyond the limits are refused by their headers, quickly and in one line."""

from __future__ import annotations

import base64
import io
import json
import os
import struct
import subprocess
import sys
import time
import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import EpsImagePlugin, Image

from runtime.clock import MonotonicClock
from runtime.commands.eyes_looking import _frames
from runtime.config import ContentSettings, SensorSettings
from runtime.content.frames import open_frames
from runtime.content.mesh import load_mesh
from runtime.content.registry import prepare_content
from runtime.errors import InputError, SensorLost
from runtime.optics.stack import PanelStack
from runtime.sensor.usb_camera import UsbCameraDriver
from runtime.support.picture_file import read_image
from runtime.support.progress import listening
from runtime.support.untrusted_input import LIMITS
from tests.calls import refusal
from tests.content.gltf_files import Buffer
from tests.content.picture_files import make_video

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
HANG_S = 30  # these once took minutes, or never ended


def png(width: int, height: int, mode: str = "L") -> bytes:
    """A whole black PNG."""
    file = io.BytesIO()
    Image.new(mode, (width, height)).save(file, "PNG")
    return file.getvalue()


def png_header(width: int, height: int, *, bits: int = 8) -> bytes:
    """PNG whose header alone has this size."""
    small = png(1, 1)
    body = b"IHDR" + struct.pack(">IIB", width, height, bits) + small[25:29]
    return small[:12] + body + struct.pack(">I", zlib.crc32(body)) + small[33:]


def refused(path: Path, **settings: Any) -> str:
    """The one line with which content is refused."""
    return refusal(prepare_content, ContentSettings(scene=str(path), **settings), STACK)


def test_an_unknown_name_is_one_line_with_what_there_is() -> None:
    assert refused(Path("nothing")).startswith("content: scene: `nothing`") and "demo" in refused(Path("nothing"))


@pytest.mark.parametrize(("width", "height"), [(60_000, 60_000), (32_000, 32_000), (12000, 12000), (70_000, 2)])
def test_a_large_picture_is_refused_by_its_header_with_figure_and_limit(
    tmp_path: Path, width: int, height: int
) -> None:
    path = tmp_path / "large.png"
    path.write_bytes(png_header(width, height))
    told = f"{path}: has {width} x {height} pixels; the maximum is 134,217,728"
    assert refused(path) == refusal(read_image, path) == told


def test_a_picture_of_sixteen_bits_a_channel_may_have_half_the_pixels(tmp_path: Path) -> None:
    """One megabyte of file took 2.5 GB."""
    path = tmp_path / "deep.png"
    path.write_bytes(png_header(16_384, 8192, bits=16))
    assert refused(path) == f"{path}: has 16384 x 8192 pixels of 16 bits per channel; the maximum is 67,108,864"


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
    assert {"fifo": "is a FIFO", "folder": "the folder contains no pictures", "zero": "is a device"}[what] in line


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "WEBP"])
def test_a_folder_s_pictures_are_compared_after_exif_rotation(tmp_path: Path, kind: str) -> None:
    for number, orientation in enumerate((1, 6, 8, 3)):
        exif = Image.Exif()
        exif[0x0112] = orientation
        turned = orientation in (6, 8)
        size = (20, 60) if turned else (60, 20)
        picture = Image.new("RGB", size, (200, 10 * number, 0))
        picture.save(tmp_path / f"{number}.{kind.lower()[:4]}", kind, exif=exif)
    frames = open_frames(tmp_path, ContentSettings())
    assert {frames.frame(index).shape for index in range(frames.count)} == {(20, 60, 3)}


def test_a_large_video_is_refused_and_a_smaller_one_is_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = make_video(tmp_path / "a.mp4", [(10,) * 3, (200,) * 3], (320, 240), "mp4v")
    assert open_frames(path, ContentSettings()).count == 2
    monkeypatch.setattr(LIMITS, "pixels", 50_000)
    assert "320 x 240 pixels; the maximum is 50,000" in refused(path)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_a_playlist_under_a_videos_name_opens_no_other_file(tmp_path: Path, name: str) -> None:
    """FFmpeg recognises a container by its content, and a playlist names files and addresses."""
    other = make_video(tmp_path / "secret.mp4", [(10,) * 3, (200,) * 3], (64, 48), "mp4v")
    for text in (
        f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{other}\n#EXT-X-ENDLIST\n",
        f"ffconcat version 1.0\nfile {other}\n",
    ):
        (tmp_path / name).write_text(text)
        assert "cannot be decoded as a film" in refused(tmp_path / name)


def test_a_script_under_a_film_s_name_opens_no_other_file(tmp_path: Path) -> None:
    other = make_video(tmp_path / "secret.mp4", [(10,) * 3, (200,) * 3], (64, 48), "mp4v")
    for name, text in (("a.mp4", f"ffconcat version 1.0\nfile {other}\n"), ("concat:secret.mp4", "")):
        (tmp_path / name).write_text(text)
        with pytest.raises(InputError, match="cannot be decoded as a film"):
            list(_frames(tmp_path / name, 0, 30.0))
        with pytest.raises(SensorLost, match="cannot be opened"):
            UsbCameraDriver(SensorSettings(source=str(tmp_path / name), fov_deg=60.0), MonotonicClock()).open()


def painted(folder: Path, *pictures: bytes) -> Path:
    """A triangle for each picture."""
    b = Buffer()
    corners, uv = b.add([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), b.add([[0, 0], [1, 0], [0, 1]])
    count = len(pictures)
    primitives = [{"attributes": {"POSITION": corners, "TEXCOORD_0": uv}, "material": k} for k in range(count)]
    return b.write(
        folder / "a.gltf",
        {},
        meshes=[{"primitives": primitives}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": k}}} for k in range(count)],
        textures=[{"source": k} for k in range(count)],
        images=[{"uri": "data:image/png;base64," + base64.b64encode(coded).decode()} for coded in pictures],
    )


def test_all_textures_together_have_a_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Forty textures of one 20 KB picture took 2.8 GB and eight minutes."""
    monkeypatch.setattr(LIMITS, "texture_pixels", 100_000)
    told = refused(painted(tmp_path, png(300, 300), png(301, 300)))
    assert told.endswith("textures' pixels: 180,300 exceeds the limit of 100,000")


def test_a_texture_starts_no_program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pillow hands an EPS to Ghostscript."""
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)
    eps = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 64\n%%EndComments\nshowpage\n%%EOF\n"
    assert "is PostScript, which is not supported" in refused(painted(tmp_path, eps))
    assert not (tmp_path / "started").exists()


READS = """
import resource, sys
from pathlib import Path
from runtime.support.picture_file import read_image
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print(read_image(Path(sys.argv[1])).shape, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""


def test_a_transparent_16_bit_picture_takes_little_extra_memory(tmp_path: Path) -> None:
    """One megabyte of file took 11 GB: 82 bytes a pixel."""
    cv2.imwrite(str(tmp_path / "a.png"), np.full((2048, 2048, 4), 0x8080, np.uint16))
    command = [sys.executable, "-c", READS, str(tmp_path / "a.png")]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    shape, _, used = done.stdout.rpartition(" ")
    assert shape == "(2048, 2048, 3)" and int(used) * 1024 < 30 * 2048 * 2048


@pytest.mark.parametrize("text", ["{}=1", "[{}]", "a={{{}=1}}", 'a=["""\n", """, {{{}=1}}]'])
@pytest.mark.parametrize("part", ["a", '"a,=[]"', "'\"'"])
def test_a_key_of_very_many_parts_is_refused_before_it_is_read(tmp_path: Path, text: str, part: str) -> None:
    """Eighty kilobytes took 5.4 GB."""
    (tmp_path / "list.toml").write_text(text.format(".".join([part] * 20_000)))
    begun_s = time.monotonic()
    assert "a key has more than 16 parts" in refused(tmp_path / "list.toml")
    assert time.monotonic() - begun_s < 5


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
        (9, 10_000_000, "element face: 10,000,000 exceeds the limit of 2,000,000"),
        (10**18, 1, "exceeds the limit of 6,000,000"),
        (9, 1_999_999, "the file is truncated; the header declares 1,999,999 elements"),
        ("²", 1, "element vertex: must be a non-negative whole number, not ²"),
        (9, "²", "element face: must be a non-negative whole number, not ²"),
        ("9" * 5000, 1, "element vertex: has 5000 digits"),
        (9, "-4", "element face: must be a non-negative whole number, not -4"),
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
    assert "faces: 120 exceeds the limit of 100" in refused(tmp_path / "a.obj")


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
LARGE_URI = PNG_TYPE + base64.b64encode(png_header(32_000, 32_000)).decode()
VECTOR = {"componentType": 5126, "type": "VEC3"}
GLTFS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("nodes: 20,000 exceeds the limit", gltf(nodes=[{"mesh": 0}] * 20_000, scenes=[{"nodes": [*range(20_000)]}])),
    ("nodes: are nested deeper than 64", gltf(nodes=[*({"children": [k + 1]} for k in range(99)), {"mesh": 0}])),
    ("", gltf(nodes=[{"children": [0], "mesh": 0}])),  # a circle, which ends
    ("accessors[0].count: 1,000,000,000 exceeds the limit", gltf(accessors=[VECTOR | {"count": 10**9}] * 2)),
    ("uri: gone.bin does not exist", gltf(buffers=[{"uri": "gone.bin", "byteLength": 9}])),
    ("faces: the file contains no faces", gltf(meshes=[], nodes=[], scenes=[{"nodes": []}])),
    ("uri: the path contains a NUL", gltf(buffers=[{"byteLength": 48, "uri": "a%00b.bin"}])),
    ("uri: is not a valid path: File name too long", gltf(buffers=[{"byteLength": 48, "uri": "a" * 300}])),
    ("is not a local file", gltf(buffers=[{"byteLength": 48, "uri": "http://localhost/a.bin"}])),
    ("is an absolute path", gltf(buffers=[{"byteLength": 48, "uri": "/etc/passwd"}])),
    ("uri: is a device", gltf(buffers=[{"byteLength": 48, "uri": "zero.bin"}])),
    ("uri: gone.png does not exist", textured(0, [{"source": 0}], [{"uri": "gone.png"}])),
    ("texture: images[0] cannot be decoded", textured(0, [{"source": 0}], [{"uri": f"{PNG_TYPE}iVBORw0KGgo="}])),
    ("texture: images[0] has 32000 x 32000 pixels", textured(0, [{"source": 0}], [{"uri": LARGE_URI}])),
    ("textures: hold KTX2 pictures; save the model without that compression",
     textured(0, [{"extensions": {"KHR_texture_basisu": {"source": 0}}}], [{"uri": PNG_URI}])),
    ("extensionsRequired: EXT_meshopt_compression: meshopt is not supported; save the model without",
     gltf(extensionsRequired=["EXT_meshopt_compression"])),
    ("extensionsRequired: ADOBE_x is not supported", gltf(extensionsRequired=["ADOBE_x"])),
    ("asset.version: is 1.0, which is not supported; convert it", gltf(asset={"version": "1.0"}, accessors={"a": {}})),
    ("is damaged or is not glTF: an accessor extends beyond its buffer view",
     gltf(accessors=[VECTOR | {"bufferView": 0, "count": 99}] * 2)),
    ("is damaged or is not glTF: a reference points to a missing object",
     gltf(accessors=[VECTOR | {"count": 1}, *gltf()["accessors"][1:]])),
    ("is damaged or is not glTF: a value has the wrong type", gltf(nodes=7)),
    ("buffers[0].uri: is missing", gltf(buffers=[{"byteLength": 48}])),
)  # fmt: skip


@pytest.mark.parametrize(("told", "table"), GLTFS)
def test_a_gltf_is_refused_by_what_it_says_of_itself(tmp_path: Path, told: str, table: dict[str, Any]) -> None:
    (tmp_path / "zero.bin").symlink_to("/dev/zero")
    path = tmp_path / "a.gltf"
    path.write_text(json.dumps(table))
    start = time.monotonic()
    if told:
        assert told in refused(path)
    else:  # strange, and bounded
        load_mesh(path)
    assert time.monotonic() - start < HANG_S


@pytest.mark.parametrize("suffix", [".gltf", ".obj"])
@pytest.mark.parametrize("name", ["../skin.png", "maps/../../skin.png"])
def test_a_mesh_reads_nothing_outside_its_folder(tmp_path: Path, suffix: str, name: str) -> None:
    path = tmp_path / "scene" / f"a{suffix}"
    (path.parent / "maps").mkdir(parents=True)
    (tmp_path / "skin.png").write_bytes(png(4, 4))
    (path.parent / "a.mtl").write_text(f"newmtl a\nmap_Kd {name}\n")
    obj = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"
    path.write_text(obj if suffix == ".obj" else json.dumps(textured(0, [{"source": 0}], [{"uri": name}])))
    assert f"{name} is outside this file's folder" in refused(path)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a.fbx", "is a 3D scene (.fbx), which is not supported; export it as glTF (.glb), for example with Blender"),
        ("a.usdz", "is a USD scene (.usdz), which is not supported; export it as glTF"),
        ("a.3mf", "is a CAD or 3D-print model (.3mf), which is not supported; export it as STL or glTF"),
        ("a.xyz", "is a point cloud (.xyz), which is not supported; save it as PLY"),
        ("a.LCC", "is a compressed splat file (.lcc), which is not supported; convert it with `npx @playcanvas"),
        ("a.wmv", "is a film (.wmv), which is not supported; convert it with `ffmpeg -i in.wmv out.mp4`"),
        ("a.glb", "is a Git LFS pointer; fetch the file itself with `git lfs pull`"),
        ("a.ply", "is a Git LFS pointer"),
    ],
)
def test_a_file_of_another_kind_is_called_by_its_name(tmp_path: Path, name: str, told: str) -> None:
    (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 9\n")
    assert refused(tmp_path / name).startswith(f"{tmp_path / name}: {told}")


@pytest.mark.parametrize("suffix", [".gltf", ".glb"])
@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, '{"nodes":' + "[" * 70 + "]" * 70 + "}"])
def test_json_that_nests_too_deep_is_refused(tmp_path: Path, suffix: str, text: str) -> None:
    path, data = tmp_path / f"a{suffix}", text.encode()
    chunk = struct.pack("<I", len(data)) + b"JSON" + data
    path.write_bytes(data if suffix == ".gltf" else b"glTF" + struct.pack("<II", 2, 12 + len(chunk)) + chunk)
    assert refused(path).endswith("the JSON is nested more than 64 levels deep")


def test_json_of_too_many_values_is_refused_before_it_is_parsed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A file of 98 MB with 7.5 million nodes took 4 GB and 44 s."""
    monkeypatch.setattr(LIMITS, "json_values", 100)
    (tmp_path / "a.gltf").write_text(json.dumps(gltf() | {"nodes": [{}] * 60}))
    assert "JSON values: 1" in (told := refused(tmp_path / "a.gltf")) and told.endswith("exceeds the limit of 100")


def test_files_beside_an_obj_are_read_only_if_they_are_files(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "fifo.png")
    (tmp_path / "a.obj").write_text("mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl a\nf 1 2 3\n")
    for line, told in (("map_Kd fifo.png", "is a FIFO"), ("map_Kd /etc/passwd", "absolute"), ("map_Kd a\0b", "NUL")):
        (tmp_path / "a.mtl").write_text(f"newmtl a\n{line}\n")
        assert told in refused(tmp_path / "a.obj")


def test_a_loading_that_takes_too_long_is_given_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.gltf").write_text(json.dumps(gltf()))
    monkeypatch.setattr(LIMITS, "load_s", 1e-9)
    line = refused(tmp_path / "a.gltf")
    assert "takes longer than 1e-09 s to load" in line


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
