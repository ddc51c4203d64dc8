"""The built-in scenes, drawn straight into the pixels that a view asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.content import shapes, textures
from runtime.content.base import ContentInfo, DrawingSource, View
from runtime.content.scenes import WHITE, Scene, Thing, scene
from runtime.content.triangles import Part, ReadyPart, TrianglePainter, ready
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.support.gl import DrawnPicture

MODELLED_HEIGHT_M = 0.2916  # the display for which the scenes' lengths are written


@dataclass(frozen=True, slots=True, eq=False)
class ReadyScene:
    """A built-in scene with its shapes and pictures made, a part a thing."""

    scene: Scene
    parts: tuple[ReadyPart, ...]


def ready_scene(built_in: str | Scene) -> ReadyScene:
    """The slow half of opening a scene. Needs no GL: may run on any thread."""
    chosen = scene(built_in) if isinstance(built_in, str) else built_in
    pictures = {name: textures.texture(name) for name in {thing.texture for thing in chosen.things}}
    parts = [
        Part(
            thing.shape,
            picture=pictures[thing.texture],
            colour=thing.colour,
            lit=thing.lit,
            grey=chosen.grey,
            turning=chosen.moving and thing.turns_per_s != 0,
        )
        for thing in chosen.things
    ]
    return ReadyScene(chosen, tuple(ready(part) for part in parts))


class ProceduralSource(DrawingSource):
    """A built-in scene, scaled to the display's height."""

    def __init__(
        self,
        built_in: str | Scene | ReadyScene,
        *,
        stack: PanelStack,
        context: Any,
        background: tuple[float, float, float] | None = None,
    ) -> None:
        """background: None: the one that its pictures were made for, white."""
        made = built_in if isinstance(built_in, ReadyScene) else ready_scene(built_in)
        background = background or WHITE
        self._scene = made.scene
        self._scale = stack.height_m / MODELLED_HEIGHT_M
        self.draws_in = context
        self._painter = TrianglePainter(made.parts, context=context, background=background)
        self._still = [self._placed(thing, 0.0) for thing in self._scene.things]
        corners = self._painter.corners_m(self._still)
        self.info = ContentInfo(
            name=self._scene.name,
            moving=self._scene.moving,
            grey=self._scene.grey,
            depth_range_m=(float(corners[:, 0].min()), float(corners[:, 0].max())),
            background=background,
            flat_x_m=0.0 if self._scene.flat else None,
        )

    def draw(self, view: View, *, time_ns: int) -> DrawnPicture:
        """The scene through the view's projection; the same bytes for the same view and time."""
        return self._painter.paint(view, self._places(time_ns))

    def extent(self, view: View, *, time_ns: int) -> PixelRect:
        return self._painter.extent(view, self._places(time_ns))

    def close(self) -> None:
        self._painter.close()

    def _places(self, time_ns: int) -> list[F64]:
        """4x4 stack_from_thing of every thing."""
        if not self._scene.moving:
            return self._still
        return [self._placed(thing, time_ns / NS_PER_S) for thing in self._scene.things]

    def _placed(self, thing: Thing, time_s: float) -> F64:
        """4x4 stack_from_thing at a time."""
        turn = np.eye(3) if thing.rotation is None else thing.rotation
        if self._scene.moving and thing.turns_per_s:
            turn = shapes.rotation_about(2, 2 * np.pi * thing.turns_per_s * time_s) @ turn
        matrix = np.eye(4)
        matrix[:3, :3] = turn * self._scale
        matrix[:3, 3] = np.asarray(thing.centre_m) * self._scale
        return matrix
