"""The 2D picture, and the tables between codes and phases that every solver uses."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.kernels import FULL, SUBCODE
from runtime.model.targets import (
    flat_layers,
    is_grey,
    middle_codes,
    outside_codes,
    phase_codes,
    rest_of,
    slope_of,
    target_table,
    without_alpha,
)
from runtime.optics.malus import intensity_from_phase, rest_value
from runtime.optics.stack import PanelStack


@pytest.mark.parametrize("panels", [2, 3, 4, 5, 8])
def test_every_eye_sees_the_picture_whatever_it_looks_through(panels: int) -> None:
    """The outer panels are even, so that a ray meets the same phases beside the middle one wherever it comes from."""
    stack = PanelStack(0.5, 0.3, tuple(np.linspace(-0.06, 0.06, panels)), 256, 16)
    picture = np.zeros((16, 256, 4), np.uint8)
    picture[..., :3] = np.arange(256)[None, :, None]
    layers = flat_layers(picture, stack)
    assert layers.shape == (panels, 16, 256, 4)
    others = [n for n in range(panels) if n != panels // 2]
    assert all(np.ptp(layers[n, ..., :3]) == 0 for n in others)
    seen = intensity_from_phase(layers[..., :3].astype(np.float64).sum(axis=0) / 255) * 255
    assert np.abs(seen - picture[..., :3]).max() < 1.0  # half a code of the middle panel, at sin²'s steepest
    assert (layers[..., 3] == 255).all()


@pytest.mark.parametrize("panels", [2, 3, 4, 5])
def test_fading_to_the_flat_picture_stays_on_the_solver_s_slope(panels: int) -> None:
    """Or every fade would pass through black or white."""
    stack = PanelStack(0.5, 0.3, tuple(np.linspace(-0.06, 0.06, panels)), 256, 16)
    flat = flat_layers(np.full((16, 256, 4), 128, np.uint8), stack)[:, 0, 0, 0].sum() / 255
    assert int(flat) == int(rest_value(panels) * panels)


def test_colours_stay_in_their_channels() -> None:
    stack = PanelStack(0.5, 0.3, (-0.06, 0.0, 0.06), 32, 16)
    picture = np.full((16, 32, 4), (200, 100, 30, 255), np.uint8)
    codes = flat_layers(picture, stack).astype(np.float64)[..., :3].sum(axis=0) / 255
    assert intensity_from_phase(codes[0, 0]) * 255 == pytest.approx([200, 100, 30], abs=1.0)


@pytest.mark.parametrize("branch", [1, 2])
def test_phase_codes_are_phases_in_sixteenths_of_a_code(branch: int) -> None:
    table = phase_codes(branch)  # type: ignore[arg-type]
    assert table.shape == (256,) and table.dtype == np.int16
    assert np.abs(intensity_from_phase(table / FULL) * 255 - np.arange(256)).max() < 0.8 / SUBCODE
    low, high = (0, FULL) if branch == 1 else (FULL, 2 * FULL)
    assert table.min() == low and table.max() == high


@pytest.mark.parametrize(
    ("panels", "rest", "slope", "middle"),
    [
        (2, 3060, 1, [255, 243, 191, 142, 64]),
        (3, 2040, 1, [255, 180, 127, 78, 0]),
        (4, 1530, 1, [223, 148, 95, 47, 0]),
        (5, 2040, 2, [0, 75, 128, 177, 255]),
        (6, 1020, 1, [191, 116, 63, 15, 0]),
    ],
)
def test_targets_show_their_codes_on_the_slope_nearest_to_rest(
    panels: int, rest: int, slope: int, middle: list[int]
) -> None:
    assert (rest_of(panels), slope_of(panels)) == (rest, slope)
    sums, weights = target_table(panels).T
    assert np.abs(intensity_from_phase(sums.astype(np.float64) / FULL) * 255 - np.arange(256)).max() < 1e-3
    assert sums[0] == 2 * FULL and sums[255] == (FULL if slope == 1 else 3 * FULL)
    assert weights[[0, 51, 128, 204, 255]] == pytest.approx([0.25, 0.87413, 1.0, 0.87413, 0.25], abs=1e-4)
    assert middle_codes(panels)[[0, 51, 128, 200, 255]].tolist() == middle


def test_panels_outside_a_window_rest_beside_the_middle_one() -> None:
    assert [outside_codes(3, n, 90) for n in range(3)] == [[128] * 3, [90] * 3, [128] * 3]
    assert [outside_codes(2, n, (0, 51, 255)) for n in range(2)] == [[191] * 3, [255, 243, 64]]


def test_alpha_is_no_colour() -> None:
    picture = np.full((40, 40, 4), (7, 7, 7, 255), np.uint8)
    assert is_grey(picture) and is_grey(picture[..., :3])
    picture[3, 5, 1:3] = 8
    assert not is_grey(picture) and is_grey(picture[4:]) and not is_grey(picture[3:, 5:])
    for given in (picture, picture[..., :3]):
        assert without_alpha(given, 3)[3, 5].tolist() == [7, 8, 8] and without_alpha(given, 3).shape == (40, 40, 3)
    assert (without_alpha(picture, 1) == np.full((40, 40), 7)).all()
