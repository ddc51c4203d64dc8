"""The simulated camera: rays, light, glass, distortion, against independent answers."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.placed import PlacedPanel, ideal_panel, in_frame_of, misplaced, stack_from_pixels, true_from_ideal_seen
from calib.registration import through
from calib.simulator import Exposure, Glass, Lens, Scene, camera_from_stack, phone, photograph
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
    glass: Glass | None = None,
    seed: int = 0,
) -> NDArray[np.uint8]:
    panels = panels or tuple(ideal_panel(STACK, index) for index in range(3))
    scene = Scene(STACK, panels, layers, glass or Glass())
    return photograph(scene, lens, pose, exposure, random=np.random.default_rng(seed))


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


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 35.0])
def test_glass_shifts_what_lies_behind_it_as_snell_says(angle_deg: float) -> None:
    angle = np.radians(angle_deg)
    pose = camera_from_stack(0.7 * np.array([np.cos(angle), np.sin(angle), 0.0]), towards_m=np.zeros(3))
    layers = uniform(0, 0, 0)
    layers[1, 125:145, 230:250] = 255  # round the middle of the centre panel
    glass = Glass(thickness_m=0.004, index=1.5)
    shifts = []
    for chosen in (Glass(), glass):
        picture = taken(layers, pose=pose, glass=chosen, lens=Lens(1200, 900, 1800.0, (600.0, 450.0))).astype(float)
        _, u = np.indices(picture.shape)
        shifts.append((picture * u).sum() / picture.sum())
    # One and a half plates stand before the light of the centre panel: it is seen nearer by t(1 - tan'/tan).
    inside = np.arcsin(np.sin(angle) / 1.5)
    share = np.tan(inside) / np.tan(angle) if angle else 1 / 1.5
    nearer_m = 1.5 * 0.004 * (1 - share)
    seen = pose @ [nearer_m, 0.0, 0.0, 1.0]
    assert shifts[1] - shifts[0] == pytest.approx(1800 * seen[0] / seen[2], abs=0.3)


def test_the_same_seed_takes_the_same_photograph_and_noise_is_as_told() -> None:
    exposure = Exposure(vignetting=0.0, gamma=1.0, jpeg_quality=0, grid=0.0, electrons=1000.0, read_noise=0.0)
    first, again = (taken(uniform(1, 0, 0), exposure=exposure, seed=3) for _ in range(2))
    assert np.array_equal(first, again)
    patch = first[400:480, 560:660].astype(float) / 255
    assert patch.std() == pytest.approx(np.sqrt(patch.mean() / 1000), rel=0.1)


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


def test_an_eye_in_a_panels_plane_is_refused() -> None:
    with pytest.raises(ValueError, match="sees nothing"):
        true_from_ideal_seen(ideal_panel(STACK, 1), [0.0, 0.5, 0.0], STACK, 1)


def test_the_reference_panel_is_the_frame() -> None:
    panels = misplaced(STACK, shift_m=0.002, turn_deg=1.0, gap_m=0.002, random=np.random.default_rng(1))
    framed = in_frame_of(panels, reference=1, reference_x_m=0.0)
    assert np.allclose(framed[1].rotation, np.eye(3))
    assert np.allclose(framed[1].centre_m, 0)
    for a, b in ((0, 1), (1, 2)):
        before = np.linalg.norm(panels[a].centre_m - panels[b].centre_m)
        assert np.linalg.norm(framed[a].centre_m - framed[b].centre_m) == pytest.approx(before)


def test_phones_differ() -> None:
    assert phone(random=np.random.default_rng(0)) != phone(random=np.random.default_rng(1))
