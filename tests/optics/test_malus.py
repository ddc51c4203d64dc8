"""Malus' law against explicit products of Jones matrices (EyeReal supplement, (1)-(7))."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.optics.malus import intensity_from_phase, phase_from_intensity
from tests.optics import reference
from tests.optics.strategies import floats

panel_values = st.lists(floats(0.0, 1.0), min_size=1, max_size=8)


@given(panel_values)
def test_what_an_eye_sees_is_the_jones_product_between_crossed_polarizers(values: list[float]) -> None:
    by_hand = reference.jones_intensity([value * math.pi / 2 for value in values], analyser=math.pi / 2)
    assert float(intensity_from_phase(np.array(sum(values)))) == pytest.approx(by_hand, abs=1e-12)


def test_the_angle_from_the_transmission_axis_would_give_cos_squared() -> None:
    """The erratum to (1): bright without a rotation."""
    assert reference.jones_intensity([0.0], analyser=0.0) == 1.0


@pytest.mark.parametrize("branch", [1, 2])
@given(intensity=floats(0.0, 1.0))
def test_each_branch_inverts_malus_law_within_its_own_range(branch: int, intensity: float) -> None:
    phase = phase_from_intensity(np.array(intensity), branch)
    assert branch - 1 <= phase <= branch
    assert float(intensity_from_phase(phase)) == pytest.approx(intensity, abs=1e-15)


def test_intensities_outside_the_range_are_clipped_and_never_nan() -> None:
    phase = phase_from_intensity(np.array([-0.5, 0.0, 1.0, 1.5]), 1)
    np.testing.assert_allclose(phase, [0.0, 0.0, 1.0, 1.0], atol=1e-15)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_single_precision_stays_single(dtype: type) -> None:
    value: Any = np.linspace(0, 1, 1001, dtype=dtype)
    phase = phase_from_intensity(value)
    assert phase.dtype == dtype
    assert intensity_from_phase(phase).dtype == dtype
    # With a slope of sin² of at most 1, the phase's error bounds the intensity's.
    assert np.abs(intensity_from_phase(phase) - value).max() < 4 * np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", [bool, np.int8, np.int32, np.int64])
def test_whole_numbers_are_taken_as_numbers_and_not_rounded_to_their_type(dtype: type) -> None:
    """Once pi/2 became 1 in an integer type, and white was sin²(1)."""
    np.testing.assert_allclose(intensity_from_phase(np.array([0, 1], dtype)), [0.0, 1.0], atol=1e-15)  # type: ignore[type-var]
    np.testing.assert_allclose(phase_from_intensity(np.array([0, 1], dtype), 1), [0.0, 1.0], atol=1e-15)  # type: ignore[type-var]
    np.testing.assert_allclose(phase_from_intensity(np.array([0, 1], dtype), 2), [2.0, 1.0], atol=1e-15)  # type: ignore[type-var]
