"""Every reader of foreign bytes: good files to begin with, how it is called, and what it may raise."""

from __future__ import annotations

import contextlib
import io
import json
import threading
from collections.abc import Callable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import SimulatedClock
from runtime.config import ContentSettings, LimitSettings, Settings
from runtime.errors import PhasestackError
from runtime.optics.stack import PanelStack
from tests.sensor.taken import taken_until

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 64, 36)
LIMITS = LimitSettings(pixels=1 << 22, triangles=50_000, splats=50_000, instances=200, file_mib=16, chunk_mib=2)


@dataclass(frozen=True)
class Target:
    """One reader. `read` raises PhasestackError for what it refuses, and nothing else."""

    seeds: Callable[[], list[bytes]]
    read: Callable[[bytes, Path], object]


def _at(folder: Path, name: str, data: bytes) -> Path:
    path = folder / name
    path.write_bytes(data)
    return path


# Recordings


def _recordings() -> list[bytes]:
    from runtime.records import EyePoints, Intrinsics, SensorFrame
    from runtime.sensor.recording import RecordingWriter
    from runtime.sensor.recording_format import RecordingHeader

    eyes = EyePoints(np.array([[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]), np.ones(2))
    colour, depth = np.full((12, 16, 3), 90, np.uint8), np.full((12, 16), 700, np.uint16)
    camera = Intrinsics(16, 12, 60.0, 61.0, 8.0, 6.0)
    made = []
    for header, parts in (
        (RecordingHeader(driver="a", truth=True), {"eyes": eyes, "true_eyes_m": np.zeros((2, 3))}),
        (
            RecordingHeader(driver="b", colour=True, depth=True),
            {"eyes": eyes, "colour": colour, "depth_mm": depth, "intrinsics": camera},
        ),
        (RecordingHeader(driver="c", eye_points=False, depth=True), {"depth_mm": depth, "intrinsics": camera}),
    ):
        file = io.BytesIO()
        writer = RecordingWriter(file, header)
        for k in range(12):
            writer.write(SensorFrame(k + 1, 10**9 + k * 33_333_333, **parts))  # type: ignore[arg-type]
        writer.finish()
        made.append(file.getvalue())
    return made


def _recording(data: bytes, folder: Path) -> object:
    from runtime.sensor.replay import ReplayDriver

    driver = ReplayDriver(str(_at(folder, "a.mcap", data)), SimulatedClock(), limits=LIMITS)
    driver.open()
    return len(taken_until(driver, 1 << 62))


def _eye_packets() -> list[bytes]:
    from runtime.records import EyePoints
    from runtime.sensor.eye_packets import EyePacket, encode

    eyes = EyePoints(np.array([[0.03, 0.0, 0.6], [-0.03, 0.0, 0.6]]), np.ones(2))
    return [b"".join(encode(EyePacket(k, 1000 * k, eyes if k % 3 else None)) for k in range(12))]


def _eye_packet(data: bytes, folder: Path) -> object:
    from runtime.sensor.eye_packets import PacketReader

    reader = PacketReader()
    return [reader.feed(data[at : at + 37]) for at in range(0, len(data), 37)]


# Tables


def _configs() -> list[bytes]:
    import tomlkit

    table = json.loads(Settings().model_dump_json())
    table["sensor"].pop("fixed_eyes_m")
    table["content"].pop("background")
    return [
        tomlkit.dumps(table).encode(),
        b"[model]\nname = 'fast'\n",
        b"[loop]\nrate_hz = 60\n[stack]\nx_m=[-0.06,0,0.06]\n",
    ]


def _config(data: bytes, folder: Path) -> object:
    from runtime.config import load_settings

    return load_settings(_at(folder, "a.toml", data))


def _panels() -> list[bytes]:
    table = {"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0.0, 0.06], "width_px": 64, "height_px": 36}
    return [json.dumps(table).encode()]


def _panel(data: bytes, folder: Path) -> object:
    from runtime.config import load_stack

    return load_stack(_at(folder, "a.json", data), width_px=64, height_px=36)


def _calibrations() -> list[bytes]:
    from runtime.eyes.calibration import DEMO_FILE

    return [DEMO_FILE.read_bytes()]


def _calibration(data: bytes, folder: Path) -> object:
    from runtime.eyes.calibration import load_calibration

    return load_calibration(_at(folder, "a.toml", data))


def _pairs() -> list[bytes]:
    names = ["sensor_x", "sensor_y", "sensor_z", "stack_x", "stack_y", "stack_z"]
    rows = [[k / 10, 0.1, 0.6, 0.6, k / 10, 0.2] for k in range(5)]
    text = "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)])
    return [text.encode(), json.dumps([dict(zip(names, row, strict=True)) for row in rows]).encode()]


def _pair(data: bytes, folder: Path) -> object:
    from calib.pairs import read_pairs

    return read_pairs(_at(folder, "a.json" if data[:1] in b"[{" else "a.csv", data))


def _tables() -> list[bytes]:
    """What calibration reads besides pairs: the first line tells which reader it is for."""
    greys = "\n".join(f"{grey},{0.1 + grey**2}" for grey in (0, 64, 128, 192, 255))
    return [
        b"grey,luminance\n" + greys.encode(),
        b"grey,red,green,blue\n0,1,1,1\n0.5,2,2,2\n0.7,3,3,3\n1,4,4,4\n",
        b"phase,grey\n0,0\n0.4,0.5\n1,1\n",
        b"phase,red,green,blue\n0,0,0,0\n1,1,1,1\n",
        b'{"done": {"geometry": {"width_m": 0.5}}}',
    ]


def _table(data: bytes, folder: Path) -> object:
    from calib.grey import fit_series, read_series
    from calib.setup_run import read_progress
    from runtime.panels.lut import measured_curve

    path = _at(folder, "a.csv", data)
    if data[:1] == b"{":
        return read_progress(path)
    if data[:1] == b"p":
        return measured_curve(path)
    return fit_series(read_series(path), path)


# Models


def _contracts() -> list[bytes]:
    import onnx

    from runtime.model.contract import METADATA_KEY

    folder = Path(__file__).resolve().parents[2] / "runtime" / "model" / "data"
    found = []
    for path in sorted(folder.glob("*.onnx")):
        held = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
        found.append(held[METADATA_KEY].encode())
    return found


def _contract(data: bytes, folder: Path) -> object:
    from runtime.model.contract import METADATA_KEY, parse_contract

    return parse_contract({METADATA_KEY: data.decode("utf-8", errors="replace")}, source="a.onnx")


def _models() -> list[bytes]:
    folder = Path(__file__).resolve().parents[2] / "runtime" / "model" / "data"
    return [path.read_bytes() for path in sorted(folder.glob("*.onnx"))]


def _model(data: bytes, folder: Path) -> object:
    from runtime.model.session import ModelSession

    return ModelSession(_at(folder, "a.onnx", data), threads=1)


def _checkpoints() -> list[bytes]:
    import torch

    file, other = io.BytesIO(), io.BytesIO()
    torch.save({"model": {"subnets.in_conv.0.weight": torch.zeros(2, 3, 3, 3)}, "iteration": 5}, file)
    torch.save({"model": {"a": torch.zeros(3)}, "recipe": {"steps": []}}, other, _use_new_zipfile_serialization=False)
    return [file.getvalue(), other.getvalue()]


def _checkpoint(data: bytes, folder: Path) -> object:
    from model_export.checkpoint import load_checkpoint

    return load_checkpoint(_at(folder, "a.pth", data))


# Content


def _picture_seeds() -> list[bytes]:
    from PIL import Image

    random = np.random.default_rng(1)
    picture = Image.fromarray(random.integers(0, 255, (24, 32, 3)).astype(np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    made = []
    for kind in ("PNG", "JPEG", "TIFF", "WEBP", "BMP"):
        file = io.BytesIO()
        picture.save(file, kind, **({"exif": exif} if kind != "BMP" else {}))
        made.append(file.getvalue())
    file = io.BytesIO()
    picture.convert("RGBA").save(file, "PNG")
    return [*made, file.getvalue()]


def _picture(data: bytes, folder: Path) -> object:
    from runtime.content.pictures import open_frames

    _at(folder, "a.png", data)
    with contextlib.suppress(PhasestackError):
        open_frames(folder, ContentSettings(), limits=LIMITS).frame(0)
    return open_frames(folder / "a.png", ContentSettings(), limits=LIMITS).frame(0)


def _videos() -> list[bytes]:
    import tempfile

    import cv2

    made = []
    with tempfile.TemporaryDirectory() as folder:
        for name, code in (("a.mp4", "mp4v"), ("a.avi", "MJPG")):
            writer = cv2.VideoWriter(f"{folder}/{name}", cv2.VideoWriter.fourcc(*code), 10, (64, 48))
            for value in (10, 100, 200):
                writer.write(np.full((48, 64, 3), value, np.uint8))
            writer.release()
            made.append((Path(folder) / name).read_bytes())
    return made


def _video(data: bytes, folder: Path) -> object:
    from runtime.content.pictures import open_frames

    frames = open_frames(_at(folder, "a.mp4", data), ContentSettings(), limits=LIMITS)
    try:
        for index in range(min(frames.count, 5)):
            frames.frame(index)
    finally:
        frames.close()
    return frames.count


def _box(kind: str, **visual: Any) -> bytes:
    import trimesh

    box = trimesh.creation.box((1, 1, 1))
    if visual:
        from PIL import Image

        material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (4, 4), (200, 0, 0)))
        box.visual = trimesh.visual.TextureVisuals(uv=np.random.default_rng(0).random((8, 2)), material=material)
    data = box.export(file_type=kind)
    return data.encode() if isinstance(data, str) else bytes(data)


def _mesh(suffix: str) -> Callable[[bytes, Path], object]:
    def read(data: bytes, folder: Path) -> object:
        from runtime.content.mesh import load_mesh
        from runtime.content.triangles import DrawnPart

        return [DrawnPart(part) for part in load_mesh(_at(folder, f"a{suffix}", data), limits=LIMITS).parts]

    return read


def _gltfs() -> list[bytes]:
    from tests.content.test_hostile import PNG_URI, gltf, textured

    return [json.dumps(gltf()).encode(), json.dumps(textured(0, [{"source": 0}], [{"uri": PNG_URI}])).encode()]


def _rigs() -> list[bytes]:
    """Nodes that move, bones, morph targets."""
    import tempfile

    from tests.content.gltf_files import bending_bar, growing_square, moving_square

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.gltf"
        return [make(path).read_bytes() for make in (moving_square, bending_bar, growing_square)]


def _rig(data: bytes, folder: Path) -> object:
    """Loaded, which asks for its places, and posed at a time that no key has."""
    from runtime.content.mesh import load_mesh

    mesh = load_mesh(_at(folder, "a.gltf", data), limits=LIMITS)
    return None if mesh.rig is None else mesh.rig.pose(0.377)


def _stls() -> list[bytes]:
    text = _box("stl_ascii")
    return [_box("stl"), text]


def _clouds() -> list[bytes]:
    random = np.random.default_rng(3)
    values = np.zeros(30, [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    for axis in "xyz":
        values[axis] = random.normal(size=30)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 30\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    text = "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
    return [head.encode() + values.tobytes(), (text + "end_header\n0 0 0\n1 2 3\n").encode()]


def _cloud(data: bytes, folder: Path) -> object:
    from runtime.content.ply import read_header
    from runtime.content.points import load_points

    return load_points(read_header(_at(folder, "a.ply", data), LIMITS))


def _playlists() -> list[bytes]:
    text = (
        "repeat = false\n[[show]]\nscene = 'demo'\nseconds = 2\nscale = 1.5\noffset_m = [0.0, 0.01, 0.0]\n"
        "[[show]]\nscene = 'a.png'\nseconds = 0.5\nlayout = 'side-by-side'\n"
        "[[show]]\nscene = 'lego_bulldozer'\nfile = 'a.ply'\nseconds = 86400\naxes = '+y -x'\n"
    )
    return [text.encode(), json.dumps({"show": [{"scene": "flat", "seconds": 3}]}).encode()]


def _playlist(data: bytes, folder: Path) -> object:
    from runtime.content.playlist import read_playlist

    path = _at(folder, "a.json" if data[:1] in b"[{" and data else "a.toml", data)
    return read_playlist(path, ContentSettings())


class _Hurried(threading.Event):
    """Nothing is waited for."""

    def wait(self, timeout: float | None = None) -> bool:
        return self.is_set()


def _stream(data: bytes, folder: Path) -> object:
    """Decoded as a live film is, without its thread and its times."""
    import av

    from runtime.content.stream import Reader
    from runtime.content.stream import Target as Live

    reader = Reader(Live(f"live:{_at(folder, 'a.mp4', data)}"), ContentSettings(), LIMITS)
    reader.ending = _Hurried()
    av.logging.set_level(av.logging.PANIC)
    try:
        return sum(1 for _ in islice(reader.pictures(), 5))
    except (OSError, ValueError, av.error.FFmpegError) as error:  # which its loop tells and tries again
        raise PhasestackError(str(error)[:100].replace("\n", " ")) from None


def _plys() -> list[bytes]:
    import trimesh

    box = trimesh.creation.box((1, 1, 1))
    return [bytes(box.export(file_type="ply", encoding=form)) for form in ("binary", "ascii")]


def _splats() -> list[bytes]:
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{k}" for k in range(3))]
    names += [f"rot_{k}" for k in range(4)]
    random = np.random.default_rng(2)
    values = random.normal(size=(20, len(names))).astype("<f4")
    head = "ply\nformat {} 1.0\nelement vertex 20\n" + "".join(f"property float {n}\n" for n in names) + "end_header\n"
    text = "\n".join(" ".join(f"{value:.4f}" for value in row) for row in values)
    return [
        head.format("binary_little_endian").encode() + values.tobytes(),
        (head.format("ascii") + text + "\n").encode(),
    ]


def _splat(data: bytes, folder: Path) -> object:
    from runtime.content.gaussians import load_gaussians
    from runtime.content.ply import read_header

    return load_gaussians(read_header(_at(folder, "a.ply", data), LIMITS))


# Other programs


def _requests() -> list[bytes]:
    names = ("status", "scene", "pause", "resume", "flat", "budget", "reload")
    return [json.dumps({"command": name, "value": "demo"}).encode() + b"\n" for name in names]


def _request(data: bytes, folder: Path) -> object:
    from runtime.clock import MonotonicClock
    from runtime.daemon.server import StatusServer

    global _SERVER
    if _SERVER is None:
        import tempfile

        place = Path(tempfile.mkdtemp(prefix="phasestack-fuzz-"))
        _SERVER = StatusServer(place / "s", group="", clock=MonotonicClock())
    for line in data.split(b"\n")[:20]:
        answer = _SERVER.answer(line)
        if isinstance(answer, dict):
            json.dumps(answer)
    while not _SERVER.commands.empty():
        _SERVER.commands.get()
    return None


_SERVER: Any = None


def _edids() -> list[bytes]:
    from tests.panels.edids import block

    return [block(serial_text="S1"), block(serial_number=7)]


def _edid(data: bytes, folder: Path) -> object:
    from runtime.panels.edid import parse

    return parse(data)


def _json(data: bytes, folder: Path) -> object:
    from runtime.support.foreign import parsed_json

    return parsed_json(data, source="a.json")


TARGETS: dict[str, Target] = {
    "recording": Target(_recordings, _recording),
    "eye-packets": Target(_eye_packets, _eye_packet),
    "config": Target(_configs, _config),
    "panels": Target(_panels, _panel),
    "calibration": Target(_calibrations, _calibration),
    "pairs": Target(_pairs, _pair),
    "tables": Target(_tables, _table),
    "contract": Target(_contracts, _contract),
    "model": Target(_models, _model),
    "checkpoint": Target(_checkpoints, _checkpoint),
    "picture": Target(_picture_seeds, _picture),
    "video": Target(_videos, _video),
    "gltf": Target(_gltfs, _mesh(".gltf")),
    "glb": Target(lambda: [_box("glb"), _box("glb", texture=True)], _mesh(".glb")),
    "obj": Target(lambda: [_box("obj")], _mesh(".obj")),
    "ply": Target(_plys, _mesh(".ply")),
    "rig": Target(_rigs, _rig),
    "stl": Target(_stls, _mesh(".stl")),
    "cloud": Target(_clouds, _cloud),
    "splat": Target(_splats, _splat),
    "playlist": Target(_playlists, _playlist),
    "stream": Target(_videos, _stream),
    "socket": Target(_requests, _request),
    "edid": Target(_edids, _edid),
    "json": Target(lambda: [*_panels(), b'{"a": [1, 2.5, null, "x\\u00e9"]}'], _json),
}
