"""A viewer of known eye separation shows when the calibration has drifted, and when it is right again."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.eyes.calibration_drift import SAMPLES, SAMPLES_MIN, SeparationWatch
from runtime.records import EyePoints


def eyes(separation_m: float, *, noise_m: float = 0.0, random: np.random.Generator | None = None) -> EyePoints:
    points = np.array([[0.6, -separation_m / 2, 0.0], [0.6, separation_m / 2, 0.0]])
    return EyePoints(points + (random.normal(scale=noise_m, size=(2, 3)) if random else 0.0), np.array([0.9, 0.9]))


def watch(known_m: float = 0.062) -> SeparationWatch:
    return SeparationWatch(known_ipd_m=known_m)


def test_a_true_separation_says_nothing() -> None:
    watching, random = watch(), np.random.default_rng(0)
    said = [watching.update(eyes(0.062, noise_m=0.003, random=random)) for _ in range(2000)]
    assert set(said) == {""}
    assert watching.ratio == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_drift_is_reported_once_and_so_is_its_end(share: float) -> None:
    watching, random = watch(), np.random.default_rng(0)
    said = [watching.update(eyes(0.062 * share, noise_m=0.003, random=random)) for _ in range(1000)]
    told = [text for text in said if text]
    assert len(told) == 1
    assert "62.0 mm" in told[0]
    assert watching.warning == told[0]
    said = [watching.update(eyes(0.062)) for _ in range(SAMPLES)]
    assert [text for text in said if text] == ["calibration: the eyes' separation is right again"]
    assert watching.warning == ""


def test_too_few_samples_are_no_evidence() -> None:
    watching = watch()
    for _ in range(SAMPLES_MIN - 1):
        assert watching.update(eyes(0.1)) == ""
    assert watching.ratio is None
    assert watching.update(eyes(0.1)) != ""


def test_noise_alone_is_no_evidence_of_a_small_drift() -> None:
    """Just beyond the tolerance, with noise that could explain it: silence."""
    watching, random = watch(), np.random.default_rng(1)
    for _ in range(SAMPLES_MIN):
        assert watching.update(eyes(0.062 * 1.045, noise_m=0.006, random=random)) == ""


def test_an_unknown_viewer_is_not_watched() -> None:
    watching = watch(known_m=0.0)
    assert {watching.update(eyes(0.2)) for _ in range(SAMPLES)} == {""}
    assert watching.ratio is None


def test_filled_in_uncertain_and_broken_eyes_do_not_count() -> None:
    watching = watch()
    sure = eyes(0.1)
    for _ in range(SAMPLES):
        watching.update(EyePoints(sure.eyes_m, sure.confidence, completed="right"))
        watching.update(EyePoints(sure.eyes_m, np.array([0.9, 0.2])))
        watching.update(EyePoints(sure.eyes_m * np.nan, sure.confidence))
    assert watching.ratio is None
