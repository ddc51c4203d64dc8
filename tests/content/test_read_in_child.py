"""Tests that untrusted files are read in another process with limited memory and time.

Sizes in comments: memory that the same file used to take in the display's process.
"""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from runtime.config import ContentSettings
from runtime.content import registry
from runtime.content.mesh import load_mesh
from runtime.content.placing import SceneFile
from runtime.content.registry import prepare_content
from runtime.support.artifacts import write_png
from tests.content.conftest import STACK, panel_view
from tests.content.picture_files import lif, make_video
from tests.content.test_eyereal import write_pair
from tests.content.test_pictures import rgbd_picture, solid
from tests.content.test_splat import splat_table, written
from tests.content.test_untrusted_files import painted, png

pytestmark = pytest.mark.child
MIB = 1 << 20


def written_as(kind: str, folder: Path, context: Any) -> Path:
    path = folder / f"scene.{kind}"
    match kind:
        case "splats":
            return written(folder, splat_table(50))
        case "gltf":
            return painted(folder, png(8, 8))
        case "a folder":
            for number in range(3):
                write_png(folder / f"{number}.png", solid((9, 40 * number, 60)))
            return folder
        case "pairs":
            (folder / "lego_bulldozer").mkdir()
            write_pair(folder / "lego_bulldozer", context)
            return folder / "lego_bulldozer"
        case "depth":
            write_png(folder / "a_rgbd.png", rgbd_picture())
            return folder / "a_rgbd.png"
        case "mp4":
            return make_video(path, [(200, 30, 60), (10, 200, 60)], codec="mp4v")
        case "leia":
            return lif(folder / "a.jpg", solid((10, 120, 60)), solid((90, 20, 60)))
        case "tif":
            cv2.imwrite(str(path), solid((10, 120, 60)))
        case _:
            trimesh.creation.icosphere(subdivisions=2).export(path)
    return path


@pytest.mark.parametrize(
    "kind", ["glb", "gltf", "obj", "off", "ply", "stl", "splats", "tif", "leia", "depth", "mp4", "a folder", "pairs"]
)
def test_what_was_read_there_is_drawn_as_what_is_read_here(
    kind: str, tmp_path: Path, context: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written_as(kind, tmp_path, context)
    used: list[Any] = []
    real = registry.in_child
    monkeypatch.setattr(registry, "in_child", lambda *given, **how: (used.append(given), real(*given, **how))[1])
    settings = ContentSettings(scene=str(path))
    there = prepare_content(settings, STACK)(context=context)
    here = registry._read(SceneFile(path, settings, STACK))(context=context)
    assert len(used) == 1
    for side, y_m in enumerate((-0.03, 0.03)):
        view = panel_view([0.7, y_m, 0.0], STACK.panel(1), side)
        drawn = there.render(view, time_ns=0).copy()
        assert np.array_equal(drawn, here.render(view, time_ns=0)) and np.ptp(drawn[..., :3]) > 20
    assert there.info == here.info
    there.close()
    here.close()


def test_a_small_picture_needs_no_process(tmp_path: Path, context: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "in_child", None)
    write_png(tmp_path / "a.png", solid((200, 30, 60)))
    prepare_content(ContentSettings(scene=str(tmp_path / "a.png")), STACK)(context=context).close()


def test_lines_of_its_log_are_ours(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "a.obj").write_text("mtllib gone.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    with caplog.at_level(logging.INFO):
        prepare_content(ContentSettings(scene=str(tmp_path / "a.obj")), STACK)
    assert "drawing the mesh in grey without its materials" in caplog.text


def stl(path: Path, count: int) -> Path:
    """A cloud of small triangles, in the binary form."""
    random = np.random.default_rng(0)
    facets = np.zeros(count, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    facets["corners"] = random.normal(size=(count, 1, 3)) + random.normal(size=(count, 3, 3)) * 0.003
    path.write_bytes(bytes(80) + np.uint32(count).tobytes() + facets.tobytes())
    return path


LOADS = """
import json, resource, sys, time
from runtime.config import ContentSettings
from runtime.content.registry import prepare_content
from runtime.optics.stack import PanelStack
def mib(who): return resource.getrusage(who).ru_maxrss >> 10
before, begun_s, told = mib(resource.RUSAGE_SELF), time.process_time(), ""
try:
    prepare_content(ContentSettings(scene=sys.argv[1]), PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270))
except Exception as error:
    told = str(error)
more = mib(resource.RUSAGE_SELF) - before
print(json.dumps([told, more, mib(resource.RUSAGE_CHILDREN), time.process_time() - begun_s]))
"""


def loaded(path: Path) -> tuple[str, int, int, float]:
    """Refusal, MiB added to the asking process, MiB of its child, and the former's CPU seconds."""
    done = subprocess.run([sys.executable, "-c", LOADS, str(path)], capture_output=True, text=True, check=True)
    return tuple(json.loads(done.stdout))


def test_the_largest_stl_takes_half_a_gigabyte_and_not_here(tmp_path: Path) -> None:
    """95 MB of file: 1.6 GB and four seconds of the lock, twice over."""
    told, here, there, seconds = loaded(stl(tmp_path / "big.stl", 1_900_000))
    assert not told and there < 700
    assert here < 60 and seconds < 1.0


def deep(folder: Path, width: int, height: int) -> Path:
    cv2.imwrite(str(folder / "deep.png"), np.full((height, width, 4), 0x8080, np.uint16))
    return folder / "deep.png"


@pytest.mark.parametrize(
    ("make", "told", "most"),
    [
        (lambda folder: deep(folder, 8192, 4096), "", 900),  # 21 bytes a pixel; 82 before
        (lambda folder: deep(folder, 16_384, 8192), "of 16 bits per channel; the maximum is 67,108,864", 200),  # 11 GB
        (lambda folder: painted(folder, png(16_384, 8192, "RGB")), "", 1300),  # 2.0 GB
        (lambda folder: painted(folder, *[png(4096, 4096)] * 40), "exceeds the limit of 134,217,728", 400),  # 2.8 GB
    ],
    ids=["deep", "too deep", "a large texture", "many textures"],
)
def test_a_small_file_that_unpacks_to_much_stays_within_its_limits(
    make: Any, told: str, most: int, tmp_path: Path
) -> None:
    path = make(tmp_path)
    assert path.stat().st_size < 4 * MIB
    found, here, there, _ = loaded(path)
    assert (told in found) if told else not found
    assert here < 60 and there < most


def test_the_binary_form_is_read_as_the_text_is(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    ball.export(tmp_path / "binary.stl")
    ball.export(tmp_path / "text.stl", file_type="stl_ascii")
    binary, text = (load_mesh(tmp_path / f"{name}.stl") for name in ("binary", "text"))
    for field in ("positions_m", "normals", "triangles"):
        ours, theirs = (getattr(data.parts[0].shape, field) for data in (binary, text))
        np.testing.assert_allclose(ours, theirs, atol=2e-5)
    assert binary.parts[0].colour == text.parts[0].colour
