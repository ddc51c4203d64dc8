"""Use the presentation shader to align a layer, mix it with the flat picture and draw it to a panel."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import moderngl
import numpy as np

from runtime.config import PanelSettings
from runtime.optics.alignment import is_identity, scale_and_shift
from runtime.optics.malus import rest_code
from runtime.optics.relief import displacement
from runtime.panels import lut
from runtime.panels.geometry import layer_from_screen, permutes_pixels
from runtime.records import F32, U8, PanelFrame

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

# The reference for `shown` is runtime.optics.alignment.shown_layers. Aligned layers are sampled with full-precision
# weights, because hardware filters round them to steps of 1/256. Outside the layers, the rest value is sampled. If a
# homography moves the layers, they are sampled once for registration and alignment together, using cubic weights,
# because bilinear weights would lose another 0.15 dB. Each case has its own program, because a software rasteriser
# executes both branches of every `if`: a single program for all cases would take several times as long as the slowest
# of these.
FRAGMENT = """
uniform sampler2D solved;        // this panel's layer of the solution
uniform sampler2D flat_picture;
uniform sampler2D curve;
uniform vec2 size_px;            // size of the panel
uniform vec2 solved_px;          // size of the solution, which may be coarser
uniform int extended;            // pixels by which a coarse solution is extended, so that its edge does not fade
uniform vec4 solved_from_shown;  // scale u, v, shift u, v in pixels of the solution
uniform sampler2D relief;        // the content's relief on the middle panel
uniform vec4 middle_from_shown;  // scale u, v, shift u, v in pixels of the panels
uniform vec3 drift;              // drift right and down, and growth
uniform float weight_px;
uniform float flatness;
uniform float even;
in vec3 layer_px;
out vec4 colour;
#ifdef CURVED
float grey(float phase, int channel) {
    return texture(curve, vec2((phase * 255.0 + 0.5) / 256.0, (float(channel) + 0.5) / 3.0)).r;
}
#else
float grey(float phase, int channel) { return phase; }
#endif
vec3 solved_texel(ivec2 at) {
    ivec2 size = ivec2(solved_px);
    bool inside = all(greaterThanEqual(at, ivec2(-extended))) && all(lessThan(at, size + extended));
    return inside ? texelFetch(solved, clamp(at, ivec2(0), size - 1), 0).rgb : vec3(even);
}
vec2 solved_at(vec2 px) {  // pixels of the solution
    vec2 at = px * solved_from_shown.xy + solved_from_shown.zw;
#ifdef DISPLACED
    vec2 middle = px * middle_from_shown.xy + middle_from_shown.zw;
    float b = texture(relief, middle / size_px).r;
    at += weight_px * b * (drift.xy + drift.z * middle) * solved_px / size_px;
#endif
    return at;
}
vec3 aligned_at(vec2 px) {
    vec2 place = clamp(solved_at(px) - 0.5, vec2(-3.0), solved_px + 2.0);
    vec2 low = floor(place), weight = place - low;
    ivec2 at = ivec2(low);
    return mix(mix(solved_texel(at), solved_texel(at + ivec2(1, 0)), weight.x),
               mix(solved_texel(at + ivec2(0, 1)), solved_texel(at + ivec2(1, 1)), weight.x), weight.y);
}
vec4 cubic(float t) {  // weights of four neighbours, as in OpenCV's INTER_CUBIC (a = -3/4)
    vec4 d = vec4(1.0 + t, t, 1.0 - t, 2.0 - t);
    vec4 near = (1.25 * d - 2.25) * d * d + 1.0;
    vec4 far = ((-0.75 * d + 3.75) * d - 6.0) * d + 3.0;
    return vec4(far.x, near.y, near.z, far.w);
}
vec3 registered_at(vec2 px) {
#ifdef ALIGNED
    vec2 place = solved_at(px) - 0.5;
#else
    vec2 place = px - 0.5;
#endif
    place = clamp(place, vec2(-3.0), solved_px + 2.0);
    vec2 low = floor(place);
    vec4 across = cubic(place.x - low.x), down = cubic(place.y - low.y);
    vec3 total = vec3(0.0);
    for (int j = 0; j < 4; j++) {
        for (int i = 0; i < 4; i++) {
            ivec2 at = ivec2(low) + ivec2(i - 1, j - 1);
#ifdef ALIGNED
            vec3 texel = solved_texel(at);
#else
            vec3 texel = texelFetch(solved, clamp(at, ivec2(0), ivec2(solved_px) - 1), 0).rgb;
#endif
            total += across[i] * down[j] * texel;
        }
    }
    return clamp(total, 0.0, 1.0);
}
vec3 as_it_is(sampler2D picture, vec2 px) {
#ifdef EXACT
    return texelFetch(picture, ivec2(floor(px)), 0).rgb;
#else
    return texture(picture, px / size_px).rgb;
#endif
}
vec3 shown(vec2 px) {
#if !defined(SOLVED)
    return as_it_is(flat_picture, px);
#elif !defined(EXACT)
    vec3 phase = registered_at(px);
#elif defined(ALIGNED)
    vec3 phase = aligned_at(px);
#else
    vec3 phase = as_it_is(solved, px);
#endif
#ifdef SOLVED
#ifdef MIXED
    phase = mix(phase, as_it_is(flat_picture, px), flatness);
#endif
    return phase;
#endif
}
void main() {
    vec2 px = layer_px.xy / layer_px.z;
    vec3 phase = vec3(0.0);
    if (layer_px.z > 0.0 && all(greaterThanEqual(px, vec2(0.0))) && all(lessThan(px, size_px))) phase = shown(px);
    colour = vec4(grey(phase.r, 0), grey(phase.g, 1), grey(phase.b, 2), 1.0);
}
"""


Case = tuple[str, ...]  # macros to define in the fragment shader
CASES: tuple[Case, ...] = (
    (),
    *(("SOLVED", *how, *mixed) for how in ((), ("ALIGNED",), ("ALIGNED", "DISPLACED")) for mixed in ((), ("MIXED",))),
)


class FrameTextures:
    """Uploads the latest frame's layers to textures whenever their version changes."""

    def __init__(self, context: moderngl.Context, size_px: tuple[int, int], *, count: int) -> None:
        """Create an empty set of textures.

        Args:
            context: GL context that owns the textures.
            size_px: A panel's width and height.
            count: Number of panels.
        """
        self._context = context
        self.size_px, self.count = size_px, count
        self._textures: dict[tuple[str, tuple[int, int]], tuple[moderngl.Texture, ...]] = {}  # keyed by kind and size
        self._solved: tuple[moderngl.Texture, ...] = ()
        self._flat: tuple[moderngl.Texture, ...] = ()
        self._reliefs: dict[tuple[int, int], moderngl.Texture] = {}  # keyed by size
        self._relief: moderngl.Texture | None = None  # the uploaded solution's relief
        self._solved_version: int | None = None
        self._flat_version: int | None = None

    @property
    def solved_px(self) -> tuple[int, int]:
        """The uploaded solution's width and height, or a panel's if no solution has been uploaded."""
        return self._solved[0].size if self._solved else self.size_px

    def lacks(self, frame: PanelFrame) -> tuple[bool, bool]:
        """Check which of a frame's pictures must be uploaded before the frame can be drawn.

        Returns:
            Two flags, one for the solution and one for the flat picture. Each is True if that picture is visible in the
            frame but has not been uploaded.
        """
        return (
            shows_solved(frame) and frame.solved_version != self._solved_version,
            shows_flat(frame) and frame.flat_version != self._flat_version,
        )

    def upload(self, frame: PanelFrame) -> None:
        """Upload whichever pictures are visible in a frame and have not been uploaded yet."""
        lacks_solved, lacks_flat = self.lacks(frame)
        if lacks_solved and frame.solved is not None:
            self._solved_version = None  # stays None if the upload fails
            self._solved = self._written("solved", frame.solved)
            self._relief = None if frame.relief is None else self._relief_of(frame.relief)
            self._solved_version = frame.solved_version
        if lacks_flat and frame.flat is not None:
            self._flat_version = None
            self._flat = self._written("flat", frame.flat)
            self._flat_version = frame.flat_version

    def use(self, index: int) -> None:
        """Bind one panel's textures to the texture units read by `Painter`, in the current context."""
        for unit, uploaded in enumerate((self._solved, self._flat)):
            if uploaded:
                uploaded[index].use(unit)
        if self._relief is not None:
            self._relief.use(3)

    def release(self) -> None:
        """Release the GL objects."""
        for textures in (*self._textures.values(), self._reliefs.values()):
            for texture in textures:
                texture.release()
        self._textures, self._solved, self._flat = {}, (), ()
        self._reliefs, self._relief = {}, None

    def _relief_of(self, relief: F32) -> moderngl.Texture:
        key = relief.shape[1], relief.shape[0]
        if key not in self._reliefs:
            self._reliefs[key] = self._context.texture(key, 1, dtype="f4")
            self._reliefs[key].filter = (moderngl.LINEAR, moderngl.LINEAR)
            self._reliefs[key].repeat_x = self._reliefs[key].repeat_y = False
        self._reliefs[key].write(relief)
        return self._reliefs[key]

    def _written(self, kind: str, layers: U8) -> tuple[moderngl.Texture, ...]:
        """Write layers to textures, one for each panel, and return the textures.

        The first time that layers of a given size are written, the textures are created.
        """
        key = kind, (layers.shape[2], layers.shape[1])
        if key not in self._textures:
            self._textures[key] = tuple(self._context.texture(key[1], 4) for _ in range(self.count))
            for texture in self._textures[key]:
                texture.filter = (moderngl.LINEAR, moderngl.LINEAR)
                texture.repeat_x = texture.repeat_y = False
        for texture, layer in zip(self._textures[key], layers, strict=True):
            texture.write(np.ascontiguousarray(layer))
        return self._textures[key]


def shows_solved(frame: PanelFrame) -> bool:
    """Return True if the solution is visible in a frame."""
    return frame.solved is not None and frame.flatness < 1.0


def shows_flat(frame: PanelFrame) -> bool:
    """Return True if the flat picture is visible in a frame."""
    return frame.solved is None or frame.flatness > 0.0


class Painter:
    """Draws frames to one panel using the presentation shader.

    Each window needs its own painter, because vertex arrays cannot be shared between GL contexts.
    """

    def __init__(
        self,
        context: moderngl.Context,
        settings: PanelSettings,
        *,
        screen_px: tuple[int, int],
        layer_px: tuple[int, int],
    ) -> None:
        """Compile the shader for one panel.

        Args:
            context: The GL context of the panel's window.
            settings: The panel's settings.
            screen_px: The monitor's width and height.
            layer_px: Width and height of each of the stack's panels.

        Raises:
            InputError: The grey curve's file cannot be read or is invalid.
            ValueError: The homography is singular or not finite.
        """
        self.screen_px = screen_px
        matrix = layer_from_screen(
            screen_width_px=screen_px[0],
            screen_height_px=screen_px[1],
            layer_width_px=layer_px[0],
            layer_height_px=layer_px[1],
            rotation_deg=settings.rotation_deg,
            mirror=settings.mirror,
            homography=settings.homography,
        )
        # A homography's sign is arbitrary, but the shader needs the third coordinate to be positive at the panel's
        # centre.
        matrix = matrix / (matrix[2] @ np.array([screen_px[0] / 2, screen_px[1] / 2, 1.0]))
        mounting = ["EXACT"] * permutes_pixels(matrix) + ["CURVED"] * bool(settings.lut or settings.gamma != 1)
        table = np.ascontiguousarray(lut.curve(lut=settings.lut, gamma=settings.gamma).T)
        self._curve = context.texture((lut.ENTRIES, 3), 1, table.tobytes(), dtype="f4")
        self._curve.filter = (moderngl.LINEAR, moderngl.LINEAR)
        self._curve.repeat_x = self._curve.repeat_y = False
        fixed = {
            "solved": 0, "flat_picture": 1, "curve": 2, "relief": 3,
            "screen_px": tuple(map(float, screen_px)), "layer_from_screen": tuple(matrix.T.ravel()),
        }  # fmt: skip
        self._cases = {case: _compiled(context, (*mounting, *case), fixed) for case in CASES}

    def draw(self, textures: FrameTextures, frame: PanelFrame, index: int) -> None:
        """Draw an uploaded frame's picture for one panel to the bound framebuffer.

        Args:
            textures: Textures that contain the frame's pictures.
            frame: The frame to draw.
            index: Panel number, counted from the rear.
        """
        matrix = frame.solved_from_shown[index] if frame.solved_from_shown else np.eye(3)
        (width, height), (solved_width, solved_height) = textures.size_px, textures.solved_px
        coarse = (width, height) != (solved_width, solved_height)
        by_u, by_v = solved_width / width, solved_height / height
        su, sv, tu, tv = scale_and_shift(matrix)
        values: dict[str, Any] = {
            "even": rest_code(textures.count) / 255,
            "size_px": (float(width), float(height)),
            "solved_px": (float(solved_width), float(solved_height)),
            "extended": int(coarse),
            "solved_from_shown": (su * by_u, sv * by_v, tu * by_u, tv * by_v),
            "flatness": float(frame.flatness),
        }
        moved = displacement(frame.relief, frame.parallax, index)
        if moved is not None:
            values |= {
                "middle_from_shown": scale_and_shift(moved.middle_from_shown),
                "drift": (*moved.drift_px, moved.growth),
                "weight_px": moved.weight,
            }
        case: Case = ()
        if shows_solved(frame):
            aligned = coarse or moved is not None or not is_identity(matrix)
            case = (
                "SOLVED",
                *["ALIGNED"] * aligned,
                *["DISPLACED"] * (moved is not None),
                *["MIXED"] * shows_flat(frame),
            )
        program, array = self._cases[case]
        _set(program, values)
        textures.use(index)
        self._curve.use(2)
        array.render(moderngl.TRIANGLES, vertices=3)

    def release(self) -> None:
        """Release the GL objects."""
        for program, array in self._cases.values():
            array.release()
            program.release()
        self._curve.release()


def _compiled(
    context: moderngl.Context, names: Sequence[str], fixed: Mapping[str, Any]
) -> tuple[moderngl.Program, moderngl.VertexArray]:
    """Compile the shader with all macros in `names` defined, and set the uniforms in `fixed`."""
    head = "#version 330 core\n" + "".join(f"#define {name}\n" for name in names)
    program = context.program(vertex_shader=VERTEX, fragment_shader=head + FRAGMENT)
    _set(program, fixed)
    return program, context.vertex_array(program, [])


def _set(program: moderngl.Program, values: Mapping[str, Any]) -> None:
    """Set uniforms, skipping any that the compiler has removed."""
    for name, value in values.items():
        uniform: Any = program.get(name, None)
        if uniform is not None:
            uniform.value = value
