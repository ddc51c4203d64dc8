"""The paper's 17 scenes: scale, pose and depth of each, in the EyeReal's reading and in the published code's."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from runtime.errors import InputError
from runtime.records import F64

FILE = Path(__file__).with_name("presets.toml")
CM = 0.01

Reading = Literal["seed", "published-code"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Preset:
    """One scene in one reading."""

    name: str
    scene_from_stack: F64  # 4x4 similarity: digital coordinates of a point in metres of the stack frame


@cache
def preset_file() -> dict[str, Any]:
    """The data file, which says what its keys are."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def preset_names() -> tuple[str, ...]:
    """Every preset's name."""
    return tuple(preset_file()["scene"])


def preset(name: str, reading: Reading = "seed") -> Preset:
    """A scene by name. Raises InputError for an unknown one.

    `seed`: r_p2d, rotation and translation as printed; light-field = R·scene/(100 r_p2d) + t, metres.
    `published-code`: that code's scale; d_thick is the gap; the scene's own axes, and its panels' place in the scene,
    as it evaluates and infers.
    """
    file = preset_file()
    if name not in file["scene"]:
        raise InputError("content", "scene", f"no preset `{name}`; there are {', '.join(preset_names())}")
    table = file["scene"][name]
    if reading == "seed":
        stack_from_scene = np.eye(4)
        rotation = rotation_matrix(table["rotation_deg"], file["rotation_order"])
        stack_from_scene[:3, :3] = rotation / (table["scale_per_cm"] / CM)
        stack_from_scene[:3, 3] = table["translation_m"]
        scene_from_stack = np.asarray(np.linalg.inv(stack_from_scene), dtype=np.float64)
        return Preset(name, scene_from_stack)
    code = table["published"]
    axes = axes_matrix(out=code["out"], up=code["up"])
    gap = code["thickness_cm"] * code["scale_per_cm"]
    # The middle panel stands half a gap beyond that code's ground, along `out`; the ground may be in gaps.
    middle = gap / 2 + code.get("ground", gap * code.get("ground_coefficient", 0.0))
    shift = np.array(code.get("shift", (0.0, 0.0, 0.0)))
    scene_from_stack = np.eye(4)
    scene_from_stack[:3, :3] = axes * (code["scale_per_cm"] / CM)
    scene_from_stack[:3, 3] = shift + axes[:, 0] * middle
    return Preset(name, scene_from_stack)


def rotation_matrix(angles_deg: Triple, order: str) -> F64:
    """3x3 of three angles about x, y, z, applied in `order` (lower case: fixed axes, upper case: turning ones)."""
    angles = [angles_deg["xyz".index(letter)] for letter in order.lower()]
    return np.asarray(Rotation.from_euler(order, angles, degrees=True).as_matrix())


def axes_matrix(*, out: str, up: str) -> F64:
    """3x3 scene_from_stack rotation: columns are the scene's axes out of the screen, to the right and up."""
    columns = []
    for axis in (out, up):
        column = np.zeros(3)
        column["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
        columns.append(column)
    return np.column_stack([columns[0], np.cross(columns[1], columns[0]), columns[1]])
