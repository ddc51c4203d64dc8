"""The presentation shader: one layer of the uploaded frame on to one panel's framebuffer."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np

from runtime.config import PanelSettings
from runtime.panels import lut
from runtime.panels.geometry import layer_from_screen, permutes_pixels
from runtime.records import F32, F64

VERTEX = """#version 330 core
// One triangle that covers the framebuffer; pixel: the monitor's pixels, top left origin, v down.
uniform vec2 screen_px;
uniform mat3 layer_from_screen;
out vec3 layer_px;
void main() {
    vec2 corner = vec2((gl_VertexID << 1) & 2, gl_VertexID & 2);
    gl_Position = vec4(corner * 2.0 - 1.0, 0.0, 1.0);
    vec2 pixel = vec2(corner.x, 1.0 - corner.y) * screen_px;
    layer_px = layer_from_screen * vec3(pixel, 1.0);
}
"""

FRAGMENT = """#version 330 core
uniform sampler2DArray layers;
uniform sampler2D curve;
uniform int layer;
uniform vec2 size_px;
uniform bool exact;
in vec3 layer_px;
out vec4 colour;
float grey(float phase, int channel) {
    return texture(curve, vec2((phase * 255.0 + 0.5) / 256.0, (float(channel) + 0.5) / 3.0)).r;
}
void main() {
    vec2 px = layer_px.xy / layer_px.z;
    vec3 phase = vec3(0.0);
    if (layer_px.z > 0.0 && all(greaterThanEqual(px, vec2(0.0))) && all(lessThan(px, size_px))) {
        phase = exact ? texelFetch(layers, ivec3(floor(px), layer), 0).rgb
                      : texture(layers, vec3(px / size_px, layer)).rgb;
    }
    colour = vec4(grey(phase.r, 0), grey(phase.g, 1), grey(phase.b, 2), 1.0);
}
"""


@dataclass(frozen=True, slots=True)
class Mounting:
    """How one panel turns a layer into its monitor's picture."""

    layer_from_screen: F64  # 3x3, positive third coordinate inside the panel
    curve: F32  # (256, 3) grey of each 8-bit phase, per channel
    screen_width_px: int
    screen_height_px: int

    @classmethod
    def of(
        cls,
        settings: PanelSettings,
        *,
        screen_width_px: int,
        screen_height_px: int,
        layer_width_px: int,
        layer_height_px: int,
    ) -> Mounting:
        """From a panel's settings. Raises InputError (curve), ValueError (homography)."""
        matrix = layer_from_screen(
            screen_width_px=screen_width_px,
            screen_height_px=screen_height_px,
            layer_width_px=layer_width_px,
            layer_height_px=layer_height_px,
            rotation_deg=settings.rotation_deg,
            mirror=settings.mirror,
            homography=settings.homography,
        )
        # A homography's sign means nothing; the shader wants the panel's middle before the horizon.
        middle = matrix[2] @ np.array([screen_width_px / 2, screen_height_px / 2, 1.0])
        return cls(
            matrix / middle,
            lut.curve(lut=settings.lut, gamma=settings.gamma),
            screen_width_px,
            screen_height_px,
        )


class Painter:
    """The presentation shader in one context; vertex arrays and framebuffers are not shared between contexts."""

    def __init__(self, context: moderngl.Context, mounting: Mounting) -> None:
        self._program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        self._array = context.vertex_array(self._program, [])
        table = np.ascontiguousarray(mounting.curve.T)
        self._curve = context.texture((lut.ENTRIES, 3), 1, table.tobytes(), dtype="f4")
        self._curve.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._curve.repeat_x = self._curve.repeat_y = False
        self._program["layers"] = 0
        self._program["curve"] = 1
        self._program["screen_px"] = (float(mounting.screen_width_px), float(mounting.screen_height_px))
        self._program["layer_from_screen"] = tuple(mounting.layer_from_screen.T.ravel())
        self._program["exact"] = permutes_pixels(mounting.layer_from_screen)

    def draw(self, layers: moderngl.TextureArray, index: int) -> None:
        """Layer `index` of the frame over the whole of the framebuffer in use."""
        self._program["layer"] = index
        self._program["size_px"] = (float(layers.size[0]), float(layers.size[1]))
        layers.use(0)
        self._curve.use(1)
        self._array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Give the GL objects back."""
        for thing in (self._array, self._program, self._curve):
            thing.release()
