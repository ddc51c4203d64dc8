"""The 17 scenes of tables S1 and S2, in the EyeReal supplement's reading and in the published code's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from runtime.content.presets import axes_matrix, drawn_scene_from_stack, preset_file, stack_from_preset

# The published code's table: scale per cm, thickness in cm, out axis, up axis; ground (digital units) or its
# coefficient. One scene of each kind.
PLACES = {
    "chair": (0.055, 9.09, "+y", "+z", 0, None), "matrixcity": (0.23, 5, "+z", "+y", 0, None),
    "hotdog": (0.06, 2.17, "+z", "-x", None, -0.5), "room_floor": (0.015, 46.7, "+x", "+z", None, -0.5),
    "orchids": (0.04, 100, "+x", "+z", None, -1.2), "street": (0.02, 100, "+x", "+z", -1, None),
}  # fmt: skip
SHIFTS = {"matrixcity": (0, 1.5, 0), "room_floor": (0, 0.35, 0.15)}


@pytest.mark.parametrize("name", PLACES)
def test_the_published_reading_places_the_panels_as_that_code_does(name: str) -> None:
    """The published code spaces three panels from half a thickness below `ground` to half a thickness above its end."""
    scale, thickness_cm, out, up, ground, coefficient = PLACES[name]
    z_min = ground if coefficient is None else thickness_cm * scale * coefficient
    z_max = z_min + thickness_cm * scale
    wanted = np.linspace(z_min - thickness_cm * scale / 2, z_max + thickness_cm * scale / 2, 3)
    axes = axes_matrix(out=out, up=up)
    scene_from_stack = drawn_scene_from_stack(name)
    for x_m, along in zip((-thickness_cm / 100, 0.0, thickness_cm / 100), wanted, strict=True):
        place = (scene_from_stack @ [x_m, 0.0, 0.0, 1.0])[:3]
        assert place == pytest.approx(axes[:, 0] * along + SHIFTS.get(name, (0, 0, 0)), abs=1e-9)


# Along which axis of the scene that code's panel columns run (its own, run on 21 November 2026).
COLUMNS = {"matrixcity": "+x", "room_floor": "+y", "lego_bulldozer": "+y", "hotdog": "+y", "chair": "+x", "ficus": "+x"}


@pytest.mark.parametrize("name", COLUMNS)
def test_chair_and_ficus_are_mirrored_in_that_code_and_nothing_else_is(name: str) -> None:
    right = drawn_scene_from_stack(name)[:3, 1]
    theirs = np.eye(3)["xyz".index(COLUMNS[name][1])]
    assert np.sign(right @ theirs) == (-1 if name in ("chair", "ficus") else 1)


def test_the_seed_s_pose_takes_the_scene_into_the_light_field_frame() -> None:
    table = preset_file()["scene"]["traffic"]
    point = np.array([0.4, -1.2, 2.0])
    turned = Rotation.from_euler("xyz", table["rotation_deg"], degrees=True).apply(
        point / (100 * table["scale_per_cm"])
    )
    in_stack = turned + table["translation_m"]
    assert stack_from_preset("traffic") @ np.append(point, 1.0) == pytest.approx(np.append(in_stack, 1.0))
