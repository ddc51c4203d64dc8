"""Simulated camera in front of the stack, and the pairs that it measures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib.pairs import COLUMNS
from calib.viewpoints import grid
from runtime.eyes.calibration import demo_stack_from_sensor

KNOWN_M = np.array([viewpoint.midpoint_m for viewpoint in grid()])  # (27, 3) the grid's viewpoints in `stack`


def measured(
    points: np.ndarray = KNOWN_M, *, sigma_m: float = 0.0, scale: float = 1.0, seed: int = 0
) -> NDArray[np.float64]:
    """Points measured by the demo's camera, with noise and a scale error."""
    sensor_from_stack = np.linalg.inv(demo_stack_from_sensor())
    exact = points @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3]
    return exact / scale + sigma_m * np.random.default_rng(seed).normal(size=exact.shape)


def write_pairs(folder: Path, sensor_m: np.ndarray, stack_m: np.ndarray = KNOWN_M) -> Path:
    """A CSV of pairs."""
    path = folder / "pairs.csv"
    table = np.hstack([sensor_m, stack_m])
    np.savetxt(path, table, delimiter=",", header=",".join(COLUMNS), comments="", fmt="%.17g")
    return path
