"""Compiled corrections do what the definition says (`plain_panels`): code for code, and no byte beside."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import runtime.model.cpu
from runtime.config import ModelSettings
from runtime.evaluation.displayed import displayed, expected_db
from runtime.model import compiled
from runtime.model.compiled import along, passes, warp
from runtime.model.compiled.loops import TILE
from runtime.model.compiled.panels import Panels, warm_up
from runtime.model.compiled.passes import extrapolate_rows, fade_codes
from runtime.model.predictor import SHIPPED, load_predictor
from runtime.model.reprojection import CENTRE, FRONT, OUTER, REAR
from runtime.model.still import solve_still
from runtime.model.targets import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F32, F64, U8
from tests.model.exact import exact_resample
from tests.model.plain_panels import PlainPanels
from tests.model.scenes import FOV_DEG, card_scene, eyes

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 200, 112)
CARDS = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
WITHIN_ONE = 0.999  # of all codes
LEAST_DB = -0.05  # of displayed quality, against OpenCV's loops
BOXES = {
    "whole": (PixelRect(0, 0, 200, 112),) * 3,
    "parts": (PixelRect(8, 16, 168, 96), PixelRect(16, 16, 160, 96), PixelRect(24, 8, 152, 104)),
}
POSES = {
    "straight": eyes(0.6),
    "beside and above": eyes(0.7, 0.2, 0.1),
    "near": eyes(0.2, -0.05),
    "rolled": eyes(0.6, roll_deg=20),
    "one behind the other": eyes(0.6) + np.array([[0.0], [0.2]]) * (1.0, 0.0, 0.0),
    "one eye for both": np.array([[0.6, 0.0, 0.0], [0.6, 0.0, 0.0]]),
    "far beside": eyes(0.5, 0.9),
}


TILT = Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05))


@pytest.fixture(params=[1, 3], ids=["one thread", "three threads"])
def threads(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr("runtime.model.compiled.panels.WORTH_A_THREAD", 0)
    return int(request.param)


def filled(kind: type[Panels], threads: int, stack: PanelStack, *, boxes: str, channels: int) -> Panels:
    """A panels with outer panels and pictures of smooth noise, the same for every kind."""
    panels = kind(stack, threads=threads, channels=channels)
    panels.crop(tuple(box.cut(stack.panel(n)) for n, box in enumerate(BOXES[boxes])), stack)
    noise = np.random.default_rng(5)
    for image in (*(panels.outer[n] for n in OUTER), *panels.target):
        most = 2 * FULL if any(image is target for target in panels.target) else FULL
        coarse = noise.integers(0, most, (image.shape[0] // 4 + 2, image.shape[1] // 4 + 2, *image.shape[2:]))
        fine = coarse.repeat(4, 0).repeat(4, 1)[: image.shape[0], : image.shape[1]]
        image[...] = (fine + np.roll(fine, 2, 0) + np.roll(fine, 2, 1)) // 3
    return panels


def both(threads: int, stack: PanelStack = STACK, *, boxes: str = "whole", channels: int = 3) -> list[Panels]:
    return [filled(kind, threads, stack, boxes=boxes, channels=channels) for kind in (PlainPanels, Panels)]


def solved(panels: Panels, pair: F64, *, sigma_mm: float = 0.0, fading: tuple[F32, F32] | None = None) -> U8:
    """Layers after three corrections, of which two are shown."""
    boxes = BOXES["whole"] if panels.size == (200, 112) else BOXES["parts"]
    panels.set_eyes(pair, eye_sigma_mm=sigma_mm)
    panels.project(OUTER)
    for panel, shown in ((FRONT, False), (REAR, True), (FRONT, True)):
        panels.step(panel, size=0.75, shown=shown, fading=fading)
        panels.project((panel,))
    layers = np.full((3, 112, 200, 4), 255, np.uint8)
    panels.show(layers, boxes)
    return layers


def within_one(first: U8, second: U8) -> float:
    return float((np.abs(first.astype(np.int16) - second) <= 1).mean())


@pytest.mark.parametrize("boxes", BOXES)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("pose", POSES)
def test_codes_are_those_of_the_definition(pose: str, channels: int, boxes: str, threads: int) -> None:
    expected, found = (solved(panels, POSES[pose]) for panels in both(threads, boxes=boxes, channels=channels))
    assert within_one(expected, found) >= WITHIN_ONE
    assert (found[..., 3] == 255).all()
    beside = np.ones((3, 112, 200), bool)
    for n, box in enumerate(BOXES[boxes]):
        beside[n][box.slices] = False
    assert (found[beside] == 255).all()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("pose", ["straight", "rolled", "one eye for both"])
def test_codes_on_tilted_panels_are_those_of_the_definition(pose: str, channels: int, threads: int) -> None:
    """Where rays cross every panel. Pieces that are laid for a row serve others, a sixteenth of a pixel off at most."""
    expected, found = (
        solved(panels, POSES[pose]) for panels in both(threads, replace(STACK, tilt=TILT), channels=channels)
    )
    inner = np.s_[:, 24:-24, 24:-24]
    assert within_one(expected[inner], found[inner]) >= 0.994
    assert np.abs(expected[inner].astype(np.int16) - found[inner]).max() <= 8
    even = solved(filled(Panels, threads, STACK, boxes="whole", channels=channels), POSES[pose])
    assert within_one(even, found) < 0.9


@pytest.mark.parametrize("channels", [1, 3])
def test_a_rolled_heads_eyes_see_a_strip_through_rows_that_lie_far_apart(channels: int, threads: int) -> None:
    """More rows apart than one eye's share of the residual has: they were written behind its end."""
    kinds = both(threads, PanelStack(0.2592, 0.1458, (-0.15, 0.0, 0.15), 200, 112), channels=channels)
    expected, found = (solved(panels, eyes(0.25, roll_deg=40)) for panels in kinds)
    assert within_one(expected, found) >= WITHIN_ONE


@pytest.mark.parametrize("sigma_mm", [0.0, 2.0, 6.0, 50.0])
@pytest.mark.parametrize("name", SHIPPED)
def test_the_eyes_see_no_less_however_unsure_they_are(
    name: str, sigma_mm: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is blurred before it is sampled here is blurred after it there: not the same codes, but the same quality."""
    pair, found = eyes(0.6, 0.05, 0.03), []
    pictures = tuple(card_scene(eye) for eye in pair)
    for kind in (PlainPanels, Panels):
        monkeypatch.setattr(runtime.model.cpu, "Panels", kind)
        predictor = load_predictor(name, CARDS, ModelSettings(threads=1))
        made = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, eye_sigma_mm=sigma_mm).layers
        views = displayed(made, pictures, CARDS, eyes_m=pair, fov_deg=FOV_DEG, similarity=False)
        expected = expected_db(views, made, sigmas_mm=(sigma_mm,)).popitem()[1]
        found.append(expected if sigma_mm else views.quality.psnr_db)
        predictor.close()
    assert found[1] - found[0] >= LEAST_DB


def test_corrections_fade_out_alike(threads: int) -> None:
    columns, down = np.linspace(0, 1, 200, dtype=np.float32), np.ones(112, np.float32)
    down[:20] = 0.25
    fading = np.rint(columns * 4) / np.float32(4), down
    expected, found = (solved(panels, eyes(0.6), fading=fading) for panels in both(threads))
    assert (np.abs(expected.astype(np.int16) - found) <= 2).mean() >= WITHIN_ONE
    whole = solved(filled(Panels, threads, STACK, boxes="whole", channels=3), eyes(0.6))
    assert within_one(whole, found) < 0.9


@settings(max_examples=60, deadline=None)
@given(
    scale=st.tuples(st.floats(0.05, 4.0), st.floats(0.05, 4.0)),
    shift=st.tuples(st.floats(-150, 150), st.floats(-80, 80)),
    size=st.tuples(st.integers(1, 40), st.integers(1, 90)),
    source=st.tuples(st.integers(1, 40), st.integers(1, 90)),
    channels=st.sampled_from([1, 3]),
)
def test_samples_are_those_of_the_definition_wherever_the_rasters_are(
    scale: tuple[float, float],
    shift: tuple[float, float],
    size: tuple[int, int],
    source: tuple[int, int],
    channels: int,
) -> None:
    matrix = np.array([[scale[0], 0.0, shift[0]], [0.0, scale[1], shift[1]], [0.0, 0.0, 1.0]])
    image = np.random.default_rng(1).integers(-4000, 4000, (*source, channels)).astype(np.int16)
    held = np.zeros((source[0] + 3, (source[1] + 4) * channels + along.PIECE * 4), np.int16)
    held[: source[0], : source[1] * channels] = image.reshape(source[0], -1)
    found = np.zeros((size[0], size[1] * channels))
    row, tiles, layout = along.work_row(4.0), along.work_tiles(), along.new_layout(1, size[1], channels)
    step = TILE // channels
    for v in range(size[0]):
        for tile in range(-(-size[1] // step)):
            pixels, to = min(step, size[1] - tile * step), tile * step * channels
            place = held, source[0], source[0], source[1], -along.EDGE_PX, matrix, v, tile, pixels, channels, 0
            along.sample_or(*place, np.float32(7), layout, row, tiles[1])
            found[v, to : to + pixels * channels] = tiles[1, : pixels * channels]
    expected = np.zeros((*size, channels))
    exact_resample(image, image_from_result=matrix, out=expected, outside=7)
    assert np.abs(found.reshape(expected.shape) - expected).max() < 0.51 + 8000 * 2e-4


@pytest.mark.parametrize("channels", [1, 3])
def test_rows_of_rays_that_are_bent_are_sampled_in_their_own_rows(channels: int) -> None:
    """A picture seen from above and aside: rows fall while they grow denser. Seen: half a pixel beside, or more."""
    matrix = np.array([[1.20441, -0.196946, -34.6], [-0.072058, 1.112023, 34.578], [0.000381, -0.000864, 1.025213]])
    height, width, pixels = 270, 480, TILE // 3
    held = np.zeros((height + 3, (width + 4) * channels + along.PIECE * 4), np.int16)
    held[:height, : width * channels] = 8 * np.arange(height)[:, None]
    row, tiles, layout = along.work_row(4.0), along.work_tiles(), along.new_layout(1, pixels, channels)
    for v in (20, 100, 150):
        place = held, height, height, width, 0.5, matrix, v, 0, pixels, channels, 0
        first, last = along.sample(*place, layout, row, tiles[1])
        u = np.arange(first, last) + 0.5
        y = (matrix[1] @ [u, v + 0.5 + 0 * u, 1 + 0 * u]) / (matrix[2] @ [u, v + 0.5 + 0 * u, 1 + 0 * u]) - 0.5
        assert last - first > 200
        assert np.abs(tiles[1, first * channels : last * channels : channels] / 8 - y).max() < 0.2


def test_nothing_is_written_beside_the_images(threads: int) -> None:
    panels = filled(Panels, threads, STACK, boxes="parts", channels=3)
    sizes = {}
    for (name, n), image in panels._whole.items():
        panel = {"target": CENTRE, "spare": FRONT, "moved": REAR}.get(name, n)
        shared = name in {"outer", "spare", "moved"}  # for whichever panel
        raster = panels.rasters[panel]
        sizes[id(image)] = height, width = (96, 160) if shared else (raster.height_px, raster.width_px)
        image.base[height:] = -77
        image.base[:, width:] = -77
    for sigma_mm in (0.0, 30.0):
        solved(panels, eyes(0.6), sigma_mm=sigma_mm)
    for name, image in panels._whole.items():
        height, width = sizes[id(image)]
        assert (image.base[height:] == -77).all(), name
        assert (image.base[:, width:] == -77).all(), name


def test_what_was_compiled_at_the_start_serves_every_case(threads: int) -> None:
    warm_up()
    kernels = (passes.correct, passes.blur, passes.close_centre, passes.show, warp.warp, extrapolate_rows, fade_codes)
    for boxes in BOXES:
        for channels in (1, 3):
            panels = filled(Panels, threads, STACK, boxes=boxes, channels=channels)
            for sigma_mm in (0.0, 30.0):
                fading = np.ones(panels.size[0], np.float32), np.ones(panels.size[1], np.float32)
                solved(panels, POSES["rolled"], sigma_mm=sigma_mm, fading=fading)
    assert [len(function.signatures) for function in kernels] == [1] * len(kernels)


@pytest.mark.parametrize(("right", "down"), [(0.0, 0.0), (0.1, -0.05), (-0.12, 0.0), (0.0, 0.1)])
@pytest.mark.parametrize("scale", [0.4, 0.94, 1.2])
def test_a_picture_is_sampled_by_the_cubic_definition(right: float, down: float, scale: float) -> None:
    noise = np.random.default_rng(2).integers(0, 256, (30, 40, 4)).astype(np.uint8)
    picture = noise.repeat(4, 0).repeat(4, 1)
    matrix = np.array([[scale, right, 9.3], [down * scale, scale, 14.6], [2e-5, 3e-5, 1.0]])
    rows, columns = slice(3, 83), slice(5, 125)
    out = np.zeros((90, 130, 4), np.uint8)
    warp.warped(picture, matrix, out=out, rows=rows, columns=columns)
    v, u = np.mgrid[0:80, 0:120].astype(float)
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
    x, y = x / w, y / w
    i, j = np.floor(x).astype(int), np.floor(y).astype(int)
    wanted = np.zeros((80, 120, 3))
    for n, b in enumerate(_cubic(y - j)):
        for k, a in enumerate(_cubic(x - i)):
            taps = picture[np.clip(j + n - 1, 0, 119), np.clip(i + k - 1, 0, 159), :3]
            wanted += (a * b)[..., None] * taps
    error = np.abs(np.clip(wanted, 0, 255) - out[rows, columns, :3])
    # A rising row leans the kernel by its slope.
    assert error.max() <= 2 + 110 * abs(down) and error.mean() <= 0.25 + 4 * abs(down)
    assert (out[rows, columns, 3] == 255).all()
    assert (out[:3] == 0).all() and (out[83:] == 0).all() and (out[:, :5] == 0).all() and (out[:, 125:] == 0).all()


def _cubic(t: Any, a: float = -0.75) -> list[Any]:
    def near(d: Any) -> Any:
        return ((a + 2) * d - (a + 3)) * d * d + 1

    def far(d: Any) -> Any:
        return ((a * d - 5 * a) * d + 8 * a) * d - 4 * a

    return [far(1 + t), near(t), near(1 - t), far(2 - t)]


@pytest.mark.parametrize(
    "matrix",
    [
        [[-1.0, 0.0, 100.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],  # mirrored
        [[0.7, 0.7, 0.0], [-0.7, 0.7, 60.0], [0.0, 0.0, 1.0]],  # rolled
        [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-0.02, 0.0, 1.0]],  # partly behind the eye
        [[1.0, 0.0, 500.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],  # beside it
        [[80.0, 0.0, -3000.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],  # far beyond it
    ],
)
def test_what_is_not_level_is_told(matrix: list[list[float]]) -> None:
    assert not warp.is_level(np.array(matrix), rows=slice(0, 80), columns=slice(0, 120), size=(160, 120))


def test_compiled_code_is_kept_by_what_it_follows_from(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = compiled._kept()
    assert folder is not None and folder.parent == tmp_path / "phasestack" / "compiled"
    assert folder.stat().st_mode & 0o77 == 0
    monkeypatch.setenv("XDG_CACHE_HOME", "/proc")
    elsewhere = compiled._kept()
    assert elsewhere is not None and elsewhere.name == folder.name and not elsewhere.is_relative_to("/proc")


def test_shown_codes_are_whole(threads: int) -> None:
    for sigma_mm in (0.0, 30.0):
        panels = filled(Panels, threads, STACK, boxes="whole", channels=3)
        solved(panels, eyes(0.6), sigma_mm=sigma_mm)
        assert all((panels.outer[n] % SUBCODE == 0).all() and panels.outer[n].max() <= FULL for n in OUTER)


ONE_KERNEL = """
import logging, numpy as np
logging.basicConfig(level=logging.WARNING, format="%(message)s")
from runtime.model.compiled.passes import fade_codes
fade_codes(np.full((2, 6), 8, np.int16), np.zeros((1, 2), np.float32), 5, 3)
print(len(fade_codes.stats.cache_hits), "loaded")
"""


@pytest.mark.parametrize("broken", [b"", b"\x80\x04\x95 no kernel of ours" * 100], ids=["no bytes", "other bytes"])
@pytest.mark.parametrize("which", ["nbi", "nbc"])
def test_kept_kernels_that_a_power_cut_or_a_disk_broke_are_compiled_anew_and_one_line_tells_it(
    tmp_path: Path, which: str, broken: bytes
) -> None:
    def start() -> subprocess.CompletedProcess[str]:
        environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
        return subprocess.run([sys.executable, "-c", ONE_KERNEL], env=environment, capture_output=True, text=True)

    assert start().stdout == "0 loaded\n" and start().stdout == "1 loaded\n"
    (file,) = tmp_path.rglob(f"passes.fade_codes*.{which}")
    file.write_bytes(broken)
    done = start()
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (0, "0 loaded\n", 1), done.stderr
    assert f"{file} can't be used ({len(broken)} bytes" in done.stderr
    again = start()
    assert (again.stdout, again.stderr) == ("1 loaded\n", "")
