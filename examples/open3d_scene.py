"""An Open3D scene, drawn off screen and shown on the display.

It requires `pip install phasestack websockets open3d` and a Vulkan driver. Start `phasestack try --scene program` (or
`run`), and then `python examples/open3d_scene.py`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import open3d

from phasestack.drawing import DrawingClient
from phasestack.fitting import AppCamera, eye_camera, stack_from_scene

rendering = open3d.visualization.rendering
APP = AppCamera(np.array([0, 0, 8.0]), np.zeros(3), np.array([0, 1.0, 0]), height=4.0, aspect=16 / 9)
BOUNDS = np.array([[-1.5, -1.5, -1.5], [1.5, 1.5, 1.5]])


def opened(width_px: int, height_px: int) -> Any:
    """Return a renderer of the scene for pictures of this size."""
    renderer, look = rendering.OffscreenRenderer(width_px, height_px), rendering.MaterialRecord()
    look.shader, look.base_color = "defaultLit", (0.8, 0.2, 0.3, 1.0)
    torus = open3d.geometry.TriangleMesh.create_torus(1.0, 0.4)
    torus.compute_vertex_normals()
    renderer.scene.add_geometry("torus", torus, look)
    renderer.scene.set_background([0.87, 0.91, 0.96, 1.0])
    return renderer


def main() -> None:
    renderer: Any = None
    client, size = DrawingClient("", name="Open3D"), (0, 0)
    while True:
        request = client.newest()
        if request is None:
            time.sleep(0.002)
            continue
        if size != (request.width_px, request.height_px):
            size = request.width_px, request.height_px
            renderer = opened(*size)
        eyes_m = np.array([eye.eye_m for eye in request.eyes])
        placed = stack_from_scene(APP, BOUNDS, eyes_m, request.display_m, 1.0)
        for eye in request.eyes:
            view, camera = eye_camera(eye, placed), renderer.scene.camera
            lens = view.projection / -view.projection[3, 2]
            sides = [view.near * (lens[k, 2] + end) / lens[k, k] for k in (0, 1) for end in (-1, 1)]
            camera.set_projection(rendering.Camera.Projection.Perspective, *sides, view.near, view.far)
            camera.look_at(view.position + view.sight, view.position, view.up)
            pixels = np.insert(np.asarray(renderer.render_to_image()), 3, 255, axis=2)
            distances = np.asarray(renderer.render_to_depth_image(z_in_view_space=True))
            depth = (1 / view.near - 1 / distances) / (1 / view.near - 1 / view.far)
            client.answer(request, eye, pixels[::-1], np.minimum(depth, 1)[::-1].astype(np.float32))


if __name__ == "__main__":
    main()
