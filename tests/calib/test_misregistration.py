"""A displaced panel costs what it must, and the registration gives it back."""

from __future__ import annotations

import numpy as np
import pytest

from calib.misregistration import corrected, displayed_quality, seen_through, shifted
from calib.registration import ideal_partner, register, through, true_from_ideal
from calib.vernier import nominal, simulate
from runtime.config import PanelSettings
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack

EYES = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])
VIEW = {"fov_deg": 40.0, "width_px": 480, "height_px": 270}


def smooth_layers(seed: int = 0) -> np.ndarray:
    import cv2

    random = np.random.default_rng(seed)
    noise = random.normal(size=(3, 270, 480, 4)).astype(np.float32)
    layers = np.stack([cv2.GaussianBlur(layer, (0, 0), 3) for layer in noise])
    layers = np.clip(128 + 60 * layers / layers.std(), 0, 255).astype(np.uint8)
    layers[..., 3] = 255
    return layers


def test_panels_in_their_places_look_as_the_retina_says(small_stack: PanelStack) -> None:
    layers = smooth_layers()
    straight = seen_through(EYES[0], layers, small_stack, [np.eye(3)] * 3, **VIEW)
    plain = seen_by(EYES[0], layers, small_stack, **VIEW)
    np.testing.assert_array_equal(straight.image, plain.image)
    np.testing.assert_array_equal(straight.mask, plain.mask)


def test_a_displaced_panel_looks_as_its_shifted_picture(small_stack: PanelStack) -> None:
    """Pixel (u, v) of a panel displaced by (3, -2) lies where (u - 3, v + 2) belongs."""
    layers = smooth_layers()
    displaced = seen_through(EYES[0], layers, small_stack, shifted(small_stack, index=2, shift_px=(3, -2)), **VIEW)
    moved = layers.copy()
    moved[2] = np.roll(layers[2], (2, -3), axis=(0, 1))
    plain = seen_by(EYES[0], moved, small_stack, **VIEW)
    inner = plain.mask & displaced.mask
    inner[:12], inner[-12:], inner[:, :12], inner[:, -12:] = False, False, False, False
    np.testing.assert_allclose(displaced.image[inner], plain.image[inner], atol=2e-3)


def test_half_a_pixel_costs_and_more_costs_more(small_stack: PanelStack) -> None:
    layers = smooth_layers()
    wanted = [(seen_by(eye, layers, small_stack, **VIEW).image * 255).astype(np.uint8) for eye in EYES]
    cost = [
        displayed_quality(
            layers, wanted, EYES, small_stack, shifted(small_stack, index=2, shift_px=(shift, 0.0)), fov_deg=40.0
        ).psnr_db
        for shift in (0.0, 0.5, 1.0, 2.0)
    ]
    assert cost[0] > cost[1] + 3 > cost[2] + 6
    assert cost[2] > cost[3] + 3


def test_the_correction_gives_the_picture_back(small_stack: PanelStack) -> None:
    layers = smooth_layers()
    wanted = [(seen_by(eye, layers, small_stack, **VIEW).image * 255).astype(np.uint8) for eye in EYES]
    truth = [
        true_from_ideal(np.random.default_rng(n).normal(scale=1.5, size=(4, 2)), width_px=480, height_px=270)
        for n in range(3)
    ]
    spoiled = displayed_quality(layers, wanted, EYES, small_stack, truth, fov_deg=40.0).psnr_db
    mended = displayed_quality(corrected(layers, truth), wanted, EYES, small_stack, truth, fov_deg=40.0).psnr_db
    assert mended > spoiled + 10


def test_the_correction_is_what_the_presentation_shader_does() -> None:
    """One homography, through OpenCV here and through the panels' own shader there."""
    from runtime.clock import SimulatedClock
    from runtime.panels.offscreen import OffscreenPanels
    from runtime.records import PanelFrame
    from runtime.support.gl import offscreen_context

    layers = smooth_layers()
    matrix = true_from_ideal(np.array([[2.0, 1], [-1, 3], [1, -2], [0, 2]]), width_px=480, height_px=270)
    panels = (PanelSettings(), PanelSettings(homography=tuple(map(tuple, matrix.tolist()))), PanelSettings())
    sink = OffscreenPanels(offscreen_context(), clock=SimulatedClock(), width_px=480, height_px=270, panels=panels)
    sink.present(PanelFrame(1, layers, 1))
    shown = sink.read_back()[1]
    sink.close()
    ours = corrected(layers, [np.eye(3), matrix, np.eye(3)])[1]
    inner = (slice(6, -6), slice(6, -6), slice(0, 3))
    assert np.abs(shown[inner].astype(int) - ours[inner].astype(int)).max() <= 3


def test_a_viewpoint_off_the_mark_does_no_harm_to_eyes_that_are_calibrated_afterwards(small_stack: PanelStack) -> None:
    """Verniers set from 2 mm beside the mark shear the stack: whoever stands beside in proportion sees it straight."""
    off_m, mark, eye = np.array([0.0, 0.002, -0.001]), np.array([0.5, 0.0, 0.0]), np.array([0.6, 0.03, 0.02])
    asked = nominal(tuple(mark), small_stack, reference=1)
    nothing = [np.eye(3)] * 3
    random = np.random.default_rng(0)
    taken = simulate(asked, small_stack, nothing, noise_px=0.0, viewpoint_error_m=off_m, random=random)
    found = [panel.true_from_ideal for panel in register(taken, small_stack, reference=1).panels]
    middle = np.array([[240.0, 135.0], [100.0, 60.0], [400.0, 200.0]])
    for index in (0, 2):
        meant = ideal_partner(middle, eye, small_stack, reference=1, panel=index)
        errors = []
        for place in (eye, eye + off_m * eye[0] / mark[0]):
            looked_at = ideal_partner(middle, place, small_stack, reference=1, panel=index)
            shown_there = through(np.linalg.inv(found[index]), looked_at)
            errors.append(np.linalg.norm(shown_there - meant, axis=1).max())
        assert errors[0] > 0.15, "at a quarter of the resolution that is half a pixel of the prototype's"
        assert errors[1] < 0.01 * errors[0]


@pytest.mark.parametrize("index", range(3))
def test_only_the_panel_that_was_asked_for_is_displaced(small_stack: PanelStack, index: int) -> None:
    matrices = shifted(small_stack, index=index, shift_px=(1.5, 0.5))
    for number, matrix in enumerate(matrices):
        assert np.array_equal(matrix, np.eye(3)) == (number != index)
