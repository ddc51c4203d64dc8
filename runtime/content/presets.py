"""Scale and pose of the EyeReal paper's 17 scenes, from its supplement and its published code."""

from __future__ import annotations

import tomllib
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from runtime.records import F64

FILE = Path(__file__).with_name("presets.toml")
CM = 0.01  # one centimetre in metres

Triple = tuple[float, float, float]


@cache
def preset_file() -> dict[str, Any]:
    """Return the contents of presets.toml. The keys are explained by comments in the file."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def preset_names() -> tuple[str, ...]:
    """Return the names of all presets."""
    return tuple(preset_file()["scene"])


def stack_from_preset(name: str) -> F64:
    """Return the 4x4 map from scene units to metres in `stack`: R · p / (100 r_p2d) + t (supplement)."""
    table, matrix = preset_file()["scene"][name], np.eye(4)
    rotation = rotation_matrix(table["rotation_deg"], preset_file()["rotation_order"])
    matrix[:3, :3] = rotation / (table["scale_per_cm"] / CM)
    matrix[:3, 3] = table["translation_m"]
    return matrix


def drawn_scene_from_stack(name: str) -> F64:
    """Return the 4x4 map from metres in `stack` to scene units, as used by the published code that drew
    the data set. Its scales differ from the supplement's. It also aligns the panels with the scene's axes, and places
    them differently for evaluation.
    """
    code, matrix = preset_file()["scene"][name]["published"], np.eye(4)
    axes = axes_matrix(out=code["out"], up=code["up"])
    gap = code["thickness_cm"] * code["scale_per_cm"]
    # In the published code, the ground is half a gap behind the middle panel along `out`. It may be given in gaps.
    middle = gap / 2 + code.get("ground", gap * code.get("ground_coefficient", 0.0))
    matrix[:3, :3] = axes * (code["scale_per_cm"] / CM)
    matrix[:3, 3] = np.array(code.get("shift", (0.0, 0.0, 0.0))) + axes[:, 0] * middle
    return matrix


def rotation_matrix(angles_deg: Triple, order: str) -> F64:
    """Return the 3x3 rotation about fixed (`xyz`) or moving axes (`XYZ`), as SciPy orders them."""
    if not any(angles_deg):
        return np.eye(3)
    Rotation: Any = import_module("scipy.spatial.transform").Rotation  # takes a third of the time to import the solver
    angles = [angles_deg["xyz".index(letter)] for letter in order.lower()]
    return np.asarray(Rotation.from_euler(order, angles, degrees=True).as_matrix())


def axes_matrix(*, out: str, up: str) -> F64:
    """Return the 3x3 scene_from_stack rotation: columns out, right and up, given axes such as `+z`."""
    columns = []
    for axis in (out, up):
        column = np.zeros(3)
        column["xyz".index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
        columns.append(column)
    return np.column_stack([columns[0], np.cross(columns[1], columns[0]), columns[1]])
