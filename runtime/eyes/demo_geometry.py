"""Where the demo's camera stands: the recording is made with it, and the built-in calibration holds its digits."""

from __future__ import annotations

import math

import numpy as np

from runtime.records import F64

CAMERA_M = (0.05, 0.02, 0.22)  # optical centre in `stack`: on top of the display, a little off its middle
TILT_DOWN_DEG = 10.0


def demo_stack_from_sensor() -> F64:
    """4x4 of a camera that faces the viewer along +x of `stack`, tilted down; OpenCV axes, scale 1."""
    c, s = math.cos(math.radians(TILT_DOWN_DEG)), math.sin(math.radians(TILT_DOWN_DEG))
    x, y, z = CAMERA_M
    return np.array([[0.0, -s, c, x], [-1.0, 0.0, 0.0, y], [0.0, -c, -s, z], [0.0, 0.0, 0.0, 1.0]])
