"""Joint steps (`runtime.model.compiled.joint`) by fragment shaders: a pass compares, and one a panel moves it.

Panels are held twice in signed sixteenths of a code: `ahead`, with momentum, which is seen, and `last`, without.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from runtime.model.gl.programs import Image, Passes
from runtime.model.reprojection import CENTRE, FRONT, REAR, START
from runtime.records import F64

EYES = ("left", "right")
NAMES = {REAR: "rear", CENTRE: "centre", FRONT: "front"}
RAYS = -1
PLACES = ("", "_2")  # that unsure eyes are seen from in one step


class GlJoint:
    """The panels between steps."""

    def __init__(self, passes: Passes, image: Callable[[int, str, str], Image]) -> None:
        """image: of a panel's raster, or the rays' (`RAYS`), by a name of its own and a kind (`i2` or `f1`); the same
        for the same."""
        self._passes, self._image = passes, image
        self._turn = 0  # panels are drawn from one pair of images into another

    def start(self, panels: Mapping[int, Image]) -> None:
        """Begin at panels, without momentum."""
        self._now = {n: (panel, panel) for n, panel in panels.items()}

    @property
    def panels(self) -> dict[int, Image]:
        """Without momentum."""
        return {n: last for n, (_, last) in self._now.items()}

    def step(
        self,
        seen: F64,
        targets: Mapping[str, Image],
        *,
        size: float,
        momentum: float,
        floor: float,
        ends: Mapping[str, Any],
    ) -> None:
        """seen: (rays, 3, 3, 3) panels' pixels from the rays', left and right eyes in turn; targets: what is to be seen
        along the rays, `left` and `right`; ends: how a part of larger panels does (`ends.glsl`)."""
        back = np.linalg.inv(seen)
        images = {NAMES[n]: ahead for n, (ahead, _) in self._now.items()}
        sizes = {f"{name}_size": image.size for name, image in images.items()}
        compared: dict[str, Image] = {}
        for place, (left, right) in zip(PLACES, seen.reshape(-1, 2, 3, 3, 3), strict=False):
            found = {
                f"{kind}_{eye}{place}": self._image(RAYS, f"{kind}_{eye}{place}", dtype)
                for kind, dtype in (("push", "i2"), ("hold", "f1"))
                for eye in EYES
            }
            looks = {
                f"{NAMES[n]}_from_{eye}": _mat3(matrices[n])
                for eye, matrices in zip(EYES, (left, right), strict=True)
                for n in NAMES
            }
            inputs = images | {f"target_{eye}": targets[eye] for eye in EYES}
            self._draw("compare", tuple(found.values()), inputs, {**sizes, **looks, **ends})
            compared |= found
        self._turn ^= 1
        unsure = ("UNSURE",) if len(seen) > 2 else ()
        how = {"step_size": size, "momentum": momentum, "least_hold": floor * len(seen)}
        for n, (ahead, last) in self._now.items():
            looks = {
                f"rays_from_{eye}{place}": _mat3(matrices[n])
                for place, pair in zip(PLACES, back.reshape(-1, 2, 3, 3, 3), strict=False)
                for eye, matrices in zip(EYES, pair, strict=True)
            }
            moved = tuple(self._image(n, f"{kind} {self._turn}", "i2") for kind in ("ahead", "last"))
            inputs = {**compared, "ahead": ahead, "last": last}
            self._draw("move", moved, inputs, {**looks, **how, "size": targets["left"].size}, defines=unsure)
            self._now[n] = moved[0], moved[1]

    def _draw(
        self,
        name: str,
        outputs: tuple[Image, ...],
        inputs: Mapping[str, Image],
        uniforms: Mapping[str, Any],
        *,
        defines: tuple[str, ...] = (),
    ) -> None:
        self._passes.draw(name, outputs, inputs, {**uniforms, "even": START}, defines=defines)


def _mat3(matrix: F64) -> tuple[float, ...]:
    """Column by column, as OpenGL has it."""
    return tuple((matrix / matrix[2, 2]).T.ravel().tolist())
