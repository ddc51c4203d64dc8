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
from runtime.optics.stack import PanelStack
from runtime.records import F64

FILE = Path(__file__).with_name("presets.toml")
PANELS = 3
ASPECT = 1080 / 1920
CM = 0.01

Reading = Literal["seed", "published-code", "published-training"]
Axis = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Triple = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Preset:
    """One scene in one reading."""

    name: str
    gap_m: float  # between neighbouring panels
    width_m: float | None  # of the panels; None: the reading says nothing
    scene_from_stack: F64  # 4x4 similarity: digital coordinates of a point in metres of the stack frame

    def stack(self, current: PanelStack) -> PanelStack:
        """The display that the scene was made for: its panels' places and size, with the current pixels."""
        width_m = current.width_m if self.width_m is None else self.width_m
        height_m = current.height_m if self.width_m is None else self.width_m * ASPECT
        x_m = tuple((index - (current.count - 1) / 2) * self.gap_m for index in range(current.count))
        return PanelStack(width_m, height_m, x_m, current.width_px, current.height_px)


@cache
def preset_file() -> dict[str, Any]:
    """The data file, which says what its keys are."""
    return tomllib.loads(FILE.read_text(encoding="utf-8"))


def preset_names() -> tuple[str, ...]:
    """Every preset's name."""
    return tuple(preset_file()["scene"])


def preset(name: str, reading: Reading = "seed") -> Preset:
    """A scene by name. Raises InputError for an unknown one.

    `seed`: r_p2d, rotation and translation as printed; d_thick is the whole depth, so that three panels are
    d_thick/2 apart; light-field = R·scene/(100 r_p2d) + t, metres.
    `published-code`: that code's scale; d_thick is the gap; the scene's own axes, and its panels' place in the scene,
    as it evaluates and infers.
    `published-training`: the same without `shift`, which its training leaves out wherever it has no part along x: a
    network trained there knows matrixcity and room_floor so.
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
        return Preset(name, table["thickness_cm"] * CM / (PANELS - 1), None, scene_from_stack)
    code = table["published"]
    axes = axes_matrix(out=code["out"], up=code["up"])
    gap = code["thickness_cm"] * code["scale_per_cm"]
    # The middle panel stands half a gap beyond that code's ground, along `out`; the ground may be in gaps.
    middle = gap / 2 + code.get("ground", gap * code.get("ground_coefficient", 0.0))
    shift = np.array(code.get("shift", (0.0, 0.0, 0.0)))
    if reading == "published-training" and not shift[0]:
        shift = np.zeros(3)
    scene_from_stack = np.eye(4)
    scene_from_stack[:3, :3] = axes * (code["scale_per_cm"] / CM)
    scene_from_stack[:3, 3] = shift + axes[:, 0] * middle
    return Preset(name, code["thickness_cm"] * CM, code["width_cm"] * CM, scene_from_stack)


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
