"""Draw the built-in scenes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.content import shapes, textures
from runtime.content.base import Colour, ContentInfo
from runtime.content.parts import Part
from runtime.content.scenes import SCENES, Scene, Thing
from runtime.content.triangles import DrawnPart, TriangleSource
from runtime.optics.stack import PanelStack
from runtime.records import F64

MODELLED_HEIGHT_M = 0.2916  # display height that the scenes' lengths are meant for


def parts_of(built_in: Scene) -> list[DrawnPart]:
    """Prepare a scene's parts, one per object: the slow half of opening it, without a GL context."""
    pictures = {name: textures.texture(name) for name in {thing.texture for thing in built_in.things}}
    return [
        DrawnPart(
            Part(
                thing.shape,
                picture=pictures[thing.texture],
                colour=thing.colour,
                lit=thing.lit,
                grey=built_in.grey,
                turning=built_in.moving and thing.turns_per_s != 0,
            )
        )
        for thing in built_in.things
    ]


class ProceduralSource(TriangleSource):
    """Source that draws a built-in scene, scaled to the display's height."""

    def __init__(
        self,
        built_in: str | Scene,
        *,
        stack: PanelStack,
        context: Any,
        background: Colour | None = None,
        parts: Sequence[DrawnPart] | None = None,
    ) -> None:
        """Create a scene, scaled to the panels' height, from its `parts_of` if they were prepared on another thread."""
        self._scene = SCENES[built_in]() if isinstance(built_in, str) else built_in
        self._scale = stack.height_m / MODELLED_HEIGHT_M
        parts = parts or parts_of(self._scene)
        still = [self._placed(thing, 0.0) for thing in self._scene.things]
        info = ContentInfo(
            name=self._scene.name,
            moving=self._scene.moving,
            grey=self._scene.grey,
            background=background or self._scene.background,
            flat_x_m=0.0 if self._scene.flat else None,
        )
        super().__init__(parts, still, context=context, info=info)

    def places(self, time_ns: int) -> Sequence[F64]:
        if not self._scene.moving:
            return self.stack_from_parts
        return [self._placed(thing, time_ns / NS_PER_S) for thing in self._scene.things]

    def _placed(self, thing: Thing, time_s: float) -> F64:
        """Return the 4x4 matrix that places an object in frame `stack` at a given time."""
        turn = np.eye(3) if thing.rotation is None else thing.rotation
        if self._scene.moving and thing.turns_per_s:
            turn = shapes.rotation_about(2, 2 * np.pi * thing.turns_per_s * time_s) @ turn
        matrix = np.eye(4)
        matrix[:3, :3] = turn * self._scale
        matrix[:3, 3] = np.asarray(thing.centre_m) * self._scale
        return matrix
