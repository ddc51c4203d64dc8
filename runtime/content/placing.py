"""Place the coordinates of a scene's file in the stack frame, by a preset or by fitting."""

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

FILL = 0.75  # share of the display's width and height that a fitted scene gets, as its front appears larger
DEEPER = 2.0  # a fitted scene may be this many times as deep as `depth_m`
BACK = 0.5  # a flat mesh is turned around if its mean normal points away from the viewer by this much
FLAT = 0.1  # a mesh thinner than this fraction of its other sides is flat, and turned to face the viewer
STANDS = 0.2  # an axis is up if its range begins higher than the other's by this fraction of the height
GLTF = (".glb", ".gltf")
CUSTOMS = {".glb": ("+y", "+z"), ".gltf": ("+y", "+z"), ".obj": ("+y", "+z"), ".stl": ("+z", "-y")}  # up, to viewer
DARK = (0.12, 0.12, 0.12)  # background of all but the built-in scenes, on which brighter and darker ghosts are visible


@dataclass(frozen=True, slots=True)
class SceneFile:
    """File of a scene, the settings with which it is shown, and the display."""

    path: Path
    settings: ContentSettings
    stack: PanelStack
    preset: str = ""  # name of the file's preset

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour of the scene."""
        return self.settings.background or DARK

    def placed(self, low: F64, high: F64, *, custom: tuple[str, str] | None = None, facing: F64 | None = None) -> F64:
        """Return the 4x4 stack_from_scene of content: by its preset, fitted, or unscaled in metres.

        low, high: (3,) corners of the content. custom: axes (up, towards the viewer) that are usual in the file's
        format; None: chosen by the file's name. facing: area-weighted mean normal (3,) of the surface; with it, a flat
        mesh is turned to face the viewer.
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
        """Return the 3x3 scene_from_stack rotation: as set, as usual in the file's format, or guessed."""
        if self.settings.axes != "auto":
            up, out = self.settings.axes.split()
        elif not self.settings.fit and self.path.suffix.lower() not in GLTF:
            up, out = "+z", "+x"
        else:
            up, out = custom or guessed_axes(low, high)
            if self.settings.fit and facing is not None:
                up, out = turned_to_viewer(up, out, size=high - low, facing=facing)
            log.info(
                "%s: assuming that %s points up and %s points to the viewer; set content.axes to change this",
                self.path.name,
                up,
                out,
            )
        return axes_matrix(out=out, up=up)


def guessed_axes(low: F64, high: F64) -> tuple[str, str]:
    """Guess the axes (up, towards the viewer) from an extent: (+y, +z) or (+z, -y).

    If exactly one of the y and z ranges begins near 0 or above, its axis is up; otherwise the longer axis is.
    """
    size = np.maximum(high - low, 1e-30)
    y, z = np.maximum(low / size + 0.5, 0.0)[1:]  # 0: centred on the origin; 0.5: begins at the origin
    z_is_up = z > y if abs(z - y) > STANDS else size[2] > size[1]
    return ("+z", "-y") if z_is_up else ("+y", "+z")


def turned_to_viewer(up: str, out: str, *, size: F64, facing: F64) -> tuple[str, str]:
    """Return the axes (up, to the viewer), changed for a flat mesh so that its front faces the viewer.

    size: (3,) of the bounding box. A mesh that is flat along the up axis is seen from above, with its near edge at the
    bottom.
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
    """Return the 4x4 stack_from_scene that centres a box and scales it to the display's size and depth.

    A scene deeper than `depth_m` (rear, front) begins at the front and extends beyond the rear, where most of it is
    hidden. low, high: (3,) corners in the scene's coordinates; axes: 3x3 scene_from_stack rotation.
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
