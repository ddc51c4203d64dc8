"""Lists every reader of untrusted bytes, with good files and how to call it."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import tomlkit
import trimesh
from PIL import Image

from calib.pairs import read_pairs
from calib.setup_run import read_progress
from runtime.clock import MonotonicClock, SimulatedClock
from runtime.config import ContentSettings, Settings, load_settings, load_stack
from runtime.content.compressed_splats import load_compressed, load_compressed_splats, load_splat
from runtime.content.frames import open_frames
from runtime.content.gaussians import bounds, load_gaussians, of_points
from runtime.content.layout import layout_of
from runtime.content.mesh import load_mesh
from runtime.content.parts import merged
from runtime.content.placing import SceneFile
from runtime.content.playlist import read_playlist
from runtime.content.ply import read_header
from runtime.content.triangles import DrawnPart
from runtime.daemon.server import StatusServer
from runtime.errors import PhasestackError
from runtime.eyes.calibration import DEMO_FILE, load_calibration
from runtime.model.contract import METADATA_KEY, parse_contract
from runtime.model.session import ModelSession
from runtime.optics.stack import PanelStack
from runtime.panels.edid import parse
from runtime.panels.lut import measured_curve
from runtime.records import EyePoints, Intrinsics, SensorFrame
from runtime.sensor.recording import RecordingWriter
from runtime.sensor.recording_format import RecordingHeader
from runtime.sensor.replay import ReplayDriver
from runtime.support.untrusted_input import parsed_json
from tests.content.gltf_files import Buffer
from tests.content.packed_splat_files import write_compressed, write_sog, write_splat, write_spz
from tests.content.picture_files import film, heic_pair, lif, mpo, st3d, swapped_profile
from tests.content.test_gltf import compressed, square
from tests.content.test_splat import splat_table
from tests.content.test_untrusted_files import PNG_URI, gltf, textured
from tests.panels.edids import block
from tests.sensor.taken import taken_until

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 64, 36)
MIB = 1 << 20
LOW = {"pixels": 4 * MIB, "triangles": 50_000, "splats": 50_000, "instances": 200}
LOW |= {"file_bytes": 16 * MIB, "chunk_bytes": 2 * MIB}
MODELS = sorted((Path(__file__).resolve().parents[2] / "runtime" / "model" / "data").glob("*.onnx"))
EYES = EyePoints(np.array([[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]), np.ones(2))


@dataclass(frozen=True)
class Target:
    """One reader. `read` raises only PhasestackError, for files it refuses."""

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes, Path], object]


def at(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


def file(name: str, read: Callable[[Path], object], *, json_marks: bytes = b"") -> Callable[[bytes, Path], object]:
    """A reader of files of one name; those that begin with one of the marks are called `a.json`."""
    return lambda data, folder: read(at(folder, "a.json" if data and data[0] in json_marks else name, data))


# Recordings


def recordings() -> list[bytes]:
    colour, depth = np.full((12, 16, 3), 90, np.uint8), np.full((12, 16), 700, np.uint16)
    camera = Intrinsics(16, 12, 60.0, 61.0, 8.0, 6.0)
    made = []
    for header, parts in (
        (RecordingHeader(driver="a"), {"eyes": EYES, "true_eyes_m": np.zeros((2, 3))}),
        (
            RecordingHeader(driver="b", colour=True, depth=True),
            {"eyes": EYES, "colour": colour, "depth_mm": depth, "intrinsics": camera},
        ),
        (RecordingHeader(driver="c", depth=True), {"depth_mm": depth, "intrinsics": camera}),
    ):
        held = io.BytesIO()
        writer = RecordingWriter(held, header)
        for k in range(12):
            writer.write(SensorFrame(k + 1, 10**9 + k * 33_333_333, **parts))  # type: ignore[arg-type]
        writer.finish()
        made.append(held.getvalue())
    return made


def recording(path: Path) -> object:
    driver = ReplayDriver(str(path), SimulatedClock())
    driver.open()
    return len(taken_until(driver, 1 << 62))


# Tables


def configs() -> list[bytes]:
    table = json.loads(Settings().model_dump_json())
    table["sensor"].pop("fixed_eyes_m")
    table["content"].pop("background")
    some = b"[loop]\nrate_hz = 60\n[stack]\nx_m=[-0.06,0,0.06]\n"
    return [tomlkit.dumps(table).encode(), b"[model]\nname = 'fast'\n", some]


def panels() -> list[bytes]:
    table = {"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0.0, 0.06], "width_px": 64, "height_px": 36}
    return [json.dumps(table).encode()]


def pairs() -> list[bytes]:
    names = ["sensor_x", "sensor_y", "sensor_z", "stack_x", "stack_y", "stack_z"]
    rows = [[k / 10, 0.1, 0.6, 0.6, k / 10, 0.2] for k in range(5)]
    text = "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)])
    return [text.encode(), json.dumps([dict(zip(names, row, strict=True)) for row in rows]).encode()]


def tables() -> list[bytes]:
    """Calibration files other than pairs; the first line selects the reader."""
    return [
        b"phase,grey\n0,0\n0.4,0.5\n1,1\n",
        b"phase,red,green,blue\n0,0,0,0\n1,1,1,1\n",
        b'{"done": {"geometry": {"width_m": 0.5}}}',
    ]


def table(path: Path) -> object:
    return read_progress(path) if path.read_bytes()[:1] == b"{" else measured_curve(path)


# Models


def contracts() -> list[bytes]:
    kept = [{entry.key: entry.value for entry in onnx.load(path).metadata_props} for path in MODELS]
    return [held[METADATA_KEY].encode() for held in kept]


def contract(data: bytes, folder: Path) -> object:
    return parse_contract({METADATA_KEY: data.decode("utf-8", errors="replace")}, source="a.onnx")


def checkpoints() -> list[bytes]:
    import torch

    first, other = io.BytesIO(), io.BytesIO()
    torch.save({"model": {"subnets.in_conv.0.weight": torch.zeros(2, 3, 3, 3)}, "iteration": 5}, first)
    torch.save({"model": {"a": torch.zeros(3)}, "recipe": {"steps": []}}, other, _use_new_zipfile_serialization=False)
    return [first.getvalue(), other.getvalue()]


def checkpoint(path: Path) -> object:
    from model_export.checkpoint import load_checkpoint

    return load_checkpoint(path)


# Content


def pictures() -> list[bytes]:
    random = np.random.default_rng(1)
    codes = random.integers(0, 255, (2, 24, 32, 3)).astype(np.uint8)
    first, second = (Image.fromarray(part) for part in codes)
    exif = Image.Exif()
    exif[0x0112] = 6
    made = []
    for kind, mode in (*((kind, "RGB") for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP", "AVIF")), ("PNG", "RGBA")):
        held = io.BytesIO()
        told = {"exif": exif, "icc_profile": swapped_profile()} if mode == "RGB" and kind != "BMP" else {}
        first.convert(mode).save(held, kind, **told)
        made.append(held.getvalue())
    for kind, mode in (("JPEG", "CMYK"), ("TIFF", "CMYK"), ("TIFF", "I;16"), ("TGA", "RGB"), ("PPM", "RGB")):
        held = io.BytesIO()
        first.convert("L" if mode == "I;16" else mode).convert(mode).save(held, kind)
        made.append(held.getvalue())
    made.append(made[1][:2] + b"\xff\xe3\0\x10_JPSJPS_\0\4\0\4\2\1" + made[1][2:])  # a stereo header
    for kind in ("GIF", "PNG", "WEBP", "AVIF"):
        held = io.BytesIO()
        first.save(held, kind, save_all=True, append_images=[second], duration=50)
        made.append(held.getvalue())
    with tempfile.TemporaryDirectory() as folder:
        made.append(mpo(Path(folder) / "a.mpo", *codes).read_bytes())
        made.append(lif(Path(folder) / "a.jpg", *codes).read_bytes())
        made.append(heic_pair(Path(folder) / "a.heic", list(codes), group=(0, 1)).read_bytes())
    return made


def picture(data: bytes, folder: Path) -> object:
    path = at(folder, "a.mpo", data)
    with contextlib.suppress(PhasestackError):
        open_frames(folder, ContentSettings()).frame(0)
    return open_frames(path, ContentSettings()).frame(0)


def videos() -> list[bytes]:
    made = []
    with tempfile.TemporaryDirectory() as folder:
        for name, code in (("a.mp4", "mp4v"), ("a.avi", "MJPG")):
            writer = cv2.VideoWriter(f"{folder}/{name}", cv2.VideoWriter.fourcc(*code), 10, (64, 48))
            for value in (10, 100, 200):
                writer.write(np.full((48, 64, 3), value, np.uint8))
            writer.release()
            made.append((Path(folder) / name).read_bytes())
        frame = np.full((48, 64, 3), 90, np.uint8)
        for name, tags in (("a.mp4", {"added": st3d(2)}), ("a.mkv", {"mode": 1})):
            made.append(film(Path(folder) / name, frame, **tags).read_bytes())
    return made


def video(path: Path) -> object:
    with contextlib.closing(open_frames(path, ContentSettings())) as frames:
        return [frames.frame(index).shape for index in range(min(frames.count, 5))]


def box(kind: str, *, texture: bool = False, **options: Any) -> bytes:
    made = trimesh.creation.box((1, 1, 1))
    if texture:
        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 0, 0)))
        made.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((8, 2)), material=material)
    data = made.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else bytes(data)


def skinned() -> dict[str, Any]:
    """A strip with every kind of attribute, a skin, a morph, a sparse accessor, a transform and a sampler."""
    b = Buffer()
    primitive = square(b, mode=5)
    primitive["attributes"] |= {"COLOR_0": b.add([[1, 0.5, 0.2, 0.4]] * 4), "JOINTS_0": b.add([[0] * 4] * 4, np.uint8)}
    primitive["attributes"]["WEIGHTS_0"] = b.add([[255, 0, 0, 0]] * 4, np.uint8, normalized=True)
    primitive["targets"] = [{"POSITION": b.add([[0, 0, 1]] * 4)}]
    b.add([1], np.uint8)
    values = {"bufferView": b.accessors[b.add([[2, 2, 2]])]["bufferView"]}
    indices = {"bufferView": values["bufferView"] - 1, "componentType": 5121}
    b.accessors[primitive["attributes"]["POSITION"]]["sparse"] = {"count": 1, "indices": indices, "values": values}
    use = {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2], "rotation": 0.5}}}
    material = {"pbrMetallicRoughness": {"baseColorTexture": use}, "emissiveTexture": use, "emissiveFactor": [1, 0, 0]}
    return b.table(
        {},
        meshes=[{"primitives": [primitive], "weights": [0.5]}],
        nodes=[{"mesh": 0, "skin": 0}, {"rotation": [0, 0, 0.7, 0.7]}],
        scenes=[{"nodes": [0, 1]}],
        skins=[{"joints": [1], "inverseBindMatrices": b.add([np.eye(4)])}],
        materials=[{**material, "alphaMode": "BLEND"}],
        textures=[{"source": 0, "sampler": 0}],
        samplers=[{"wrapS": 33648, "magFilter": 9728}],
        images=[{"uri": PNG_URI}],
    )


def gltfs() -> list[bytes]:
    held = [gltf(), textured(0, [{"source": 0}], [{"uri": PNG_URI}]), skinned()]
    with tempfile.TemporaryDirectory() as folder:
        draco = compressed(Path(folder) / "a.gltf", required=True, fallback=False).read_bytes()
    return [*(json.dumps(table).encode() for table in held), draco]


def mesh(path: Path) -> object:
    """Loaded, and its outlines looked for."""
    data = load_mesh(path)
    places = SceneFile(path, ContentSettings(), STACK).placed(data.low, data.high, facing=data.facing)
    return places, [DrawnPart(part) for part in merged(data.parts)], [of_points(*some) for some in data.points]


def points() -> list[bytes]:
    cloud = trimesh.PointCloud(np.random.default_rng(0).random((9, 3)), np.full((9, 4), 200, np.uint8))
    return [bytes(cloud.export(file_type="ply"))]


def splats() -> list[bytes]:
    """A PLY of random splats."""
    values = np.random.default_rng(2).normal(size=(20, len(SPLAT))).astype("<f4")
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 20\n"
    return [(head + "".join(f"property float {name}\n" for name in SPLAT) + "end_header\n").encode() + values.tobytes()]


def compressed_splats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.ply"
        return [write_compressed(path, splat_table(20, degree=1), harmonics=has).read_bytes() for has in (False, True)]


def small_splats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [write_splat(Path(folder) / "a.splat", splat_table(20, degree=0)).read_bytes()]


def spz_splats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        table = splat_table(20, degree=1)
        made = [write_spz(Path(folder) / "a.spz", table, version=k).read_bytes() for k in (1, 2, 3, 4)]
        return [*made, gzip.decompress(made[1])]


@cache
def sog_files() -> dict[str, bytes]:
    """The files of a SOG, unpacked, by their names."""
    with tempfile.TemporaryDirectory() as folder:
        made = write_sog(Path(folder) / "a", splat_table(20, degree=1))
        return {path.name: path.read_bytes() for path in made.iterdir()}


def sog_folder(data: bytes, folder: Path) -> object:
    """They, with other bytes as their table."""
    for name, held in (sog_files() | {"meta.json": data}).items():
        at(folder, name, held)
    return bounds(load_compressed_splats(folder))


def names() -> list[bytes]:
    return [b"a_qs8x6a0.75 (1).png", b"film.3D.HSBS.1080p.mkv", b"vr180_sbs.mp4", b"x_half-top-bottom.jpg", b"a_LR.png"]


def named(data: bytes, folder: Path) -> object:
    """The layout of a picture of this name."""
    layout = layout_of(Path(data[:80].decode("utf-8", "replace")), ContentSettings())
    with contextlib.suppress(ValueError):  # too many views for it
        return layout.views(np.zeros((16, 32, 3), np.uint8))
    return None


def sog_splats() -> list[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        return [write_sog(Path(folder) / f"{k}.sog", splat_table(20, degree=k)).read_bytes() for k in (0, 1)]


PLACE, LOOK = ["x", "y", "z", "opacity"], ["f_dc_0", "f_dc_1", "f_dc_2"]
SPLAT = [*PLACE, *LOOK, *(f"scale_{k}" for k in range(3)), *(f"rot_{k}" for k in range(4))]
PLAYLIST = """
repeat = false
show = [
  { scene = "demo", seconds = 2, scale = 1.5, offset_m = [0.0, 0.01, 0.0] },
  { scene = "a.png", seconds = 0.5, layout = "side-by-side" },
  { scene = "lego_bulldozer", file = "a.ply", seconds = 86400, axes = "+y -x" },
]
"""


# Other programs


def requests() -> list[bytes]:
    names = ("status", "scene", "pause", "resume", "flat", "budget", "reload")
    return [json.dumps({"command": name, "value": "demo"}).encode() + b"\n" for name in names]


@cache
def server() -> StatusServer:
    return StatusServer(Path(tempfile.mkdtemp(prefix="phasestack-fuzz-")) / "s", clock=MonotonicClock())


def request(data: bytes, folder: Path) -> None:
    for line in data.split(b"\n")[:20]:
        answer = server().answer(line)
        if isinstance(answer, dict):
            json.dumps(answer)
    while not server().commands.empty():
        server().commands.get()


TARGETS: dict[str, Target] = {
    "recording": Target(recordings, file("a.mcap", recording)),
    "config": Target(configs, file("a.toml", load_settings)),
    "panels": Target(panels, file("a.json", lambda path: load_stack(path, width_px=64, height_px=36))),
    "calibration": Target(lambda: [DEMO_FILE.read_bytes()], file("a.toml", load_calibration)),
    "pairs": Target(pairs, file("a.csv", read_pairs, json_marks=b"[{")),
    "tables": Target(tables, file("a.csv", table)),
    "contract": Target(contracts, contract),
    "model": Target(
        lambda: [path.read_bytes() for path in MODELS], file("a.onnx", lambda path: ModelSession(path, threads=1))
    ),
    "checkpoint": Target(checkpoints, file("a.pth", checkpoint)),
    "picture": Target(pictures, picture),
    "video": Target(videos, file("a.mp4", video)),
    "gltf": Target(gltfs, file("a.gltf", mesh)),
    "glb": Target(lambda: [box("glb"), box("glb", texture=True)], file("a.glb", mesh)),
    "obj": Target(lambda: [box("obj")], file("a.obj", mesh)),
    "ply": Target(lambda: [box("ply", encoding=form) for form in ("binary", "ascii")], file("a.ply", mesh)),
    "off": Target(lambda: [box("off")], file("a.off", mesh)),
    "points": Target(points, file("a.ply", mesh)),
    "stl": Target(lambda: [box("stl"), box("stl_ascii")], file("a.stl", mesh)),
    "splat": Target(splats, file("a.ply", lambda path: bounds(load_gaussians(read_header(path))))),
    "compressed": Target(compressed_splats, file("a.ply", lambda path: bounds(load_compressed(read_header(path))))),
    "dotsplat": Target(small_splats, file("a.splat", lambda path: bounds(load_splat(path)))),
    "spz": Target(spz_splats, file("a.spz", lambda path: bounds(load_compressed_splats(path)))),
    "sog": Target(sog_splats, file("a.sog", lambda path: bounds(load_compressed_splats(path)))),
    "sogfolder": Target(lambda: [sog_files()["meta.json"]], sog_folder),
    "name": Target(names, named),
    "playlist": Target(
        lambda: [PLAYLIST.encode(), b'{"show": [{"scene": "flat", "seconds": 3}]}'],
        file("a.toml", lambda path: read_playlist(path, ContentSettings()), json_marks=b"{"),
    ),
    "socket": Target(requests, request),
    "edid": Target(lambda: [block(serial_text="S1"), block(serial_number=7)], lambda data, _: parse(data)),
    "json": Target(
        lambda: [*panels(), b'{"a": [1, 2.5, null, "x\\u00e9"]}'], lambda data, _: parsed_json(data, source="a.json")
    ),
}
