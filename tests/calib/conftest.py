"""A camera before the stack, and pairs that it would measure."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from calib.viewpoints import grid
from runtime.eyes.demo_geometry import demo_stack_from_sensor
from runtime.optics.stack import PanelStack


@pytest.fixture
def known_m() -> np.ndarray:
    """(27, 3) the grid's viewpoints in `stack`."""
    return np.array([viewpoint.midpoint_m for viewpoint in grid()])


@pytest.fixture
def measured(known_m: np.ndarray) -> Callable[..., np.ndarray]:
    """What the demo's camera tells of points, with noise and with a metre of its own."""

    def sensor(
        points: np.ndarray | None = None, *, sigma_m: float = 0.0, scale: float = 1.0, seed: int = 0
    ) -> NDArray[np.float64]:
        sensor_from_stack = np.linalg.inv(demo_stack_from_sensor())
        chosen = known_m if points is None else points
        exact = chosen @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3]
        return exact / scale + sigma_m * np.random.default_rng(seed).normal(size=exact.shape)

    return sensor


@pytest.fixture
def write_pairs(tmp_path: Path) -> Callable[..., Path]:
    """A CSV of pairs."""

    def write(sensor_m: np.ndarray, stack_m: np.ndarray, name: str = "pairs.csv") -> Path:
        path = tmp_path / name
        header = "sensor_x,sensor_y,sensor_z,stack_x,stack_y,stack_z"
        np.savetxt(path, np.hstack([sensor_m, stack_m]), delimiter=",", header=header, comments="", fmt="%.17g")
        return path

    return write


@pytest.fixture
def small_stack() -> PanelStack:
    """The prototype's panels at a quarter of its resolution: quick, and in proportion."""
    return PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
