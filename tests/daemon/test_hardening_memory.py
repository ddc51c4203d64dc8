"""What a change of scene or model replaced goes back to the system."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from runtime.daemon import reconfigure
from runtime.daemon.reconfigure import Reconfiguration
from runtime.support.memory import give_back
from tests.daemon.rig import Rig

ROOT = Path(__file__).parents[2]

# A quarter of a GiB in pieces, of which every fiftieth is kept: the C library returns none of the others by itself.
FRAGMENTED = """
import psutil
from runtime.support.memory import give_back
size = psutil.Process().memory_info
pieces = [b"x" * (65000 + k % 2) for k in range(4000)]
full = size().rss
kept = pieces[::50]
del pieces
before = size().rss
give_back()
print(full, before, size().rss)
"""


@pytest.mark.skipif(not give_back(), reason="a C library without malloc_trim")
def test_what_lies_between_pieces_in_use_goes_back() -> None:
    done = subprocess.run([sys.executable, "-c", FRAGMENTED], cwd=ROOT, capture_output=True, text=True, check=True)
    full, before, after = (int(word) for word in done.stdout.split())
    freed = 4000 * 65000 * 49 // 50
    assert full - before < freed / 2
    assert full - after > freed * 0.8


@pytest.mark.parametrize(("scene", "taken"), [("sparse", True), ("no-such-scene", False)])
def test_after_a_change_and_after_a_refused_one_memory_is_given_back(
    monkeypatch: pytest.MonkeyPatch, scene: str, taken: bool
) -> None:
    times = []
    monkeypatch.setattr(reconfigure, "give_back_later", lambda: times.append(1))
    with Rig() as rig:
        rig.refreshes(3)
        settings = rig.settings
        changed = settings.model_copy(update={"content": settings.content.model_copy(update={"scene": scene})})
        change = Reconfiguration(changed, settings, rig.presenter.stack)
        rig.presenter.solver.do(change.advance)
        rig.refresh_until(lambda: change.finished)
    assert (change.problem == "") == taken
    assert times == [1]


@pytest.mark.slow
def test_hundreds_of_switches_end_on_a_plateau(tmp_path: Path) -> None:
    """Of a mesh with a texture, as the daemon loads it: the second half adds nothing."""
    done = subprocess.run(
        [sys.executable, "-c", SWITCHES, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, check=True
    )
    resident = [int(word) for word in done.stdout.split()]
    half = len(resident) // 2
    assert min(resident[half:]) < 1.05 * min(resident[2:half])


SWITCHES = """
import sys, time
from pathlib import Path
import numpy as np, psutil, trimesh
from PIL import Image
from runtime.config import Settings
from runtime.content.base import View
from runtime.content.loader import ContentLoader
from runtime.optics.views import raster_from_stack
from runtime.support.gl import offscreen_context
from runtime.support.memory import give_back_later

path = Path(sys.argv[1]) / "a.glb"
random = np.random.default_rng(0)
texture = Image.fromarray(random.integers(0, 255, (512, 512, 3), np.uint8))
mesh = trimesh.creation.box((0.1, 0.1, 0.1))
material = trimesh.visual.material.PBRMaterial(baseColorTexture=texture)
mesh.visual = trimesh.visual.TextureVisuals(uv=random.random((len(mesh.vertices), 2)), material=material)
mesh.export(path)
settings = Settings.model_validate({"stack": {"width_px": 480, "height_px": 270}})
stack, context = settings.stack.stack(), offscreen_context()
content = settings.content.model_copy(update={"scene": str(path)})
raster, eye = stack.panel(1), np.array((0.7, 0.0, 0.0))
view = View(eye, 0, raster_from_stack(eye, raster), raster.width_px, raster.height_px)
old = None
for number in range(300):
    loader = ContentLoader(stack)
    loader.request(content)
    while (loaded := loader.poll(context)) is None:
        time.sleep(0.001)
    loaded.source.render(view, time_ns=0)
    if old is not None:
        old.close()
        give_back_later()
    old = loaded.source
    if number % 25 == 24:
        time.sleep(0.1)
        print(psutil.Process().memory_info().rss)
"""
