"""The 17 scenes of tables S1 and S2, in the seed's reading and in the published code's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from runtime.content.presets import axes_matrix, preset, preset_file, preset_names, rotation_matrix
from runtime.errors import InputError
from runtime.optics.stack import PanelStack

# name: scale per cm, thickness in cm, panel width in cm, of the published code.
PUBLISHED = {
    "chair": (0.055, 9.09, 78.55), "lego_entity": (0.07716, 11, 77.76), "matrixcity": (0.23, 5, 51.84),
    "lego_bulldozer": (0.083, 6, 51.84), "minecraft": (2, 4, 51.84), "metal_materials": (0.025, 12, 103.68),
    "wukang_mansion": (0.0667, 6, 51.84), "truck": (0.083, 6, 52.05), "room_floor": (0.015, 46.7, 288),
    "desk_bookshelf": (0.025, 6, 172.8), "hotdog": (0.06, 2.17, 57.6), "orchids": (0.04, 100, 432),
    "china_art_museum": (0.03, 25, 115.2), "traffic": (0.04, 8.75, 108), "ficus": (0.05, 10, 77.76),
    "shoe_rack": (0.083, 12, 104.1), "street": (0.02, 100, 648),
}  # fmt: skip


def test_all_17_are_there() -> None:
    assert set(preset_names()) == set(PUBLISHED)


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_published_reading_gives_that_code_s_panels(name: str, stack: PanelStack) -> None:
    scale, gap_cm, width_cm = PUBLISHED[name]
    chosen = preset(name, "published-code")
    display = chosen.stack(stack)
    assert display.x_m == pytest.approx((-gap_cm / 100, 0.0, gap_cm / 100))
    assert display.width_m == pytest.approx(width_cm / 100)
    assert chosen.scale_per_m == pytest.approx(100 * scale)
    corner = chosen.scene_from_stack[:3, :3] @ [display.x_m[2], 0.0, 0.0]
    assert np.linalg.norm(corner) == pytest.approx(gap_cm * scale)


def test_lego_s_panels_stand_at_minus_6_0_and_6_cm_there_and_3_cm_apart_in_the_seed_s_reading(
    stack: PanelStack,
) -> None:
    assert preset("lego_bulldozer", "published-code").stack(stack).x_m == pytest.approx((-0.06, 0.0, 0.06))
    assert preset("lego_bulldozer").stack(stack).x_m == pytest.approx((-0.03, 0.0, 0.03))


@pytest.mark.parametrize("name", PUBLISHED)
@pytest.mark.parametrize("reading", ["seed", "published-code"])
def test_scene_from_stack_is_a_similarity_without_mirroring(name: str, reading: str) -> None:
    chosen = preset(name, reading)  # type: ignore[arg-type]
    linear = chosen.scene_from_stack[:3, :3]
    assert linear @ linear.T == pytest.approx(np.eye(3) * chosen.scale_per_m**2, rel=1e-9, abs=1e-9)
    assert np.linalg.det(linear) == pytest.approx(chosen.scale_per_m**3)


def test_the_seed_s_pose_takes_the_scene_into_the_light_field_frame() -> None:
    table = preset_file().scene["traffic"]
    chosen = preset("traffic")
    point = np.array([0.4, -1.2, 2.0])
    turned = Rotation.from_euler("xyz", table.rotation_deg, degrees=True).apply(point / (100 * table.scale_per_cm))
    in_stack = turned + table.translation_m
    assert chosen.scene_from_stack @ np.append(in_stack, 1.0) == pytest.approx(np.append(point, 1.0))


@pytest.mark.parametrize("order", ["xyz", "zyx", "XYZ", "ZYX", "YXZ"])
def test_the_order_of_rotations_is_scipy_s(order: str) -> None:
    angles = (216.0, -1.0, -28.0)
    in_order = [angles["xyz".index(letter)] for letter in order.lower()]
    assert rotation_matrix(angles, order) == pytest.approx(
        Rotation.from_euler(order, in_order, degrees=True).as_matrix()
    )


def test_axes_are_out_right_and_up() -> None:
    assert axes_matrix(out="+x", up="+z") == pytest.approx(np.eye(3))
    assert axes_matrix(out="+z", up="+y") == pytest.approx(np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0.0]]))


def test_an_unknown_preset_is_one_line_that_lists_them() -> None:
    with pytest.raises(InputError, match=r"^content: scene: no preset `lego`; there are .*lego_bulldozer"):
        preset("lego")


def test_a_broken_data_file_names_the_field(tmp_path: Path) -> None:
    file = tmp_path / "presets.toml"
    file.write_text('rotation_order = "xyz"\n[scene.a]\ntitle = "A"\nscale_per_cm = -1.0\n')
    with pytest.raises(InputError, match=r"presets.toml: scene.a.scale_per_cm"):
        preset_file(file)
