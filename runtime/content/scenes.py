"""Built-in scenes. Their lengths are scaled to the display's height."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from runtime.content import shapes
from runtime.content.base import WHITE, Colour
from runtime.content.shapes import Shape
from runtime.records import F64


@dataclass(frozen=True, slots=True)
class Thing:
    """An object in a scene. Lengths are in metres for a display that is 0.2916 m high."""

    shape: Shape  # centred on the origin
    texture: str  # texture name, or `plain`
    centre_m: tuple[float, float, float]  # the shape's origin in frame `stack`
    colour: Colour = WHITE  # multiplies the texture's colours
    rotation: F64 | None = None  # 3x3 rotation from the shape's frame to `stack`
    turns_per_s: float = 0.0  # revolutions about the vertical axis, in a moving scene
    lit: bool = True  # True if the lamp shades the object


@dataclass(frozen=True, slots=True)
class Scene:
    """A built-in scene: objects on a uniform background."""

    name: str
    things: tuple[Thing, ...]
    background: Colour = WHITE
    moving: bool = False
    grey: bool = False
    flat: bool = False  # True if all objects are in the middle panel's plane


def _turned(yaw_deg: float, pitch_deg: float = 0.0) -> F64:
    return shapes.rotation_about(2, np.radians(yaw_deg)) @ shapes.rotation_about(1, np.radians(pitch_deg))


def _table() -> Thing:
    flat_on_the_ground = shapes.rotation_about(1, -np.pi / 2)
    board = shapes.card(0.20, 0.40, repeat=(1.0, 2.0))
    return Thing(
        board, "checker", (0.0, 0.0, -0.105), rotation=flat_on_the_ground @ shapes.rotation_about(0, np.pi / 2)
    )


def _demo(turns_per_s: float = 0.0) -> tuple[Thing, ...]:
    return (
        _table(),
        Thing(shapes.card(0.17, 0.11), "picture", (-0.11, -0.085, 0.005), rotation=_turned(8), lit=False),
        Thing(shapes.fence(0.13, 0.09, bars=14, bar_m=0.0016), "plain", (-0.09, 0.10, -0.05), (0.20, 0.32, 0.42)),
        Thing(shapes.sphere(0.038), "globe", (-0.035, 0.095, 0.045), turns_per_s=turns_per_s),
        Thing(
            shapes.box((0.062,) * 3),
            "crate",
            (-0.005, -0.02, -0.073),
            rotation=_turned(28),
            turns_per_s=turns_per_s / 2,
        ),
        Thing(
            shapes.torus(0.032, 0.0115),
            "stripes",
            (0.06, 0.085, -0.062),
            rotation=_turned(-32, -18),
            turns_per_s=-turns_per_s,
        ),
        Thing(
            shapes.lettering("PHASE", cell_m=0.0042, depth_m=0.004), "plain", (0.07, -0.055, 0.052), (0.93, 0.36, 0.12)
        ),
        Thing(
            shapes.lettering("3D", cell_m=0.0046, depth_m=0.008),
            "plain",
            (0.095, -0.115, -0.070),
            (0.16, 0.32, 0.78),
            rotation=_turned(18),
        ),
    )


def _room() -> tuple[Thing, ...]:
    """Return a dim room, behind the display and wider than it, with objects of which a globe is the nearest."""
    wide, high, back = 0.56, 0.34, -0.14
    deep = 0.02 - back
    middle, down = (0.02 + back) / 2, shapes.rotation_about(1, -np.pi / 2)
    floor = shapes.card(wide, deep, repeat=(2.0, 0.5))
    wall = shapes.card(deep, high, repeat=(0.5, 1.0))
    sides = [
        Thing(wall, "mosaic", (middle, -edge * wide / 2, 0.0), (0.16, 0.18, 0.26), _turned(90 * edge), lit=False)
        for edge in (1, -1)
    ]
    poster = shapes.card(0.105, 0.072)
    return (
        Thing(shapes.card(wide, high, repeat=(2.0, 1.0)), "mosaic", (back, 0.0, 0.0), (0.10, 0.12, 0.19), lit=False),
        *sides,
        Thing(floor, "checker", (middle, 0.0, -0.11), (0.34, 0.33, 0.36), rotation=down, lit=False),
        Thing(poster, "picture", (back + 0.004, -0.105, 0.035), (0.75, 0.75, 0.75), lit=False),
        Thing(shapes.fence(0.16, 0.10, bars=13, bar_m=0.002), "plain", (-0.075, 0.10, -0.058), (0.50, 0.62, 0.78)),
        Thing(shapes.box((0.07,) * 3), "crate", (-0.04, -0.05, -0.075), rotation=_turned(28)),
        Thing(shapes.torus(0.036, 0.012), "stripes", (0.02, 0.075, -0.045), rotation=_turned(-24, -12)),
        Thing(shapes.lettering("PHASE", cell_m=0.0042, depth_m=0.006), "plain", (0.0, 0.09, 0.07), (0.95, 0.55, 0.16)),
        Thing(shapes.sphere(0.030), "globe", (0.085, -0.035, 0.028)),
        Thing(
            shapes.lettering("3D", cell_m=0.0050, depth_m=0.009),
            "plain",
            (0.075, -0.11, -0.050),
            (0.30, 0.62, 0.95),
            rotation=_turned(14),
        ),
    )


def _sparse() -> tuple[Thing, ...]:
    return (Thing(shapes.torus(0.021, 0.0075), "stripes", (0.02, 0.03, 0.0), rotation=_turned(-32, -18)),)


def _texture() -> tuple[Thing, ...]:
    """Return objects in front of a wall that fills the picture from every viewing position."""
    wall = shapes.card(3.2, 2.4, repeat=(12.0, 9.0))
    return (Thing(wall, "mosaic", (-0.10, 0.0, 0.0), lit=False), *_demo()[3:])


def _flat() -> tuple[Thing, ...]:
    return (Thing(shapes.card(0.44, 0.25, repeat=(1.76, 1.0)), "picture", (0.0, 0.0, 0.0), lit=False),)


SCENES: dict[str, Callable[[], Scene]] = {
    "demo": lambda: Scene("demo", _demo()),
    "room": lambda: Scene("room", _room(), background=(0.02, 0.02, 0.03)),
    "sparse": lambda: Scene("sparse", _sparse()),
    "texture": lambda: Scene("texture", _texture()),
    "grey": lambda: Scene("grey", _demo(), grey=True),
    "flat": lambda: Scene("flat", _flat(), flat=True),
    "moving": lambda: Scene("moving", _demo(turns_per_s=0.2), moving=True),
}
