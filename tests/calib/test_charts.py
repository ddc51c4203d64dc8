"""Charts: at its viewpoint an eye sees straight lines at the thirds, elsewhere it does not."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calib.charts import captioned, chart_fov_deg, line_picture
from calib.commands import app
from calib.viewpoints import grid
from runtime.optics.quality import psnr_db
from runtime.optics.retina import panel_positions, seen_by
from runtime.optics.stack import PanelStack
from runtime.support.artifacts import read_image

run = CliRunner()


SMALL = "[stack]\nwidth_px = 480\nheight_px = 270\n"


def test_a_solved_chart_shows_both_eyes_the_picture_from_its_viewpoint_alone(tmp_path: Path) -> None:
    """Seen through the written files: the vertical lines stay clean at the viewpoint and grow ghosts 3 cm aside."""
    viewpoint = grid()[13]
    (tmp_path / "small.toml").write_text(SMALL)
    result = run.invoke(
        app,
        ["charts", "--out", str(tmp_path / "c"), "--config", str(tmp_path / "small.toml"), "--viewpoint",
         viewpoint.name, "--json"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    listed = json.loads((tmp_path / "c" / "charts.json").read_text())["charts"]
    assert [entry["viewpoint"] for entry in listed] == json.loads(result.stdout)["viewpoints"] == [viewpoint.name]
    layers = np.stack([read_image(tmp_path / "c" / f"chart-{viewpoint.name}-layer-{n}.png") for n in range(3)])
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
    wanted = line_picture(width_px=480, height_px=270).astype(np.float32) / 255

    def seen_db(moved_m: float) -> float:
        errors = []
        for eye in viewpoint.eyes_m():
            seen = seen_by(eye + np.array([0.0, moved_m, 0.0]), layers, stack, fov_deg=chart_fov_deg(viewpoint, stack))
            errors.append(((seen.image - wanted)[seen.mask] ** 2).ravel())
        return psnr_db(float(np.concatenate(errors).mean()))

    fused, unfused = (read_image(tmp_path / "c" / f"reference-{name}.png") for name in ("fused", "unfused"))
    assert np.abs(fused - 255 * wanted).mean() < np.abs(unfused - 255 * wanted).mean()
    assert seen_db(0.0) > 16
    assert seen_db(0.0) > 1.5 + max(seen_db(0.03), seen_db(-0.03))


@pytest.mark.parametrize("name", ["R40-phi70-theta80", "R50-phi80-theta90", "R60-phi90-theta100"])
@pytest.mark.parametrize("aside_m", [0.0, 0.07])
def test_guidance_is_read_through_the_stack_from_about_the_viewpoint(name: str, aside_m: float) -> None:
    """Where a ray crosses the middle panel's words it is bright, beside them dark, whatever the chart was there."""
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
    viewpoint = next(v for v in grid() if v.name == name)
    chart = np.full((3, 540, 960, 4), 200, np.uint8)
    layers = captioned(chart, "7 cm to the right", stack=stack, eyes_m=viewpoint.eyes_m())
    words = (layers[1, ..., 0] > 200) & (chart[1, ..., 0] != layers[1, ..., 0])
    rows = np.flatnonzero(words.any(axis=1))
    paper = np.zeros_like(words)
    line = slice(rows.min(), rows.max() + 1)
    paper[line] = cv2.dilate(words.astype(np.uint8), np.ones((7, 7)))[line] == 0
    for eye_m in viewpoint.eyes_m() + np.array([0.0, aside_m, 0.0]):
        view = {"fov_deg": 60.0, "width_px": 960, "height_px": 540}
        seen = seen_by(eye_m, layers, stack, **view)
        u, v = panel_positions(eye_m, stack, index=1, **view)
        inside = seen.mask & (u > 1) & (v > 1) & (u < 959) & (v < 539)
        place = v[inside].astype(int), u[inside].astype(int)
        light = seen.image[inside].mean(axis=-1)
        assert words[place].sum() > 100
        assert np.median(light[words[place]]) > 0.6
        assert np.percentile(light[paper[place]], 90) < 0.1
