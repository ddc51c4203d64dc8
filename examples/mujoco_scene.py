"""A MuJoCo simulation, shown on the display.

It requires `pip install phasestack websockets mujoco`. Start `phasestack try --scene program` (or `run`), and then
`MUJOCO_GL=egl python examples/mujoco_scene.py [MODEL.xml]`.
"""

from __future__ import annotations

import sys
import time

import mujoco
import numpy as np

from phasestack.drawing import DrawingClient
from phasestack.fitting import AppCamera, eye_camera, stack_from_scene

MODEL = """<mujoco><worldbody><light pos="0 -1 3" dir="0 0.3 -1"/><geom type="plane" size="2 2 .1" rgba=".7 .8 .9 1"/>
<body pos="0 0 1"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".05" rgba=".8 .2 .3 1"/>
<body pos=".4 0 0"><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .4 0 0" size=".04" rgba=".2 .4 .8 1"/></body>
</body></worldbody></mujoco>"""


def main() -> None:
    model = mujoco.MjModel.from_xml_path(sys.argv[1]) if len(sys.argv) > 1 else mujoco.MjModel.from_xml_string(MODEL)
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=10000)
    option, camera = mujoco.MjvOption(), mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    client, size, context = DrawingClient("", name="MuJoCo"), (0, 0), None
    while True:
        request = client.newest()
        if request is None:
            time.sleep(0.002)
            continue
        if size != (request.width_px, request.height_px):
            size = request.width_px, request.height_px
            model.vis.global_.offwidth, model.vis.global_.offheight = size
            window = mujoco.GLContext(*size)
            window.make_current()
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        if not 0 <= request.time_s - data.time < 1:
            data.time = request.time_s
        while data.time < request.time_s:
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mjv_updateScene(model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, scene)
        shown = scene.camera[0]
        # The camera's look-at point is at the display's centre, and the model fits into the display.
        focus, far = shown.pos + shown.forward * camera.distance, float(model.stat.extent)
        height = camera.distance * (shown.frustum_top - shown.frustum_bottom) / shown.frustum_near
        app = AppCamera(shown.pos.copy(), focus, shown.up.copy(), float(height), size[0] / size[1])
        bounds = np.array([model.stat.center - far, model.stat.center + far])
        eyes_m = np.array([eye.eye_m for eye in request.eyes])
        placed = stack_from_scene(app, bounds, eyes_m, request.display_m, 1.0)
        for eye in request.eyes:
            view, box = eye_camera(eye, placed), mujoco.MjrRect(0, 0, *size)
            lens = view.projection / -view.projection[3, 2]
            for one in scene.camera:
                one.pos, one.forward, one.up = view.position, view.sight, view.up
                one.frustum_near, one.frustum_far = view.near, view.far
                one.frustum_center = view.near * lens[0, 2] / lens[0, 0]
                one.frustum_top, one.frustum_bottom = (view.near * (lens[1, 2] + end) / lens[1, 1] for end in (1, -1))
            mujoco.mjr_render(box, scene, context)
            pixels, depth = np.zeros((*size[::-1], 3), np.uint8), np.zeros(size[::-1], np.float32)
            mujoco.mjr_readPixels(pixels, depth, box, context)
            client.answer(request, eye, np.insert(pixels, 3, 255, axis=2), depth)


if __name__ == "__main__":
    main()
