"""Reference methods: the operator is the retina's, and CG never makes the shown picture worse."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.sparse import vstack

from runtime.optics.malus import phase_from_intensity
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.report.stability.references import conjugate_gradients, eye_operator, mean_of_targets

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 48, 28)
EYES = np.array([[0.6, -0.031, 0.05], [0.6, 0.032, 0.05]])
VIEW: Any = {"width_px": 48, "height_px": 28, "fov_deg": 40.0}


def scene(seed: int = 0) -> list[np.ndarray]:
    """Two smooth pictures that differ a little, as two eyes' do."""
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(0.2, 0.9, (7, 12, 3))
    base = np.kron(coarse, np.ones((4, 4, 1))).astype(np.float32)
    return [base, np.roll(base, 1, axis=1)]


def problem(wanted: list[np.ndarray], stack: PanelStack) -> tuple[Any, np.ndarray]:
    """The operator of both eyes, and the phases that they want."""
    eyes = [eye_operator(eye, stack, **VIEW) for eye in EYES]
    phases = [phase_from_intensity(image[mask], 2) for (_, mask), image in zip(eyes, wanted, strict=True)]
    return vstack([operator for operator, _ in eyes], format="csr"), np.concatenate(phases)


def left_over(operator: Any, phases: np.ndarray, layers: np.ndarray) -> float:
    return float(((operator @ layers.reshape(operator.shape[1], -1) - phases) ** 2).sum())


def test_the_operator_adds_up_what_the_retina_sees() -> None:
    operator, mask = eye_operator(EYES[0], STACK, **VIEW)
    layers = np.random.default_rng(1).random((3, 28, 48, 3), dtype=np.float32)
    phases = operator @ layers.reshape(-1, 3)
    seen = seen_by(EYES[0], layers, STACK, fov_deg=40.0)
    np.testing.assert_array_equal(mask, seen.mask)
    np.testing.assert_allclose(np.sin(phases * np.pi / 2) ** 2, seen.image[seen.mask], atol=1e-5)


def test_more_iterations_leave_less_and_less_than_the_mean() -> None:
    wanted = scene()
    operator, phases = problem(wanted, STACK)
    left = [left_over(operator, phases, conjugate_gradients(operator, phases, iterations=n)) for n in (30, 10, 3, 1)]
    assert left == sorted(left)
    assert left[2] < left_over(operator, phases, mean_of_targets(EYES, wanted, STACK, fov_deg=40.0))


def test_where_the_wish_does_not_fit_the_box_cg_is_never_worse_than_its_start() -> None:
    """Black for one eye, white for the other, over panels a millimetre apart: nothing can show that."""
    stack = PanelStack(0.5184, 0.2916, (-0.001, 0.0, 0.001), 48, 28)
    operator, phases = problem([np.zeros((28, 48, 3), np.float32), np.ones((28, 48, 3), np.float32)], stack)
    start = left_over(operator, phases, np.full((3, 28, 48, 3), 0.5, np.float32))
    for iterations in (1, 10, 100):
        layers = conjugate_gradients(operator, phases, iterations=iterations)
        assert layers.min() >= 0 and layers.max() <= 1
        assert left_over(operator, phases, layers) <= start * 1.0001
