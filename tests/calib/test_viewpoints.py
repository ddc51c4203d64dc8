"""The grid of the EyeReal supplement's section 2.3."""

from __future__ import annotations

import numpy as np
import pytest

from calib.viewpoints import Viewpoint, grid, viewing_place_m, viewing_volume_m
from runtime.config import CalibrationSettings


@pytest.mark.parametrize("viewpoint", grid(), ids=lambda v: v.name)
def test_a_viewpoint_lies_where_its_polar_angles_say(viewpoint: Viewpoint) -> None:
    x, y, z = viewpoint.midpoint_m
    assert np.hypot(np.hypot(x, y), z) == pytest.approx(viewpoint.radius_cm / 100)
    assert np.degrees(np.arccos(z * 100 / viewpoint.radius_cm)) == pytest.approx(viewpoint.phi_deg)
    assert np.degrees(np.arctan2(x, y)) == pytest.approx(viewpoint.theta_deg)


def test_the_grid_and_the_volume_follow_the_configured_viewing_range() -> None:
    far = CalibrationSettings(viewing_m=(1.0, 2.0), viewing_side_deg=20, viewing_up_deg=(-10, 10))
    assert {viewpoint.radius_cm for viewpoint in grid(far)} == {100, 150, 200}
    assert {viewpoint.phi_deg for viewpoint in grid(far)} == {80, 90, 100}
    assert {viewpoint.theta_deg for viewpoint in grid(far)} == {70, 90, 110}
    distance = np.linalg.norm(viewing_volume_m(far), axis=1)
    assert (distance.min(), distance.max()) == (pytest.approx(0.75), pytest.approx(3.0))
    assert viewing_place_m(far)[0] == pytest.approx(1.5)
