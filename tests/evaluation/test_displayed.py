"""Tests the displayed quality of pictures with any aspect ratio, 16 bits or transparency."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from runtime.commands.app import app
from runtime.errors import InputError
from runtime.evaluation.displayed import displayed, on_panels_raster
from runtime.optics.stack import PanelStack
from runtime.support.picture_file import read_image
from tests.optics import reference

STACK = PanelStack(0.4, 0.3, (-0.06, 0.0, 0.06), 80, 60)
EYES = np.array([[0.8, -0.03, 0.05], [0.8, 0.03, 0.05]])
FOV = 36.0


def smooth(height: int, width: int, *, right_px: float = 0.0) -> np.ndarray:
    """(h, w, 3) a soft pattern in [0, 1], with values between any two 8-bit codes."""
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([0.5 + 0.4 * np.sin((u + right_px) / 9 + k) * np.cos(v / 11 + k) for k in range(3)], -1)


def traced_psnr(layers: np.ndarray, wanted: list[np.ndarray], *, moved_m: tuple[float, ...] = (0, 0, 0)) -> float:
    """PSNR of both eyes' rays in the raster of the pictures (intensities); moved_m: the eyes are there instead."""
    squares = [
        error
        for eye, picture in zip(EYES, wanted, strict=True)
        for error in reference.carried_errors(tuple(eye), tuple(eye + moved_m), layers, picture, STACK, fov_deg=FOV)
    ]
    return -10 * math.log10(sum(squares) / len(squares))


def random_layers(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (3, 60, 80, 4), dtype=np.uint8)


@pytest.mark.parametrize("size", [(40, 30), (48, 27), (27, 48)], ids=["same aspect", "wider", "portrait"])
def test_a_picture_of_another_aspect_is_compared_in_its_own_raster(size: tuple[int, int]) -> None:
    width, height = size
    pictures = [(smooth(height, width, right_px=shift) * 255).astype(np.uint8) for shift in (0, 4)]
    layers = random_layers()
    if width * 60 == height * 80:
        pictures_compared = [cv2.resize(p, (80, 60), interpolation=cv2.INTER_AREA) for p in pictures]
    else:
        pictures_compared = pictures
    told = displayed(layers, pictures, STACK, eyes_m=EYES, fov_deg=FOV)
    expected = traced_psnr(layers, [p / 255 for p in pictures_compared])
    assert told.quality.psnr_db == pytest.approx(expected, abs=2e-3)
    assert told.seen[0].image.shape == pictures_compared[0].shape


def test_sizes_that_are_only_rounded_have_the_panels_aspect() -> None:
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 1920, 1080)
    assert on_panels_raster(np.zeros((768, 1366, 3), np.uint8), stack).shape == (1080, 1920, 3)
    assert on_panels_raster(np.zeros((768, 1360, 3), np.uint8), stack).shape == (768, 1360, 3)


def test_a_large_picture_is_measured_in_as_many_pixels_as_panels_have() -> None:
    """Twelve megapixels on small panels took a minute and 2 GB."""
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 480, 270)
    height, width, _ = on_panels_raster(np.zeros((300, 400, 3), np.uint8), stack).shape
    assert width / height == pytest.approx(4 / 3, rel=0.01) and width * height == pytest.approx(300 * 400, rel=0.01)
    height, width, _ = on_panels_raster(np.zeros((1500, 2000, 3), np.uint8), stack).shape
    assert width / height == pytest.approx(4 / 3, rel=0.01) and width * height == pytest.approx(480 * 270, rel=0.01)


def solved(left: Path, right: Path) -> tuple[dict[str, Any], np.ndarray]:
    """solve.json and layers that `solve` writes for two picture files."""
    out, panels = left.parent / "out", left.parent / "panels.json"
    panels.write_text(json.dumps({"width_m": 0.4, "height_m": 0.3, "x_m": STACK.x_m, "width_px": 80, "height_px": 60}))
    files = {"--left": left, "--right": right, "--panels": panels, "--out": out, "--fov": FOV}
    options = ["--left-eye", *EYES[0], "--right-eye", *EYES[1], *(part for pair in files.items() for part in pair)]
    done = CliRunner().invoke(app, ["solve", *map(str, options)])
    assert done.exit_code == 0, done.output
    layers = np.stack([cv2.imread(str(out / f"layer-{n}.png"))[..., ::-1] for n in range(3)])
    return json.loads((out / "solve.json").read_text()), layers


@pytest.mark.parametrize("size", [(48, 27), (27, 48)], ids=["wider than the panels", "portrait"])
def test_solve_tells_what_the_eyes_see_of_pictures_of_another_aspect(tmp_path: Path, size: tuple[int, int]) -> None:
    width, height = size
    targets = []
    for name, shift in (("left", 0), ("right", 2)):
        codes = (smooth(height, width, right_px=shift) * 255 + 0.5).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"{name}.png"), codes[..., ::-1])
        targets.append(codes / 255)
    told, layers = solved(tmp_path / "left.png", tmp_path / "right.png")
    assert told["psnr_db"] == pytest.approx(traced_psnr(layers, targets), abs=5e-3)
    for sigma in (1, 2):
        moves = [(0, s * 0.002 * sigma, 0) for s in (-1, 1)] + [(0, 0, s * 0.002 * sigma) for s in (-1, 1)]
        error = 0.5 * 10 ** (-traced_psnr(layers, targets) / 10)
        error += sum(10 ** (-traced_psnr(layers, targets, moved_m=move) / 10) for move in moves) / 8
        assert told["expected_db"][f"{sigma}"] == pytest.approx(-10 * math.log10(error), abs=5e-3)
    assert told["backend"] == "cpu"
    assert told["eye_sigma_mm"] == 1


def test_of_a_16_bit_file_the_upper_byte_is_used(tmp_path: Path) -> None:
    codes = np.arange(0, 65536, 7, dtype=np.uint16)[: 90 * 100].reshape(90, 100)
    cv2.imwrite(str(tmp_path / "a.png"), codes)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), np.repeat(codes[..., None] >> 8, 3, axis=2))


@pytest.mark.parametrize("suffix", ["png", "webp", "tiff"])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_transparency_lets_white_through_in_every_format_that_has_it(tmp_path: Path, suffix: str, dtype: type) -> None:
    if suffix == "webp" and dtype == np.uint16:
        pytest.skip("WebP has 8 bits")
    most = np.iinfo(dtype).max
    rng = np.random.default_rng(0)
    bgra = rng.integers(0, most, (6, 7, 4), dtype=dtype, endpoint=True)
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), bgra, [cv2.IMWRITE_WEBP_QUALITY, 101] if suffix == "webp" else [])
    if suffix == "webp":
        bgra = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)  # it may drop invisible colours
    bgra = bgra >> (8 * bgra.itemsize - 8)
    expected = [
        [[round((c * a + 255 * (255 - a)) / 255) for c in (r, g, b)] for b, g, r, a in row]
        for row in bgra.astype(object)
    ]
    np.testing.assert_allclose(read_image(path).astype(int), np.array(expected, dtype=int), atol=1)


CUT_OFF = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()[:60]


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\nIHDR", CUT_OFF])
def test_what_is_no_picture_is_refused_with_its_name(
    tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png"):
        read_image(tmp_path / "a.png")
    assert capfd.readouterr().err == ""
