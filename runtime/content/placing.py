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
FLAT = 0.1  # what is thinner than this share of its other sides is shown from its flat side
STANDS = 0.2  # of its height: what stands so much higher above 0 along one axis than along another has that one up
DARK = (0.12, 0.12, 0.12)  # behind all but the built-in scenes: ghosts are seen on it, brighter and darker ones


@dataclass(frozen=True, slots=True)
class SceneFile:
    """What a source is made of."""

    path: Path
    settings: ContentSettings
    stack: PanelStack
    preset: str = ""  # that the file is of

    @property
    def background(self) -> tuple[float, float, float]:
        """Background colour."""
        return self.settings.background or DARK

    def placed(self, low: F64, high: F64) -> F64:
        """4x4 stack_from_scene of what has these corners: the preset's, else fitted, else its own metres."""
        if self.preset:
            return stack_from_preset(self.preset)
        axes = self._axes(low, high)
        if self.settings.fit:
            return fitted(low, high, axes=axes, stack=self.stack, depth_m=self.settings.depth_m)
        matrix = np.eye(4)
        matrix[:3, :3] = axes.T
        return matrix

    def _axes(self, low: F64, high: F64) -> F64:
        """3x3 scene_from_stack rotation: as set, else glTF's, else the display's own, else guessed and said."""
        if self.settings.axes != "auto":
            up, out = self.settings.axes.split()
        elif self.path.suffix.lower() in (".glb", ".gltf"):
            up, out = "+y", "+z"
        elif not self.settings.fit:
            up, out = "+z", "+x"
        else:
            up, out = guessed_axes(low, high)
            log.info("%s: taken to have %s up and %s towards the viewer (content.axes)", self.path.name, up, out)
        return axes_matrix(out=out, up=up)


def guessed_axes(low: F64, high: F64) -> tuple[str, str]:
    """The up axis and the one towards the viewer, guessed from an extent: +y and +z, or +z and -y.

    What lies flat is shown from its flat side. Else the axis is up along which it stands on 0 or above, and not
    around it; else the longer one.
    """
    size = np.maximum(high - low, 1e-30)
    thinnest = int(size.argmin())
    if size[thinnest] < FLAT * np.sort(size)[1] and thinnest > 0:
        return ("+z", "-y") if thinnest == 1 else ("+y", "+z")
    y, z = np.maximum(low / size + 0.5, 0.0)[1:]  # 0: around the origin; a half: stands on it
    z_is_up = z > y if abs(z - y) > STANDS else size[2] > size[1]
    return ("+z", "-y") if z_is_up else ("+y", "+z")


def fitted(low: F64, high: F64, *, axes: F64, stack: PanelStack, depth_m: tuple[float, float]) -> F64:
    """4x4 stack_from_scene that centres a box and scales it to the display's size and depth.

    What is deeper than `depth_m` (rear, front) begins at its front and reaches behind its rear, where most is hidden.
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
