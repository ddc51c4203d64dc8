"""The paper's 17 scenes: scale, pose and depth of each, in the EyeReal's reading and in the published code's."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from runtime.config import Positive, Section, read_table, validated
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


class Published(Section):
    """A scene's values in the published code."""

    scale_per_cm: Positive = Field(description="digital units per centimetre")
    thickness_cm: Positive = Field(description="distance between neighbouring panels")
    width_cm: Positive = Field(description="active width of the panels")
    out: Axis = Field(description="the scene's axis out of the screen")
    up: Axis = Field(description="the scene's axis that is up")
    shift: Triple = Field((0.0, 0.0, 0.0), description="of the panels along the scene's axes, digital units")
    ground: float | None = Field(None, description="half a gap behind the middle panel, along `out`, digital units")
    ground_coefficient: float | None = Field(None, description="the same in gaps, where the code has it so")

    @property
    def middle(self) -> float:
        """Where that code puts the middle panel: half a gap beyond its ground, along `out`, digital units."""
        gap = self.thickness_cm * self.scale_per_cm
        if self.ground_coefficient is not None:
            return gap * self.ground_coefficient + gap / 2
        return (self.ground or 0.0) + gap / 2


class SceneTable(Section):
    """One scene of the data file."""

    title: str = Field(description="name in the EyeReal supplement's tables")
    scale_per_cm: Positive = Field(description="r_p2d")
    thickness_cm: Positive = Field(description="d_thick: from the first panel to the last")
    rotation_deg: Triple = Field(description="about x, y, z")
    translation_m: Triple = Field(description="metres, light-field frame")
    published: Published = Field(description="the published code's values")


class PresetFile(Section):
    """The whole data file."""

    rotation_order: str = Field(pattern="^([xyz]{3}|[XYZ]{3})$", description="scipy's letters")
    scene: dict[str, SceneTable] = Field(description="by name")


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
def preset_file(path: Path = FILE) -> PresetFile:
    """The data file, checked. Raises InputError."""
    return validated(PresetFile, read_table(path), source=path)


def preset_names() -> tuple[str, ...]:
    """Every preset's name."""
    return tuple(preset_file().scene)


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
    if name not in file.scene:
        raise InputError("content", "scene", f"no preset `{name}`; there are {', '.join(file.scene)}")
    table = file.scene[name]
    published = table.published
    if reading == "seed":
        scale_per_m = table.scale_per_cm / CM
        rotation = rotation_matrix(table.rotation_deg, file.rotation_order)
        stack_from_scene = np.eye(4)
        stack_from_scene[:3, :3] = rotation / scale_per_m
        stack_from_scene[:3, 3] = table.translation_m
        scene_from_stack = np.asarray(np.linalg.inv(stack_from_scene), dtype=np.float64)
        gap_m, width_m = table.thickness_cm * CM / (PANELS - 1), None
    else:
        axes = axes_matrix(out=published.out, up=published.up)
        scale_per_m = published.scale_per_cm / CM
        scene_from_stack = np.eye(4)
        scene_from_stack[:3, :3] = axes * scale_per_m
        shift = np.array(published.shift if reading == "published-code" or published.shift[0] else (0.0, 0.0, 0.0))
        scene_from_stack[:3, 3] = shift + axes[:, 0] * published.middle
        gap_m, width_m = published.thickness_cm * CM, published.width_cm * CM
    return Preset(name, gap_m, width_m, scene_from_stack)


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
