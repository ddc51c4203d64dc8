"""Parts, which are triangles with a common material, and merging of parts that have equal materials."""

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
UNCOLOURED: Colour = (0.70, 0.74, 0.80)  # colour of meshes from files without colours
OPAQUE_FROM = 0.99  # alpha from which a pixel counts as opaque
LARGEST_TEXTURE_PX = 4096
OUTLINED_MAX = 200_000  # parts and files with more triangles get no outlines, which would cost more than drawing
Wrap = Literal["repeat", "clamp", "mirror"]


@dataclass(frozen=True, slots=True)
class Sampler:
    """Settings with which a texture is sampled."""

    wrap: tuple[Wrap, Wrap] = ("repeat", "repeat")  # wrap modes across and down
    nearest: bool = False  # True to magnify the texture without interpolation


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Triangles with a common material, in a frame that `TriangleSource` places in the scene."""

    shape: Shape
    picture: U8 | None = None  # RGBA texture (h, w, 4) whose row 0 is at v = 0; parts may share an array
    colour: Colour = WHITE  # factor on all colours, 0-1
    vertex_colours: F32 | None = None  # RGB or RGBA colours (v, 3 or 4), 0-1
    lit: bool = True  # True if the lamp shades the part
    grey: bool = False  # True to draw the part without colour
    turning: bool = False  # True if the part rotates, which requires a bounding box for every orientation
    sampler: Sampler = Sampler()
    opacity: float = 1.0
    alpha: Literal["opaque", "mask", "blend"] = "mask"
    cutoff: float = 0.5  # alpha below which a mask discards pixels
    two_sided: bool = True  # False to cull the back faces of a translucent part
    is_linear: bool = False  # True if colours (not pictures) are linear light and the shader computes in linear light
    glow: Colour = BLACK  # emitted light (linear), which `glow_picture` modulates
    glow_picture: U8 | None = None  # RGBA texture (h, w, 4)

    @property
    def features(self) -> tuple[str, ...]:
        """Names of the preprocessor symbols for which the part's shaders are compiled."""
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
    """Convert a Pillow image to an RGBA array (h, w, 4), whose sides are reduced to the texture limit."""
    if image.mode not in ("L", "RGB", "RGBA") or "transparency" in image.info:  # palette indices cannot be averaged
        image = image.convert("RGBA")
    image.thumbnail((LARGEST_TEXTURE_PX, LARGEST_TEXTURE_PX))
    return np.array(image.convert("RGBA"))


def coded(light: ArrayLike) -> F32:
    """Encode linear light as sRGB. Both are in [0, 1]."""
    linear = np.clip(np.asarray(light, np.float32), 0.0, 1.0)
    return np.where(linear <= 0.0031308, linear * np.float32(12.92), 1.055 * linear ** np.float32(1 / 2.4) - 0.055)


def merged(parts: Sequence[Part]) -> list[Part]:
    """Merge parts whose materials are equal, into parts of at most `OUTLINED_MAX` triangles.

    The materials of merged parts may differ in colour and opacity, which become vertex colours.
    """
    alike: dict[tuple[object, ...], list[list[Part]]] = {}
    for part in parts:
        if part.picture is None or part.vertex_colours is not None or (part.colour, part.opacity) != (WHITE, 1.0):
            part = replace(part, vertex_colours=_coloured(part), colour=WHITE, opacity=1.0)
        look = (
            *(id(picture) for picture in (part.picture, part.glow_picture)),
            *(part.glow, part.cutoff, part.alpha, part.two_sided, part.sampler),
            *(part.lit, part.is_linear, part.vertex_colours is None),
        )
        groups = alike.setdefault(look, [[]])
        if sum(len(other.shape.triangles) for other in (*groups[-1], part)) > OUTLINED_MAX and groups[-1]:
            groups.append([])
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
