"""A program that draws a turning cube for the display with moderngl.

It requires `pip install moderngl websockets numpy`. Start `phasestack try --scene program` (or `run`), and then
`python examples/program.py ADDRESS`. The address is shown as `program` by `phasestack status` and on the page opened by
`try`.
"""

from __future__ import annotations

import json
import struct
import sys

import moderngl
import numpy as np
from websockets.sync.client import connect

VERTEX = """#version 330
uniform mat4 clip_from_scene; uniform float turn; in vec3 at; out vec3 colour;
void main() {
    colour = at * 8.0 + 0.5;
    gl_Position = clip_from_scene * vec4(mat2(cos(turn), sin(turn), -sin(turn), cos(turn)) * at.xy, at.z, 1.0);
}"""
FRAGMENT = "#version 330\nin vec3 colour; out vec4 seen; void main() { seen = vec4(colour, 1.0); }"


def cube() -> np.ndarray:
    """Return the corners of the cube's 12 triangles, as a (36, 3) array.

    They are in metres, with x out of the screen, y to the viewer's right and z up.
    """
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, -1], [1, 1], [-1, 1]])
    faces = [np.insert(square, axis, side, axis=1) for axis in range(3) for side in (-1, 1)]
    return 0.06 * np.concatenate(faces).astype("f4")


def main() -> None:
    context = moderngl.create_context(standalone=True, backend="egl")
    program = context.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
    array = context.vertex_array(program, context.buffer(cube().tobytes()), "at")
    target = context.simple_framebuffer((16, 16))
    context.enable(moderngl.DEPTH_TEST)
    with connect(sys.argv[1], max_size=None, compression=None) as socket:
        socket.send(json.dumps({"name": "a cube", "rows": "bottom-up", "depth": "float32"}))
        for message in socket:
            asked = json.loads(message)
            if target.size != (asked["width"], asked["height"]):
                target = context.simple_framebuffer((asked["width"], asked["height"]))
            target.use()
            for eye in asked["eyes"]:
                view, projection = (np.reshape(eye[name], (4, 4)) for name in ("view", "projection"))  # transposed
                program["clip_from_scene"].write((view @ projection).astype("f4").tobytes())
                program["turn"] = asked["time_s"] % 6.2832
                target.clear(0.9, 0.95, 1.0, 1.0)
                array.render()
                side = 0 if eye["eye"] == "left" else 1
                # With the depth, the cube also follows the eyes between two pictures.
                depth = target.read(components=1, attachment=-1, dtype="f4")
                socket.send(struct.pack("<II", asked["frame"], side) + target.read(components=4) + depth)


if __name__ == "__main__":
    main()
