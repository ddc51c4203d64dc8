"""How surely a ray's end at the eye is known."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.optics.pupil import configured_sigma_mm


def test_a_pupil_of_four_millimetres_spreads_by_one() -> None:
    assert configured_sigma_mm("auto", tracker_sigma_m=0.0) == 1.0
    angle, radius = np.random.default_rng(1).random((2, 200_000)) * [[2 * np.pi], [1]]
    across = 2.0 * np.sqrt(radius) * np.cos(angle)  # even over a disc of 2 mm radius
    assert across.std() == pytest.approx(1.0, abs=0.01)


def test_pupil_and_tracker_add_as_independent_errors_do_and_a_number_stands() -> None:
    assert configured_sigma_mm("auto", tracker_sigma_m=0.003) == pytest.approx(np.sqrt(10))
    assert configured_sigma_mm(0.0, tracker_sigma_m=0.003) == 0.0
