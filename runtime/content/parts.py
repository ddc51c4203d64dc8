"""Parts (triangles that share a material), and a function that merges parts with equal materials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from runtime.content.base import WHITE, Colour
from runtime.content.shapes import Shape, join
from runtime.records import F32, U8

BLACK: Colour = (0.0, 0.0, 0.0)
UNCOLOURED: Colour = (0.70, 0.74, 0.80)  # colour of meshes whose files contain no colours
OPAQUE_FROM = 0.99  # a pixel with at least this alpha counts as opaque
LARGEST_TEXTURE_PX = 4096
OUTLINED_MAX = 200_000  # parts and files with more triangles get no outlines, which would take longer than drawing
Wrap = Literal["repeat", "clamp", "mirror"]


@dataclass(frozen=True, slots=True)
class Sampler:
    """Texture sampling settings."""

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")  # horizontal and vertical wrap modes
    nearest: bool = False  # True to magnify the texture without interpolation


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Triangles that share a material, in a frame that `TriangleSource` places in the scene."""

    shape: Shape
    picture: U8 | None = None  # RGBA texture (h, w, 4) with row 0 at v = 0; several parts may share an array
    colour: Colour = WHITE  # multiplies all colours, 0-1
    vertex_colours: F32 | None = None  # RGB or RGBA colours (v, 3 or 4), 0-1
    lit: bool = True  # True if the lamp shades the part
    grey: bool = False  # True to draw the part without colour
    turning: bool = False  # True if the part rotates, so its bounding box must hold every orientation
    sampler: Sampler = Sampler()
    opacity: float = 1.0
    alpha: Literal["opaque", "mask", "blend"] = "mask"
    cutoff: float = 0.5  # a mask discards pixels whose alpha is below this
    two_sided: bool = True  # False to cull the back faces of a translucent part
    is_linear: bool = False  # True if colours (not pictures) are linear light and the shader computes in linear light
    glow: Colour = BLACK  # emitted light (linear), multiplied by `glow_picture`
    glow_picture: U8 | None = None  # RGBA texture (h, w, 4)

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the preprocessor symbols to define when compiling the part's shaders."""
        least = self.opacity
        if self.picture is not None:
            least *= float(self.picture[..., 3].min()) / 255
        if self.vertex_colours is not None and self.vertex_colours.shape[1] == 4:
            least *= float(self.vertex_colours[:, 3].min())
        switches = {
            "LIT": self.lit,
            "PICTURE": self.picture is not None,
            "HOLES": self.alpha == "mask" and least < self.cutoff,
            "BLEND": self.alpha == "blend" and least < OPAQUE_FROM,
            "COLOURED": self.vertex_colours is not None,
            "GREY": self.grey,
            "LINEAR": self.is_linear,
            "GLOW": self.glow != BLACK,
            "GLOW_PICTURE": self.glow != BLACK and self.glow_picture is not None,
            "MIRROR_U": self.sampler.wrap[0] == "mirror",
            "MIRROR_V": self.sampler.wrap[1] == "mirror",
        }
        return tuple(name for name, is_on in switches.items() if is_on)


def texture_of(image: Any) -> U8:
    """Convert a Pillow image to an RGBA array (h, w, 4), shrunk to the texture limit if it is larger."""
    if image.mode not in ("L", "RGB", "RGBA") or "transparency" in image.info:  # palette indices cannot be averaged
        image = image.convert("RGBA")
    image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
    return np.array(image.convert("RGBA"))


def coded(light: ArrayLike) -> F32:
    """Encode linear light as sRGB. Both are in [0, 1]."""
    linear = np.clip(np.asarray(light, np.float32), 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * np.float32(12.92), 1.055 * linear ** np.float32(1 / 2.4) - 0.055)


def merged(parts: Sequence[Part]) -> list[Part]:
    """Merge parts with equal materials, up to `OUTLINED_MAX` triangles, with vertex colours."""
    alike: dict[tuple[object, ...], list[list[Part]]] = {}
    counts: dict[tuple[object, ...], int] = {}  # triangles in the last group
    for part in parts:
        if part.picture is None or part.vertex_colours is not None or (part.colour, part.opacity) != (WHITE, 1.0):
            part = replace(part, vertex_colours=_coloured(part), colour=WHITE, opacity=1.0)
        look = (
            *(id(picture) for picture in (part.picture, part.glow_picture)),
            *(part.glow, part.cutoff, part.alpha, part.two_sided, part.sampler),
            *(part.lit, part.is_linear, part.vertex_colours is None),
        )
        groups = alike.setdefault(look, [[]])
        counts[look] = counts.get(look, 0) + len(part.shape.triangles)
        if counts[look] > OUTLINED_MAX and groups[-1]:
            groups.append([])
            counts[look] = len(part.shape.triangles)
        groups[-1].append(part)
    return [_one(group) for groups in alike.values() for group in groups]


def _coloured(part: Part) -> F32:
    """Return RGBA vertex colours (v, 4) that include the part's colour and opacity."""
    colours = np.ones((len(part.shape.positions_m), 4), np.float32)
    if part.vertex_colours is not None:
        colours[:, : part.vertex_colours.shape[1]] = part.vertex_colours
    colours *= np.array([*part.colour, part.opacity], np.float32)
    return colours


def _one(group: list[Part]) -> Part:
    if len(group) == 1:
        return group[0]
    given_colours = [part.vertex_colours for part in group if part.vertex_colours is not None]
    colours = np.concatenate(given_colours) if given_colours else None
    return replace(group[0], shape=join([part.shape for part in group]), vertex_colours=colours)
