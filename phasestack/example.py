"""An example stereo pair, rendered by phasestack and free to use."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

import numpy as np

from phasestack.stack import Stack
from runtime.records import U8, Eyes
from runtime.support.artifacts import write_json, write_png
from runtime.support.picture_file import read_image

SCENE, EYES_M, FOV_DEG = "room", ((0.6, -0.0315, 0.03), (0.6, 0.0315, 0.03)), 40.0


@dataclass(frozen=True)
class ExamplePair:
    """A stereo pair, with the eye positions, stack and field of view used to render it."""

    left: U8  # (360, 640, 3)
    right: U8  # (360, 640, 3)
    eyes_m: Eyes  # left and right eye, (2, 3) metres, frame `stack`
    stack: Stack
    fov_deg: float  # horizontal

    def save(self, folder: str | Path) -> None:
        """Write left.png, right.png, panels.json and pair.json to a folder for `phasestack report --pairs`."""
        out, stack = Path(folder), self.stack
        panels = {"width_m": stack.width_m, "height_m": stack.height_m, "x_m": stack.x_m}
        for name, picture in (("left.png", self.left), ("right.png", self.right)):
            write_png(out / name, picture)
        write_json(out / "panels.json", panels)
        case = {"panels": panels, "eyes": self.eyes_m, "images": ["left.png", "right.png"], "fov": self.fov_deg}
        write_json(out / "pair.json", case)


def example_pair() -> ExamplePair:
    """Return a stereo pair rendered from a scene that extends behind and in front of the panels."""
    folder = Path(str(files("phasestack") / "data"))
    left, right = (read_image(folder / f"{side}.png") for side in ("left", "right"))
    stack = Stack(0.5184, 0.2916, (-0.06, 0.0, 0.06), width_px=left.shape[1], height_px=left.shape[0])
    return ExamplePair(left, right, np.array(EYES_M), stack, FOV_DEG)
