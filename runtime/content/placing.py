"""Map scene file coordinates to the stack frame, using presets or by fitting to the display."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime.config import ContentSettings
from runtime.content.presets import axes_matrix, stack_from_preset
from runtime.optics.stack import PanelStack
from runtime.records import F64

log = logging.getLogger("phasestack.content")

FILL = 0.75  # largest share of the display's width and height for a fitted scene, as its front appears larger
DEEPER = 2.0  # largest depth of a fitted scene, as a multiple of the range `depth_m`
BACK = 0.5  # a flat mesh is turned around if its mean normal's component away from the viewer exceeds this
FLAT = 0.1  # a mesh is flat if its thickness, divided by its second smallest side, is below this
STANDS = 0.2  # the y and z ranges, relative to their sizes, must begin this far apart to identify the up axis
GLTF = (".glb", ".gltf")
CUSTOMS = {".glb": ("+y", "+z"), ".gltf": ("+y", "+z"), ".obj": ("+y", "+z"), ".stl": ("+z", "-y")}  # up, to viewer
DARK = (0.12, 0.12, 0.12)  # default background for files; both brighter and darker ghosts are visible against it


@dataclass(frozen=True, slots=True)
class SceneFile:
    """A scene file, with the settings and the display that determine where its content is placed."""

    path: Path
    settings: ContentSettings
    stack: PanelStack
    preset: str = ""  # name of the file's preset, or an empty string

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour: dark, unless the settings specify another colour."""
        return self.settings.background or DARK

    def placed(self, low: F64, high: F64, *, custom: tuple[str, str] | None = None, facing: F64 | None = None) -> F64:
        """Return the 4x4 stack_from_scene matrix for content between the corners `low` and `high` (3,).

        A preset determines the matrix. Otherwise, depending on the settings, the content is either fitted to the
        display or left unscaled, with its coordinates taken as metres. `custom` are the axes (up, towards the viewer)
        that are usual for the file's format, by default its suffix's. With `facing`, the surface's area-weighted mean
        normal (3,), a flat mesh is turned to face the viewer.
        """
        if self.preset:
            return stack_from_preset(self.preset)
        axes = self._axes(low, high, custom or CUSTOMS.get(self.path.suffix.lower()), facing)
        if self.settings.fit:
            return fitted(low, high, axes=axes, stack=self.stack, depth_m=self.settings.depth_m)
        matrix = np.eye(4)
        matrix[:3, :3] = axes.T
        return matrix

    def _axes(self, low: F64, high: F64, custom: tuple[str, str] | None, facing: F64 | None) -> F64:
        """Return the 3x3 scene_from_stack rotation, based on the settings, the file's format, or a guess."""
        if self.settings.axes != "auto":
            up, out = self.settings.axes.split()
        elif not self.settings.fit and self.path.suffix.lower() not in GLTF:
            up, out = "+z", "+x"
        else:
            up, out = custom or guessed_axes(low, high)
            if self.settings.fit and facing is not None:
                up, out = turned_to_viewer(up, out, size=high - low, facing=facing)
            log.info(
                "%s: assuming that %s points up and %s points towards the viewer; set content.axes to change this",
                self.path.name,
                up,
                out,
            )
        return axes_matrix(out=out, up=up)


def guessed_axes(low: F64, high: F64) -> tuple[str, str]:
    """Guess the content's axes (up, towards the viewer) from its corners (3,): either (+y, +z) or (+z,
    -y). Objects are often on the ground at height 0. If only one of the y and z ranges begins near 0 or above, that
    axis is taken to be up. Otherwise, the longer axis is.
    """
    size = np.maximum(high - low, 1e-30)
    y, z = np.maximum(low / size + 0.5, 0.0)[1:]  # 0 if centred on the origin, 0.5 if it begins there
    z_is_up = z > y if abs(z - y) > STANDS else size[2] > size[1]
    return ("+z", "-y") if z_is_up else ("+y", "+z")


def turned_to_viewer(up: str, out: str, *, size: F64, facing: F64) -> tuple[str, str]:
    """Return axes (up, towards the viewer) that let a flat mesh's front, of mean normal `facing` (3,),
    face the viewer. A mesh that is flat along the up axis is shown from above, with its near edge at the bottom. If a
    mesh is not flat, its axes are returned unchanged.
    """
    thinnest = int(size.argmin())
    axis = "xyz"[thinnest]
    if size[thinnest] >= FLAT * np.sort(size)[1]:
        return up, out
    if axis == up[1]:
        up, out = _opposite(out), up
    elif axis != out[1]:
        out = f"+{axis}"
    looks = facing[thinnest] * (1 if out[0] == "+" else -1)
    return (up, _opposite(out)) if looks < -BACK else (up, out)


def _opposite(axis: str) -> str:
    return ("-" if axis[0] == "+" else "+") + axis[1]


def fitted(low: F64, high: F64, *, axes: F64, stack: PanelStack, depth_m: tuple[float, float]) -> F64:
    """Return the 4x4 stack_from_scene matrix that scales and centres a box, corners (3,) in its frame, to
    fit the display. `axes` is the scene_from_stack rotation. A scene deeper than the range `depth_m` (x: rear, front)
    begins at its front and extends beyond the rear, where it is mostly hidden.
    """
    size = np.abs(axes.T @ (high - low))
    room = np.array([DEEPER * (depth_m[1] - depth_m[0]), stack.width_m * FILL, stack.height_m * FILL])
    with np.errstate(divide="ignore"):
        scale = float(np.min(np.where(size > 0, room / np.where(size > 0, size, 1.0), np.inf)))
    if not np.isfinite(scale):
        scale = 1.0
    matrix = np.eye(4)
    matrix[:3, :3] = axes.T * scale
    middle_m = min(sum(depth_m) / 2, depth_m[1] - scale * float(size[0]) / 2)
    matrix[:3, 3] = [middle_m, 0.0, 0.0] - matrix[:3, :3] @ ((low + high) / 2)
    return matrix
