"""`import phasestack`: what docs/contracts.md promises to programs."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import phasestack
from runtime.commands.app import app
from tests.test_cli import pair_in, solve_arguments

STACK = phasestack.Stack(width_m=0.5184, height_m=0.2916, x_m=(-0.06, 0.0, 0.06), width_px=320, height_px=180)
EYES = ((0.78, -0.03, 0.24), (0.78, 0.03, 0.24))


def picture(shift_px: int = 0) -> np.ndarray:
    coarse = np.random.default_rng(2).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    return np.roll(cv2.resize(coarse, (320, 180), interpolation=cv2.INTER_CUBIC), shift_px, axis=1)


def test_a_pair_becomes_layers_with_what_each_eye_sees_and_how_good_that_is(tmp_path: Path) -> None:
    result = phasestack.solve(picture(), picture(3), eyes_m=EYES, stack=STACK, fov_deg=40, model="fast")
    assert result.layers.shape == (3, 180, 320, 3) and result.layers.dtype == np.uint8
    assert result.seen.shape == (2, 180, 320, 3) and result.seen.dtype == np.uint8
    light_db = result.quality.light_db
    assert all(value is not None and value > 20 for value in light_db.values()) and set(light_db) == {"0", "1", "2"}
    result.save(tmp_path / "new" / "out")
    assert cv2.imread(str(tmp_path / "new" / "out" / "contact-sheet.png")) is not None
    told = json.loads((tmp_path / "new" / "out" / "solve.json").read_text())
    assert told["light_db"]["1"] == pytest.approx(light_db["1"], abs=1e-3) and told["model"] == result.model


def test_it_is_what_the_command_makes(tmp_path: Path) -> None:
    pair = pair_in(tmp_path)
    app(solve_arguments(pair), standalone_mode=False)
    left, right = (cv2.imread(str(pair / f"{side}.png"))[..., ::-1] for side in ("left", "right"))
    panels = json.loads((pair / "panels.json").read_text()) | {"height_px": left.shape[0], "width_px": left.shape[1]}
    stack = phasestack.Stack(**panels | {"x_m": tuple(panels["x_m"])})
    result = phasestack.solve(left, right, eyes_m=((0.6, -0.03, 0.0), (0.6, 0.03, 0.0)), stack=stack)
    told = json.loads((pair / "out" / "solve.json").read_text())
    assert result.quality.light_db["1"] == pytest.approx(told["light_db"]["1"], abs=0.01)


def test_pictures_are_codes_or_intensities_with_or_without_transparency() -> None:
    codes = phasestack.solve(picture(), picture(3), eyes_m=EYES, stack=STACK, model="fast").layers
    floats = [picture(shift) / 255 for shift in (0, 3)]
    assert np.array_equal(phasestack.solve(*floats, eyes_m=EYES, stack=STACK, model="fast").layers, codes)
    opaque = [np.dstack([picture(shift), np.full((180, 320), 255, np.uint8)]) for shift in (0, 3)]
    assert np.array_equal(phasestack.solve(*opaque, eyes_m=EYES, stack=STACK, model="fast").layers, codes)


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"left": np.zeros((180, 320))}, "left"),
        ({"right": picture()[:90]}, "right"),
        ({"right": picture().astype(np.int32)}, "right"),
        ({"left": picture().astype(np.float64)}, "left"),
        ({"eyes_m": (0.7, 0.0, 0.0)}, "eyes_m"),
        ({"eyes_m": ((0.05, -0.03, 0.0), (0.05, 0.03, 0.0))}, "eyes_m"),
        ({"eyes_m": ((0.7, 0.0, 0.0), (0.7, 0.001, 0.0))}, "eyes_m"),
        ({"stack": phasestack.Stack(0.5, 0.3, (0.1, 0.0), 320, 180)}, "x_m"),
        ({"fov_deg": 190.0}, "fov_deg"),
        ({"eye_sigma_mm": float("nan")}, "eye_sigma_mm"),
        ({"model": "fats"}, "model"),
    ],
)
def test_what_does_not_fit_is_a_value_error_that_names_the_argument(change: dict[str, Any], argument: str) -> None:
    given: dict[str, Any] = {"left": picture(), "right": picture(3), "eyes_m": EYES, "stack": STACK, **change}
    with pytest.raises(ValueError, match=argument):
        phasestack.solve(given.pop("left"), given.pop("right"), **given)


def test_the_eyes_of_a_picture_are_found_and_of_none_are_not() -> None:
    from skimage.data import astronaut

    found = phasestack.find_eyes(astronaut())
    assert found is not None and found.eyes_px[0, 0] > found.eyes_px[1, 0]
    floats = phasestack.find_eyes(astronaut() / 255)
    assert floats is not None and np.allclose(floats.eyes_px, found.eyes_px)
    assert phasestack.find_eyes(picture()) is None
    with pytest.raises(ValueError, match="picture"):
        phasestack.find_eyes(np.zeros((40, 40)))


def test_importing_and_solving_load_neither_torch_nor_opengl_nor_x() -> None:
    code = (
        "import sys, numpy as np, phasestack\n"
        "stack = phasestack.Stack(0.5, 0.3, (-0.06, 0.0, 0.06), 64, 36)\n"
        "grey = np.full((36, 64, 3), 99, np.uint8)\n"
        "phasestack.solve(grey, grey, eyes_m=((0.7, -0.03, 0), (0.7, 0.03, 0)), stack=stack, model='sart')\n"
        "print([name for name in ('torch', 'moderngl', 'glfw', 'usb', 'openni') if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.stdout.strip() == "[]", done.stderr
