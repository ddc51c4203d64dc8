"""The simulated camera: rays, light, distortion, against independent answers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.placed import (
    PlacedPanel,
    ideal_panel,
    misplaced,
    stack_from_pixels,
    through,
    true_from_ideal_seen,
)
from calib.simulator import Exposure, Lens, Scene, camera_from_stack, camera_rays, photograph
from runtime.config import StackGeometry
from runtime.optics.stack import PanelStack

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
LENS = Lens(1200, 900, 900.0, (610.0, 440.0), (0.08, -0.1, 0.001, -0.0005, 0.02))
PLAIN = Exposure(blur_px=0.0, gain=1.0, dark=0.0, electrons=1e12, read_noise=0.0, vignetting=0.0, grid=0.0, gamma=1.0,
                 jpeg_quality=0)  # fmt: skip
STRAIGHT = camera_from_stack(np.array([0.8, 0.0, 0.0]), towards_m=np.zeros(3))
ASIDE = camera_from_stack(np.array([0.6, 0.35, 0.15]), towards_m=np.zeros(3), roll_rad=0.2)


def uniform(*values: float) -> np.ndarray:
    layers = np.zeros((len(values), STACK.height_px, STACK.width_px), np.uint8)
    layers[:] = np.rint(255 * np.array(values))[:, None, None]
    return layers


def taken(
    layers: NDArray[np.uint8],
    panels: tuple[PlacedPanel, PlacedPanel, PlacedPanel] | None = None,
    *,
    lens: Lens = LENS,
    pose: NDArray[np.float64] = STRAIGHT,
    exposure: Exposure = PLAIN,
    seed: int = 0,
) -> NDArray[np.uint8]:
    panels = panels or tuple(ideal_panel(STACK, index) for index in range(3))
    scene = Scene(STACK, panels, layers)
    return photograph(scene, lens, pose, exposure, random=np.random.default_rng(seed), rays=camera_rays(lens))


@pytest.mark.parametrize("values", [(0, 0, 0), (1, 0, 0), (0.5, 0.5, 0), (1, 1, 0), (0.4, 0.2, 0.1), (1, 1, 1)])
def test_the_light_is_the_squared_sine_of_the_summed_phases(values: tuple[float, float, float]) -> None:
    picture = taken(uniform(*values))
    phases = np.rint(255 * np.array(values)) / 255
    assert picture[440, 610] == pytest.approx(255 * np.sin(np.pi / 2 * phases.sum()) ** 2, abs=1.0)


@pytest.mark.parametrize("pose", [STRAIGHT, ASIDE])
@pytest.mark.parametrize("index", range(3))
def test_a_spot_on_a_panel_is_seen_where_opencv_projects_it(index: int, pose: NDArray[np.float64]) -> None:
    random = np.random.default_rng(5)
    panels = misplaced(STACK, shift_m=0.002, turn_deg=1.0, gap_m=0.002, random=random)
    layers = uniform(0, 0, 0)
    layers[index, 130:142, 200:216] = 255  # its middle: u 208, v 136
    picture = taken(layers, panels, pose=pose).astype(float)
    point = stack_from_pixels(panels[index], STACK) @ [208.0, 136.0, 1.0]
    expected = cv2.projectPoints(
        point, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], LENS.matrix, np.array(LENS.distortion)
    )[0].ravel()
    v, u = np.indices(picture.shape)
    found = np.array([(picture * u).sum(), (picture * v).sum()]) / picture.sum()
    assert found == pytest.approx(expected, abs=0.15)


def test_a_parallel_panel_has_one_homography_and_a_tilted_one_has_one_for_each_eye() -> None:
    stack = StackGeometry().stack()
    turned = Rotation.from_rotvec([0.01, 0.0, 0.0]).as_matrix()
    parallel = PlacedPanel(turned, np.array([stack.x_m[2], 0.001, -0.002]))
    eyes = ([0.6, 0.0, 0.0], [0.4, 0.2, 0.1])
    a, b = (true_from_ideal_seen(parallel, eye, stack, 2) for eye in eyes)
    assert np.allclose(a, b, atol=1e-9)
    tilted = PlacedPanel(Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix(), parallel.centre_m)
    a, b = (through(true_from_ideal_seen(tilted, eye, stack, 2), np.array([[1900.0, 540.0]])) for eye in eyes)
    assert np.linalg.norm(a - b) > 1.0
