"""A pygfx scene, drawn with WebGPU and shown on the display.

It requires `pip install phasestack websockets pygfx rendercanvas` and a Vulkan driver. Start `phasestack try --scene
program` (or `run`), and then `python examples/pygfx_scene.py`.
"""

from __future__ import annotations

import time

import numpy as np
import pygfx
from rendercanvas.offscreen import RenderCanvas

from phasestack.drawing import DrawingClient
from phasestack.fitting import AppCamera, clipping_of, eye_camera, stack_from_scene

OPENGL_TO_WEBGPU = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0.5, 0.5], [0, 0, 0, 1]])  # depth from 0 to 1


class EyeView(pygfx.Camera):
    """A camera whose projection is given."""

    given = np.eye(4)

    def _update_projection_matrix(self) -> np.ndarray:
        return self.given


def main() -> None:
    knot = pygfx.Mesh(pygfx.torus_knot_geometry(1, 0.3, 128, 16), pygfx.MeshPhongMaterial(color="#c8324a"))
    scene, light = pygfx.Scene(), pygfx.DirectionalLight(intensity=3)
    light.local.position = (1, 2, 4)
    scene.add(pygfx.Background.from_color("#dfe8f5"), knot, light, pygfx.AmbientLight(intensity=0.8))
    canvas = RenderCanvas(size=(640, 360), pixel_ratio=1)
    renderer, camera = pygfx.WgpuRenderer(canvas), EyeView()
    canvas.request_draw(lambda: renderer.render(scene, camera))
    app = AppCamera(np.array([0, 0, 8.0]), np.zeros(3), np.array([0, 1.0, 0]), height=5.0, aspect=16 / 9)
    bounds = np.array([[-2.0, -2, -2], [2, 2, 2]])
    client = DrawingClient("", name="pygfx")
    while True:
        request = client.newest()
        if request is None:
            time.sleep(0.002)
            continue
        knot.local.rotation = (0, np.sin(request.time_s / 2), 0, np.cos(request.time_s / 2))
        eyes_m = np.array([eye.eye_m for eye in request.eyes])
        placed = stack_from_scene(app, bounds, eyes_m, request.display_m, 1.0)
        canvas.set_logical_size(request.width_px, request.height_px)
        for eye in request.eyes:
            view = eye_camera(eye, placed)
            camera.local.position = view.position
            camera.look_at(view.position + view.sight)
            camera.given = OPENGL_TO_WEBGPU @ view.projection
            camera.flag_update()
            # pygfx does not give its depths, so the picture moves with the display's plane.
            near_m, far_m = clipping_of(eye.projection)
            plane = (1 / near_m - 1 / eye.eye_m[0]) / (1 / near_m - 1 / far_m)
            depth = np.full((request.height_px, request.width_px), plane, np.float32)
            client.answer(request, eye, np.asarray(canvas.draw())[::-1], depth)


if __name__ == "__main__":
    main()
