"""A scene file and the placement of its coordinates in the stack frame: a preset's, or fitted."""

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

FILL = 0.75  # of the display's width and height that a fitted scene takes: its front is seen larger
DEEPER = 2.0  # times `depth_m`, that a fitted scene may be
BACK = 0.5  # component of a flat mesh's mean normal away from the viewer that turns it around
FLAT = 0.1  # a mesh thinner than this fraction of its other sides faces the viewer
STANDS = 0.2  # of its height: a range that begins higher by this fraction along one axis makes that axis up
GLTF = (".glb", ".gltf")
CUSTOMS = {".glb": ("+y", "+z"), ".gltf": ("+y", "+z"), ".obj": ("+y", "+z"), ".stl": ("+z", "-y")}  # up, and forwards
DARK = (0.12, 0.12, 0.12)  # behind all but the built-in scenes: ghosts are seen on it, brighter and darker ones


@dataclass(frozen=True, slots=True)
class SceneFile:
    """A file, the settings that it is shown with, and the display."""

    path: Path
    settings: ContentSettings
    stack: PanelStack
    preset: str = ""  # that the file is of

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour."""
        return self.settings.background or DARK

    def placed(self, low: F64, high: F64, *, custom: tuple[str, str] | None = None, facing: F64 | None = None) -> F64:
        """Return the 4x4 stack_from_scene of content with these corners: preset, fitted, or in its metres.

        custom: the up axis and the axis towards the viewer of the file's format; None: chosen by the file name. facing:
        area-weighted mean normal (3,) of the surface; with it, a flat mesh is turned to face the viewer.
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
        """3x3 scene_from_stack rotation: as set, else the format's custom or the display's own, else guessed."""
        if self.settings.axes != "auto":
            up, out = self.settings.axes.split()
        elif not self.settings.fit and self.path.suffix.lower() not in GLTF:
            up, out = "+z", "+x"
        else:
            up, out = custom or guessed_axes(low, high)
            if self.settings.fit and facing is not None:
                up, out = turned_to_viewer(up, out, size=high - low, facing=facing)
            log.info("%s: taken to have %s up and %s towards the viewer (content.axes)", self.path.name, up, out)
        return axes_matrix(out=out, up=up)


def guessed_axes(low: F64, high: F64) -> tuple[str, str]:
    """The up axis and the one towards the viewer, guessed from an extent: +y and +z, or +z and -y.

    The up axis is the one whose range begins near 0 or above; if both or neither do, the longer one.
    """
    size = np.maximum(high - low, 1e-30)
    y, z = np.maximum(low / size + 0.5, 0.0)[1:]  # 0: centred on the origin; 0.5: begins there
    z_is_up = z > y if abs(z - y) > STANDS else size[2] > size[1]
    return ("+z", "-y") if z_is_up else ("+y", "+z")


def turned_to_viewer(up: str, out: str, *, size: F64, facing: F64) -> tuple[str, str]:
    """The axes up and to the viewer, changed for a flat mesh so that its front faces the viewer.

    size: (3,) of its bounding box. A mesh flat along the up axis is seen from above, its near edge at the bottom.
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
    """4x4 stack_from_scene that centres a box and scales it to the display's size and depth.

    A scene deeper than `depth_m` (rear, front) begins at the front and extends past the rear, where most is hidden.
    low, high: (3,) corners in the scene's coordinates; axes: 3x3 scene_from_stack rotation.
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
