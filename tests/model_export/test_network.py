"""The shipped network against a plain version of its steps, and its check."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from model_export.network import BOX, SpectralSolver, _by_rows  # noqa: E402
from runtime.kernels import FULL  # noqa: E402
from runtime.model.chain import cell_waves, chain_modes  # noqa: E402
from runtime.model.predictor import SHIPPED, model_path  # noqa: E402
from runtime.records import F64  # noqa: E402
from runtime.support.onnx_runtime import onnxruntime  # noqa: E402

MODES = ("waves", "shifted_waves", "spectrum", "modes_in", "cell_waves", "cell_frequencies")
K = 4  # the model's unit is a parallax / K
BLOCK = 8  # rows


def feeds_of(
    *, cells: int = 9, blocks: int = 3, channels: int = 3, cell_px: int = 4, most: int = 1500
) -> dict[str, np.ndarray]:
    random = np.random.default_rng(cells + channels)
    sides = random.integers(-most, most + 1, (2, blocks * BLOCK, cells, 2 * cell_px * channels)).astype(np.int16)
    modes = dict(zip(MODES, (*chain_modes(cells), *cell_waves(cell_px)), strict=True))
    return {"left": sides[0], "right": sides[1], **modes, "eye_sigma_px": np.array([0.2, 0.3, 0.4], np.float32)}


def answers(net: SpectralSolver, feeds: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    with torch.no_grad():
        return tuple(x.numpy() for x in net(*map(torch.from_numpy, feeds.values())))


def plainly(net: SpectralSolver, feeds: dict[str, np.ndarray]) -> tuple[F64, F64]:
    """Rear and front panel (rows, cells + 1, 2K·C), not clamped: one transform after another, in double precision."""
    left, right, v, shifted, _, modes_in, waves, *_ = (np.asarray(x, np.float64) for x in feeds.values())
    spectrum, frequencies, unsure = (
        torch.from_numpy(feeds[name]) for name in ("spectrum", "cell_frequencies", "eye_sigma_px")
    )
    k_px = len(waves) // 2
    with torch.no_grad():
        gains = (x.double().reshape(BLOCK, 2 * k_px, -1).numpy() for x in net.gains(spectrum, frequencies, unsure))
    numerator, denominator, gain_h = (x.transpose(0, 2, 1)[:, :, :, None, None] for x in gains)  # rows, modes, columns
    at = np.arange(2 * k_px)
    turns = [np.exp(1j * np.pi * k * at / k_px) * np.sqrt((2 - (k in (0, k_px))) / (2 * k_px)) for k in range(k_px + 1)]
    between = [part for turn in turns[1:-1] for part in (turn.real, turn.imag)]
    columns = np.stack([turns[0].real, *between, turns[-1].real])
    rows = np.cos(np.pi * np.arange(BLOCK)[:, None] * (np.arange(BLOCK) + 0.5) / BLOCK) * np.sqrt(2 / BLOCK)
    rows[0] /= np.sqrt(2)

    def split(image: np.ndarray) -> F64:
        return image.reshape(-1, BLOCK, image.shape[1], 2 * k_px, image.shape[2] // (2 * k_px)).astype(np.float64)

    def into(image: F64, chain: F64) -> F64:
        return np.einsum("pr,kc,qu,brcus->pkqbs", rows, chain, columns, image, optimize=True)

    def out(waves: F64, chain: F64) -> F64:
        return np.einsum("pr,ck,qu,pkqbs->brcus", rows, chain, columns, waves, optimize=True)

    g = out(numerator / denominator * into(split(right - left) / FULL, modes_in), v)
    h = out(gain_h * into(split(right + left) / FULL, modes_in), shifted)
    rear, front = (image.reshape(left.shape[0], -1, left.shape[2]) for image in (BOX + h - g, BOX + h + g))
    return rear, front


@pytest.mark.parametrize("cell_px", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("channels", [1, 3])
def test_it_works_out_what_the_same_steps_do_one_by_one(channels: int, cell_px: int) -> None:
    net, feeds = SpectralSolver(K).eval(), feeds_of(channels=channels, cell_px=cell_px)
    wanted = plainly(net, feeds)
    with torch.no_grad():
        panels = net._solved(tuple(map(torch.from_numpy, feeds.values())), added=0.0)[:2]
    for found, want in zip(panels, wanted, strict=True):
        assert np.abs(_by_rows(found, like=feeds["left"]).numpy() / FULL - want).max() < 1e-5
    rear, front, check = answers(net, feeds)
    assert np.isfinite(check).all() and check.shape == (1,)
    for found, want in zip((rear, front), wanted, strict=True):
        assert found.dtype == np.dtype(np.int16)
        assert np.abs(found - np.clip(want, 0, 1) * FULL).max() < 0.5 + 0.02  # rounded, not cut off


def test_the_least_and_the_largest_codes_are_reached_and_not_passed() -> None:
    for panel in answers(SpectralSolver(K).eval(), feeds_of(most=32767))[:2]:
        assert (panel.min(), panel.max()) == (0, FULL)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", SHIPPED)
def test_a_number_that_is_not_finite_is_told_wherever_it_comes_in(name: str, bad: float) -> None:
    """One of thousands, in any of the inputs that can have one."""
    ort = onnxruntime()
    session = ort.InferenceSession(str(model_path(name)), providers=["CPUExecutionProvider"])
    good = feeds_of()
    assert np.isfinite(session.run(["check"], good)[0]).all()
    random = np.random.default_rng(3)
    for field in ("waves", "shifted_waves", "modes_in", "cell_waves", "cell_frequencies", "eye_sigma_px"):
        for at in random.integers(0, good[field].size, 6):
            spoilt: dict[str, Any] = {key: value.copy() for key, value in good.items()}
            spoilt[field].flat[at] = bad
            assert not np.isfinite(session.run(["check"], spoilt)[0]).any(), (field, at)
