"""Compile fragment shaders, and run them with images as inputs and outputs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from typing import Any

import moderngl

from runtime.errors import ContextLost, PhasestackError
from runtime.kernels import EDGE_CLAMP_PX, FULL
from runtime.support.gl import set_uniforms

INCLUDE = re.compile(r'^#include "([a-z_]+\.glsl)"$', re.MULTILINE)
REPEATED = re.compile(r"^#for ([A-Z]+)\n(.*?)^#end\n", re.MULTILINE | re.DOTALL)
SHADERS = "runtime.model.gl"
CONSTANTS = f"FULL {FULL:.1f}", f"EDGE_CLAMP_PX {EDGE_CLAMP_PX:.1f}"


@dataclass(frozen=True, slots=True)
class Image:
    """Part of a texture in use. It starts at the texture's first row and column."""

    texture: Any  # moderngl.Texture
    width_px: int
    height_px: int

    @property
    def size(self) -> tuple[int, int]:
        return self.width_px, self.height_px


def source(name: str, counts: Sequence[tuple[str, int]] = ()) -> str:
    """Return a shader's source code with its included files inserted. Lines between `#for NAME` and
    `#end` are repeated as often as `counts` has it, with `@` replaced by 0, 1 and so on, because a shader cannot choose
    an image by a number.
    """

    def read(file: str) -> str:
        return (resources.files(SHADERS) / "shaders" / file).read_text(encoding="ascii")

    def repeated(found: re.Match[str]) -> str:
        return "".join(found[2].replace("@", str(n)) for n in range(dict(counts)[found[1]]))

    text = REPEATED.sub(repeated, INCLUDE.sub(lambda found: read(found[1]), read(name)))
    first, _, rest = text.partition("\n")
    return "\n".join((first, *(f"#define {one}" for one in CONSTANTS), rest))


Counts = tuple[tuple[str, int], ...]


class Passes:
    """Shader programs for one OpenGL context. `draw` runs them, compiling each one on first use."""

    def __init__(self, context: moderngl.Context) -> None:
        self.context = context
        self._vertex = source("whole.vert.glsl")
        self._programs: dict[tuple[str, Counts], tuple[Any, Any, dict[str, Any]]] = {}
        self._targets: dict[tuple[int, ...], Any] = {}

    @contextmanager
    def drawing(self) -> Iterator[None]:
        """Prepare the context for drawing. Raises ContextLost if OpenGL reports an error in the meantime."""
        try:
            self.context.enable_only(moderngl.NOTHING)
            yield
            fault = self.context.error
        except PhasestackError:
            raise
        except Exception as error:  # moderngl raises various exceptions for a lost context
            raise ContextLost(f"OpenGL: {error}") from error
        if fault != "GL_NO_ERROR":
            raise ContextLost(f"OpenGL: {fault}")

    def draw(
        self,
        name: str,
        outputs: Sequence[Image],
        inputs: Mapping[str, Image],
        uniforms: Mapping[str, Any],
        *,
        counts: Counts = (),
        at: tuple[int, int, int, int] | None = None,
    ) -> None:
        """Run a fragment shader for the output pixels of an area (first column and row, width, height), by
        default all. Images and other uniforms are keyed by their names in the shader; unused ones are ignored.
        """
        program, array, held = self._program(name, counts)
        for unit, image in enumerate(inputs.values()):
            image.texture.use(unit)
        origin = (0.0, 0.0) if at is None else (float(at[0]), float(at[1]))
        values = {**{key: unit for unit, key in enumerate(inputs)}, **uniforms, "origin": origin}
        changed = {key: value for key, value in values.items() if held.get(key) != value}
        set_uniforms(program, changed)
        held |= changed
        target = self.target(outputs)
        target.viewport = at or (0, 0, *outputs[0].size)
        target.use()
        array.render(moderngl.TRIANGLES, vertices=3)

    def target(self, outputs: Sequence[Image]) -> Any:
        """Return the framebuffer that draws into all the outputs' textures."""
        key = tuple(output.texture.glo for output in outputs)
        if key not in self._targets:
            self._targets[key] = self.context.framebuffer([output.texture for output in outputs])
        return self._targets[key]

    def forget(self, texture: Any) -> None:
        """Release a texture and its framebuffers."""
        # moderngl will bind the framebuffer in use again later, so it must still exist.
        self.context.detect_framebuffer(0).use()
        for key in [key for key in self._targets if texture.glo in key]:
            self._targets.pop(key).release()
        texture.release()

    def release(self) -> None:
        """Release all programs and framebuffers. Textures are released by their owners."""
        self.context.detect_framebuffer(0).use()
        for target in self._targets.values():
            target.release()
        for program, array, _ in self._programs.values():
            array.release()
            program.release()
        self._targets, self._programs = {}, {}

    def _program(self, name: str, counts: Counts) -> tuple[Any, Any, dict[str, Any]]:
        if (name, counts) not in self._programs:
            fragment = source(f"{name}.frag.glsl", counts)
            program = self.context.program(vertex_shader=self._vertex, fragment_shader=fragment)
            self._programs[name, counts] = program, self.context.vertex_array(program, []), {}
        return self._programs[name, counts]
