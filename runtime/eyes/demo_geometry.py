"""Where the sensor of the built-in recording stands: the recording and the demo's calibration agree on this."""

from __future__ import annotations

import numpy as np

from runtime.records import F64

SENSOR_POSITION_M = (0.05, 0.02, 0.22)  # frame `stack`: above the panels' upper edge, a little in front of the centre
SENSOR_TILT_DOWN_RAD = float(np.deg2rad(10.0))


def demo_stack_from_sensor() -> F64:
    """4x4 rigid transform (scale 1) of the demo's sensor, which looks at the viewer along +x, tilted down.

    Columns are the sensor's axes in `stack`: image right is the viewer's left (-y), image down, and away.
    """
    c, s = np.cos(SENSOR_TILT_DOWN_RAD), np.sin(SENSOR_TILT_DOWN_RAD)
    pose = np.eye(4)
    pose[:3, 0] = 0.0, -1.0, 0.0
    pose[:3, 1] = -s, 0.0, -c
    pose[:3, 2] = c, 0.0, -s
    pose[:3, 3] = SENSOR_POSITION_M
    return pose


def demo_sensor_from_stack() -> F64:
    """4x4 inverse of `demo_stack_from_sensor`, in closed form."""
    pose = demo_stack_from_sensor()
    inverse = np.eye(4)
    inverse[:3, :3] = pose[:3, :3].T
    inverse[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    return inverse
