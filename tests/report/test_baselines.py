"""Reference methods: an exact transpose, and CG that never makes the shown picture worse."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.report.baselines import as_codes, conjugate_gradients, eye_operator, mean_of_targets

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 48, 28)
EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.032, 0.05]])
VIEW = {"width_px": 48, "height_px": 28, "fov_deg": 40.0}


def scene(seed: int = 0) -> list[np.ndarray]:
    """Two smooth pictures that differ a little, as two eyes' do."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0.2, 0.9, (7, 12, 3))
    base = np.kron(coarse, np.ones((4, 4, 1))).astype(np.float32)
    return [base, np.roll(base, 1, axis=1)]


def displayed_db(layers: np.ndarray, wanted: list[np.ndarray], eyes: np.ndarray = EYES) -> float:
    retinas = [seen_by(eye, as_codes(layers), STACK, fov_deg=40.0) for eye in eyes]
    return quality([r.image for r in retinas], wanted, [r.mask for r in retinas]).psnr_db


def test_the_operator_adds_up_what_the_retina_sees() -> None:
    operator = eye_operator(EYES[0], STACK, **VIEW)
    layers = np.random.default_rng(1).random((3, 28, 48, 3), dtype=np.float32)
    phases = operator.phases(layers.reshape(3, -1, 3))
    seen = seen_by(EYES[0], layers, STACK, fov_deg=40.0)
    np.testing.assert_array_equal(operator.mask, seen.mask)
    np.testing.assert_allclose(np.sin(phases * np.pi / 2) ** 2, seen.image[seen.mask], atol=1e-5)


def test_the_transpose_is_exact() -> None:
    operator = eye_operator(EYES[1], STACK, **VIEW)
    rng = np.random.default_rng(2)
    layers = rng.standard_normal((3, 28 * 48, 1)).astype(np.float32)
    rays = rng.standard_normal((int(operator.mask.sum()), 1)).astype(np.float32)
    there = float((operator.phases(layers) * rays).sum(dtype=np.float64))
    back = float((operator.back(rays) * layers).sum(dtype=np.float64))
    assert there == pytest.approx(back, rel=1e-4, abs=1e-2)


def test_more_iterations_show_a_better_picture_and_beat_the_mean() -> None:
    wanted = scene()
    operators = [eye_operator(eye, STACK, **VIEW) for eye in EYES]
    values = [displayed_db(conjugate_gradients(operators, wanted, STACK, iterations=n), wanted) for n in (1, 3, 10, 30)]
    assert values == sorted(values)
    assert values[1] > displayed_db(mean_of_targets(EYES, wanted, STACK, fov_deg=40.0), wanted)


def test_where_the_wish_does_not_fit_the_box_cg_is_never_worse_than_its_start() -> None:
    """Black for one eye, white for the other, over panels a millimetre apart: nothing can show that."""
    stack = PanelStack(0.5184, 0.2916, (-0.001, 0.0, 0.001), 48, 28)
    wanted = [np.zeros((28, 48, 3), np.float32), np.ones((28, 48, 3), np.float32)]
    operators = [eye_operator(eye, stack, **VIEW) for eye in EYES]

    def left_over(layers: np.ndarray) -> float:
        flat = layers.reshape(3, -1, 3)
        targets = (2.0, 1.0)
        return sum(float(((o.phases(flat) - t) ** 2).sum()) for o, t in zip(operators, targets, strict=True))

    start = left_over(np.full((3, 28, 48, 3), 0.5, np.float32))
    for iterations in (1, 10, 100):
        layers = conjugate_gradients(operators, wanted, stack, iterations=iterations)
        assert layers.min() >= 0 and layers.max() <= 1
        assert left_over(layers) <= start * 1.0001
