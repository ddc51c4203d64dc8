"""Tests that the lines of a chart are straight at its viewpoint and show ghosts elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.charts import chart_fov_deg, line_picture, make_charts
from calib.viewpoints import Viewpoint, grid, viewing_place_m, viewing_volume_m
from runtime.config import CalibrationSettings, load_settings
from runtime.optics.quality import psnr_db
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.support.picture_file import read_image

SMALL = "[stack]\nwidth_px = 480\nheight_px = 270\n"


def test_a_solved_chart_shows_both_eyes_the_picture_from_its_viewpoint_alone(tmp_path: Path) -> None:
    """Seen through the written files: the vertical lines stay clean at the viewpoint and grow ghosts 3 cm aside."""
    viewpoint = grid()[13]
    (tmp_path / "small.toml").write_text(SMALL)
    made = make_charts(tmp_path / "c", [viewpoint], load_settings(tmp_path / "small.toml"))
    listed = json.loads((tmp_path / "c" / "charts.json").read_text())["charts"]
    assert [entry["viewpoint"] for entry in listed] == made["viewpoints"] == [viewpoint.name]
    layers = np.stack([read_image(tmp_path / "c" / f"chart-{viewpoint.name}-layer-{n}.png") for n in range(3)])
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
    wanted = line_picture(width_px=480, height_px=270).astype(np.float32) / 255

    def seen_db(moved_m: float) -> float:
        errors = []
        for eye in viewpoint.eyes_m():
            seen = seen_by(eye + np.array([0.0, moved_m, 0.0]), layers, stack, fov_deg=chart_fov_deg(viewpoint, stack))
            errors.append(((seen.image - wanted)[seen.mask] ** 2).ravel())
        return psnr_db(float(np.concatenate(errors).mean()))

    assert seen_db(0.0) > 16 and seen_db(0.0) > 1.5 + max(seen_db(0.03), seen_db(-0.03))


@pytest.mark.parametrize("viewpoint", grid(), ids=lambda v: v.name)
def test_a_viewpoint_lies_where_its_polar_angles_say(viewpoint: Viewpoint) -> None:
    x, y, z = viewpoint.midpoint_m
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(viewpoint.radius_cm / 100)
    assert np.degrees(np.arccos(z * 100 / viewpoint.radius_cm)) == pytest.approx(viewpoint.phi_deg)
    assert np.degrees(np.arctan2(x, y)) == pytest.approx(viewpoint.theta_deg)


def test_the_grid_and_the_volume_follow_the_configured_viewing_range() -> None:
    far = CalibrationSettings(viewing_m=(1.0, 2.0), viewing_side_deg=20, viewing_up_deg=(-10, 10))
    found = [{getattr(one, name) for one in grid(far)} for name in ("radius_cm", "phi_deg", "theta_deg")]
    assert found == [{100, 150, 200}, {80, 90, 100}, {70, 90, 110}]
    distance = np.linalg.norm(viewing_volume_m(far), axis=1)
    assert (distance.min(), distance.max()) == (pytest.approx(0.75), pytest.approx(3.0))
    assert viewing_place_m(far)[0] == pytest.approx(1.5)
