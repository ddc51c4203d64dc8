"""The 17 scenes of tables S1 and S2, in the EyeReal supplement's reading and in the published code's."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from runtime.content.presets import axes_matrix, preset, preset_file, preset_names
from runtime.errors import InputError

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


# Of the published code's table: out axis, up axis; ground (digital units) or its coefficient; shift (digital units).
PLACES = {
    "chair": ("+y", "+z", 0, None), "lego_entity": ("+z", "+x", -0.5, None), "matrixcity": ("+z", "+y", 0, None),
    "lego_bulldozer": ("+x", "+z", None, -0.5), "minecraft": ("+y", "+x", 0, None),
    "metal_materials": ("+z", "+y", 0, None), "wukang_mansion": ("+x", "+z", None, -1),
    "truck": ("+x", "+z", None, -0.5), "room_floor": ("+x", "+z", None, -0.5), "desk_bookshelf": ("+x", "+z", 0, None),
    "hotdog": ("+z", "-x", None, -0.5), "orchids": ("+x", "+z", None, -1.2), "china_art_museum": ("+x", "+z", 0, None),
    "traffic": ("+x", "+z", 0, None), "ficus": ("+y", "+z", None, -0.5), "shoe_rack": ("+x", "+z", None, -0.5),
    "street": ("+x", "+z", -1, None),
}  # fmt: skip
SHIFTS = {"matrixcity": (0, 1.5, 0), "room_floor": (0, 0.35, 0.15)}


@pytest.mark.parametrize("name", PLACES)
def test_the_published_reading_puts_the_panels_where_that_code_does_in_the_scene(name: str) -> None:
    """That code spans three panels evenly from half a thickness below `ground` to half a thickness above its end."""
    scale, thickness_cm, _ = PUBLISHED[name]
    out, up, ground, coefficient = PLACES[name]
    z_min = ground if coefficient is None else thickness_cm * scale * coefficient
    z_max = z_min + thickness_cm * scale
    wanted = np.linspace(z_min - thickness_cm * scale / 2, z_max + thickness_cm * scale / 2, 3)
    axes = axes_matrix(out=out, up=up)  # type: ignore[arg-type]
    chosen = preset(name, "published-code")
    for x_m, along in zip((-thickness_cm / 100, 0.0, thickness_cm / 100), wanted, strict=True):
        place = (chosen.scene_from_stack @ [x_m, 0.0, 0.0, 1.0])[:3]
        assert place == pytest.approx(axes[:, 0] * along + SHIFTS.get(name, (0, 0, 0)), abs=1e-9)


# Along which axis of the scene that code's panel columns run (its own, run on 21 November 2026).
COLUMNS = {"matrixcity": "+x", "room_floor": "+y", "lego_bulldozer": "+y", "hotdog": "+y", "chair": "+x", "ficus": "+x"}


@pytest.mark.parametrize("name", COLUMNS)
def test_chair_and_ficus_are_mirrored_in_that_code_and_nothing_else_is(name: str) -> None:
    right = preset(name, "published-code").scene_from_stack[:3, 1]
    theirs = np.eye(3)["xyz".index(COLUMNS[name][1])]
    assert np.sign(right @ theirs) == (-1 if name in ("chair", "ficus") else 1)


# Table S1: r_p2d, d_thick; table S2: rotation, translation; as printed.
SEED = {
    "Metal Materials": (0.03, 12, [0, 0, 0], [0, 0, 0]), "MatrixCity": (0.23, 5, [0, 0, 0], [0, -1.5, 0]),
    "Desk & Bookshelf": (0.03, 6, [-114, 0, 90], [4.8, -2.5, 0]),
    "Hot Dog": (0.06, 10, [0, -92, 14], [2.9, 0.04, 0.16]), "Orchids": (0.04, 100, [-90, 0, 90], [19.16, -1.78, 0]),
    "Lego Bulldozer": (0.08, 6, [0, 0, 0], [0, 0, 0]), "Ficus": (0.05, 10, [0, 0, 0], [0, 0, 0]),
    "Chair": (0.06, 9.1, [0, 0, 0], [0, 0, 0]), "Traffic": (0.04, 8.75, [216, -1, -28], [-0.36, 0, 2.54]),
    "Street": (0.02, 100, [-116, 0, 114], [2.56, 0, 1.46]), "Minecraft": (2.00, 74.07, [0, 0, 0], [0, 0, 0]),
    "Lego Entity": (0.08, 11, [0, 0, 0], [0, 0, 0]), "Truck": (0.08, 6, [80, 182, -92], [0.5, -0.24, 0.1]),
    "Shoe Rack": (0.08, 12, [234, 0, 122], [2.6, -0.24, 3.1]),
    "Room Floor": (0.02, 46.7, [-20, -90, 86], [0, 0.13, -3.07]),
    "Wukang Mansion": (0.07, 6, [194, 23, -31], [0.34, -0.02, 2.02]),
    "China Art Museum": (0.03, 25, [234, 4, -61], [0.54, 0.33, 0.72]),
}  # fmt: skip


def test_the_data_file_is_tables_s1_and_s2() -> None:
    tables = {table["title"]: table for table in preset_file()["scene"].values()}
    assert set(tables) == set(SEED)
    for title, (scale, thickness_cm, rotation, translation) in SEED.items():
        table = tables[title]
        assert (table["scale_per_cm"], table["thickness_cm"]) == (scale, thickness_cm)
        assert (table["rotation_deg"], table["translation_m"]) == (rotation, translation)


def test_the_seed_s_pose_takes_the_scene_into_the_light_field_frame() -> None:
    table = preset_file()["scene"]["traffic"]
    chosen = preset("traffic")
    point = np.array([0.4, -1.2, 2.0])
    turned = Rotation.from_euler("xyz", table["rotation_deg"], degrees=True).apply(
        point / (100 * table["scale_per_cm"])
    )
    in_stack = turned + table["translation_m"]
    assert chosen.scene_from_stack @ np.append(in_stack, 1.0) == pytest.approx(np.append(point, 1.0))


def test_an_unknown_preset_is_one_line_that_lists_them() -> None:
    with pytest.raises(InputError, match=r"^content: scene: no preset `lego`; there are .*lego_bulldozer"):
        preset("lego")
