"""Solver backend for OpenGL. Panels are textures, and steps are passes of fragment shaders.

Between steps, all data are 16-bit values from 0 to 1, which every driver can filter and draw into. Their meaning is
described in `shaders/places.glsl`. If a single channel is solved, textures have one component. Otherwise they have four
and one is unused, because drivers need not support drawing into textures with three components.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import cv2
import moderngl
import numpy as np

from runtime.errors import InputError
from runtime.kernels import FULL
from runtime.model.buffers import LayerBuffer
from runtime.model.contract import Step
from runtime.model.geometry import Geometry, RaySets, TargetView, inverse
from runtime.model.gl.programs import Counts, Image, Passes
from runtime.model.job import Job
from runtime.model.targets import outside_codes, rest_of, target_table
from runtime.optics.stack import PanelStack
from runtime.records import F64, I16
from runtime.support.gl import DrawnPicture

MOST_SETS = 6  # maximum number of ray sets that a shader reads; every driver allows 16 images


class GlBackend:
    """Backend in one OpenGL context, for its thread only, whose models share the shader programs."""

    name = "gl"

    def __init__(self, context: Any, stack: PanelStack) -> None:
        """Create the backend; the caller releases `context`. Raises InputError if a panel is too large for it."""
        check_size(context, stack)
        self.context, self.passes = context, Passes(context)

    def state(self, stack: PanelStack, *, threads: int) -> GlState:
        return GlState(self.passes, stack)

    def close(self) -> None:
        with suppress(Exception):  # a lost context has nothing to release
            self.passes.release()


class GlState:
    """`SolverState` for OpenGL: textures that are kept between solutions.
    For the OpenGL context's thread only.
    """

    def __init__(self, passes: Passes, stack: PanelStack) -> None:
        """Create the state, which may share `passes`. Raises InputError if a panel is too large for the driver."""
        check_size(passes.context, stack)
        self.passes, self.stack = passes, stack
        self._textures: dict[tuple[Any, ...], Any] = {}
        self._names: dict[str, str] = {}  # which image currently has each role, for pairs of images that are swapped
        self.ahead = "last"  # role of the panels that the next step reads
        self._closed = False

    @contextmanager
    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> Iterator[GlSolution]:
        with self.passes.drawing():
            yield GlSolution(self, job, geometry, resumed=resumed)

    def texture(self, name: Any, size: tuple[int, int], components: int, *, dtype: str, data: Any = None) -> Any:
        """Return the texture of this name, made at the first call."""
        key = (name, components, dtype)
        if key not in self._textures:
            texture = self.passes.context.texture(size, components, data, dtype=dtype, alignment=1)
            smooth = moderngl.LINEAR if dtype == "nu2" else moderngl.NEAREST
            texture.filter, texture.repeat_x, texture.repeat_y = (smooth, smooth), False, False
            self._textures[key] = texture
        return self._textures[key]

    def texture_of(self, name: str, least: tuple[int, int], components: int, *, dtype: str) -> Any:
        """Return the texture of this name. One that is too small is replaced with a larger one."""
        texture = self._textures.get(key := (name, components, dtype))
        size = least
        if texture is not None and (texture.width < least[0] or texture.height < least[1]):
            size = max(least[0], texture.width), max(least[1], texture.height)
            self.passes.forget(self._textures.pop(key))
        return self.texture(name, size, components, dtype=dtype)

    def panel_texture(self, role: str, n: int, components: int) -> Any:
        """Return the texture with a role for a panel, as large as the panel, so that its box can move."""
        key = (self._names.get(f"{role} {n}", role), n)
        return self.texture(key, (self.stack.width_px, self.stack.height_px), components, dtype="nu2")

    def swap(self, one: str, other: str, n: int) -> None:
        """Exchange the roles of two of a panel's textures."""
        a, b = f"{one} {n}", f"{other} {n}"
        self._names[a], self._names[b] = self._names.get(b, other), self._names.get(a, one)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with suppress(Exception):  # a lost context has nothing to release
                for texture in self._textures.values():
                    self.passes.forget(texture)
            self._textures = {}


class GlSolution:
    """`OpenSolution` for OpenGL."""

    def __init__(self, state: GlState, job: Job, geometry: Geometry, *, resumed: bool) -> None:
        self._state, self._passes, self._stack, self._count = state, state.passes, state.stack, state.stack.count
        self._geometry, self._channels, self._sigma_m = geometry, job.channels, job.eye_sigma_m
        self._targets = [self._loaded(view, side) for side, view in enumerate(job.views)]
        for name, taper in zip(("column_taper", "row_taper"), geometry.tapers(), strict=True):
            self._taper(name).texture.write(taper, viewport=(0, 0, len(taper), 1))
        rest = (rest_of(self._count) / FULL + 1) / 3
        for n in range(0 if resumed else self._count):
            self._passes.target((self._panel("last", n),)).clear(rest, rest, rest, rest)

    def set_panel(self, panel: int, codes: I16) -> None:
        box, grey = self._geometry.boxes[panel], self._stack.is_grey(panel) and codes.ndim == 3
        if codes.ndim == 3:
            codes = np.asarray(cv2.cvtColor(codes.view(np.uint16), cv2.COLOR_RGB2RGBA)).view(np.int16)
        size = self._stack.width_px, self._stack.height_px
        held = Image(self._state.texture("codes", size, self._components, dtype="i2"), box.width_px, box.height_px)
        held.texture.write(np.ascontiguousarray(codes), viewport=(0, 0, *held.size), alignment=1)
        self._passes.draw("load", (self._panel("last", panel),), {"codes": held}, {"grey": grey})

    def panel(self, panel: int) -> I16:
        image, components = self._panel("last", panel), self._components
        held = self._passes.target((image,)).read(
            viewport=(0, 0, *image.size), components=components, dtype="nu2", alignment=1
        )
        stored = np.frombuffer(held, np.uint16).reshape(image.height_px, image.width_px, components)
        if components == 4:
            stored = np.asarray(cv2.cvtColor(stored, cv2.COLOR_RGBA2RGB), np.uint16)
        unit = 3 * FULL / 65535
        codes = np.asarray(cv2.addWeighted(stored, unit, stored, 0.0, -FULL, dtype=cv2.CV_16S), np.int16)
        return codes.reshape(image.height_px, image.width_px, self._channels)

    def close_middle(self) -> None:
        sets, middle = self._geometry.closing_sets(), self._geometry.middle
        table = self._state.texture("table", (256, 1), 2, dtype="f4", data=target_table(self._count))
        inputs = {f"last{n}": self._panel("last", n) for n in range(self._count)} | {"table": Image(table, 256, 1)}
        rest = rest_of(self._count) / FULL
        weights = {"rest": rest, "missing": self._geometry.missing_weight, "middle": middle}
        fields: list[tuple[Image, Image]] = []
        for number, (view, matrices) in enumerate(zip(sets.views, sets.panels_from_rays, strict=True)):
            weight, residual = self._rays(f"curvature {number}"), self._rays(f"gradient {number}")
            targets = {"targets": self._targets[view][0]}
            uniforms = {**self._through(matrices, view), **weights}
            panels: Counts = (("PANELS", self._count),)
            self._passes.draw("residual", (weight, residual), {**inputs, **targets}, uniforms, counts=panels)
            fields.append((weight, residual))
        gathered, uniforms, counts = self._gathered(fields, sets, middle)
        self._passes.draw("fill", (self._panel("last", middle),), gathered, {**uniforms, "rest": rest}, counts=counts)

    def start(self) -> None:
        self._state.ahead = "last"  # there is no momentum yet, so the first step reads the panels themselves

    def step(self, step: Step) -> None:
        sets = self._geometry.ray_sets(step.places, self._sigma_m)
        ahead = {f"ahead{n}": self._panel(self._state.ahead, n) for n in range(self._count)}
        tapers = {name: self._taper(name) for name in ("column_taper", "row_taper")}
        fields: list[tuple[Image, Image]] = []
        for number, (view, turn, matrices) in enumerate(zip(sets.views, sets.turn, sets.panels_from_rays, strict=True)):
            drawn = self._rays(f"curvature {number}", sets.turns), self._rays(f"gradient {number}", sets.turns)
            inputs = {**ahead, "targets": self._targets[view][0], **tapers}
            uniforms = {**self._through(matrices, view), "turn": (sets.turns, turn)}
            self._passes.draw("compare", drawn, inputs, uniforms, counts=(("PANELS", self._count),))
            fields.append(drawn)
        for n in range(self._count):
            gathered, uniforms, counts = self._gathered(fields, sets, n)
            # Collected sums are divided by the number of sets. This changes the step only through the floor.
            share = 1.0 if len(fields) <= MOST_SETS else 1.0 / len(fields)
            update = {
                "size": step.size / (self._count * np.pi / 2), "momentum": step.momentum,
                "least": step.floor * len(fields) * share,
            }  # fmt: skip
            inputs = {"ahead": ahead[f"ahead{n}"], "last": self._panel("last", n), **gathered}
            outputs = self._panel("moved", n), self._panel("spare", n)
            self._passes.draw("move", outputs, inputs, {**uniforms, **update}, counts=counts)
            self._state.swap("ahead", "moved", n)
            self._state.swap("last", "spare", n)
        self._state.ahead = "ahead"

    def _gathered(
        self, fields: Sequence[tuple[Image, Image]], sets: RaySets, n: int
    ) -> tuple[dict[str, Image], dict[str, Any], Counts]:
        """Return the inputs, uniforms and counts with which a shader sums the ray sets' quantities at panel `n`. If
        there are more sets than a shader can read, they are first collected in groups.
        """
        back = inverse(sets.panels_from_rays)[:, n]
        rays: tuple[int, int] = fields[0][0].size
        grey = self._stack.is_grey(n) and self._channels > 1
        if len(fields) > MOST_SETS:
            groups, box = range(0, len(fields), MOST_SETS), self._panel("last", n).size
            collected = []
            for group in groups:
                part = slice(group, group + MOST_SETS)
                inputs, uniforms, counts = _summed(fields[part], back[part], rays, grey=False)
                means = self._panel(f"first {group}", n), self._panel(f"second {group}", n)
                self._passes.draw("collect", means, inputs, {**uniforms, "total": float(len(fields))}, counts=counts)
                collected.append(means)
            fields, back, rays = collected, np.repeat(np.eye(3)[None], len(groups), axis=0), box
        return _summed(fields, back, rays, grey=grey)

    def write(self, buffer: LayerBuffer, outside: int | tuple[int, ...] | None) -> None:
        width, height = self._stack.width_px, self._stack.height_px
        layers = [self._state.texture(("layer", n), (width, height), 4, dtype="f1") for n in range(self._count)]
        for n, texture in enumerate(layers):
            image, box = Image(texture, width, height), self._geometry.boxes[n]
            kept = self._geometry.kept if n == self._geometry.middle else box
            if outside is not None:
                self._passes.target((image,)).clear(
                    *(code / 255 for code in outside_codes(self._count, n, outside)), 1.0
                )
            if kept.width_px and kept.height_px:
                place = {"first": (kept.u0 - box.u0, kept.v0 - box.v0), "grey": self._channels == 1}
                inputs = {"last": self._panel("last", n)}
                self._passes.draw("show", (image,), inputs, place, at=(kept.u0, kept.v0, kept.width_px, kept.height_px))
        for texture, layer in zip(layers, buffer.pixels, strict=True):
            self._passes.target((Image(texture, width, height),)).read_into(layer, components=4)

    def _loaded(self, view: TargetView, side: int) -> tuple[Image, tuple[int, int]]:
        """Return the image of a view's target picture, uploaded if an array, and the (column, row) of its first ray."""
        rays = self._geometry.rays
        if isinstance(view.picture, DrawnPicture):
            texture = view.picture.texture
            return Image(texture, *texture.size), (rays.u0, rays.v0)
        seen = np.ascontiguousarray(view.picture[rays.slices])
        rgba = seen if seen.shape[2] == 4 else cv2.cvtColor(seen, cv2.COLOR_RGB2RGBA)
        image = self._ray_image(f"target {side}", 4, "f1")
        image.texture.write(np.ascontiguousarray(rgba), viewport=(0, 0, *image.size))
        return image, (0, 0)

    def _through(self, matrices: F64, side: int) -> dict[str, Any]:
        uniforms: dict[str, Any] = {"targets_origin": self._targets[side][1]}
        for n, (matrix, box) in enumerate(zip(matrices, self._geometry.boxes, strict=True)):
            uniforms |= {f"from_rays{n}": _mat3(matrix), f"size{n}": (box.width_px, box.height_px)}
        return uniforms

    @property
    def _components(self) -> int:
        return 1 if self._channels == 1 else 4

    @property
    def _longest(self) -> int:
        rays = self._geometry.rays
        return max(self._stack.width_px, self._stack.height_px, rays.width_px, rays.height_px)

    def _panel(self, role: str, n: int) -> Image:
        """Return the image for a panel's box."""
        box = self._geometry.boxes[n]
        return Image(self._state.panel_texture(role, n, self._components), box.width_px, box.height_px)

    def _rays(self, name: str, turns: int = 1) -> Image:
        """Return the image that holds one quantity for all rays in a set."""
        image = self._ray_image(name, self._components, "nu2")
        return Image(image.texture, image.width_px, image.height_px // turns)

    def _taper(self, name: str) -> Image:
        return Image(self._state.texture(name, (self._longest, 1), 1, dtype="f4"), self._longest, 1)

    def _ray_image(self, name: str, components: int, dtype: str) -> Image:
        """Return an image with one pixel per ray."""
        size = self._geometry.rays.width_px, self._geometry.rays.height_px
        return Image(self._state.texture_of(name, size, components, dtype=dtype), *size)


def check_size(context: moderngl.Context, stack: PanelStack) -> None:
    """Raise InputError if the panels are wider or taller than the OpenGL driver allows."""
    most = int(context.info["GL_MAX_TEXTURE_SIZE"])
    most_wide, most_high = (min(most, int(value)) for value in context.info["GL_MAX_VIEWPORT_DIMS"])
    for name, value, limit in (("width_px", stack.width_px, most_wide), ("height_px", stack.height_px, most_high)):
        if value > limit:
            raise InputError(
                "stack", name, f'is {value}, but this OpenGL driver allows at most {limit}; set model.backend = "cpu"'
            )


def _summed(
    fields: Sequence[tuple[Image, Image]], back: F64, rays: tuple[int, int], *, grey: bool
) -> tuple[dict[str, Image], dict[str, Any], Counts]:
    inputs: dict[str, Image] = {}
    uniforms: dict[str, Any] = {"rays": rays, "grey": grey}
    for number, ((first, second), matrix) in enumerate(zip(fields, back, strict=True)):
        inputs |= {f"first{number}": first, f"second{number}": second}
        uniforms[f"rays_from{number}"] = _mat3(matrix)
    return inputs, uniforms, (("SETS", len(fields)),)


def _mat3(matrix: F64) -> tuple[float, ...]:
    """Return a matrix's values in column-major order, as OpenGL expects."""
    return tuple(matrix.T.ravel().tolist())
