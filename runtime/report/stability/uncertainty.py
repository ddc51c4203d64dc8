"""Extreme cases of unsure eyes: the network along the eyes' line against least squares written out in double."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from runtime.model.chain import chain_modes
from runtime.model.job import Job
from runtime.model.transfer import FULL
from runtime.model.unrolled import UnrolledPredictor
from runtime.records import F64, U8
from runtime.report.stability.networks import MODELS, STACK, ready
from runtime.report.stability.trial import Answer, Trial, refusal

STAGE = "unsure eyes"
SIGMAS_MM = (0.0, 1e-6, 0.1, 1.0, 2.0, 4.0, 10.0, 50.0)
ROWS, PANEL_CODE = 8, 1 / 255
DRIVEN_MOST = ((1.0, 0.97), (50.0, 0.5))  # from so many millimetres on, of the drive of sure eyes, at most
LEAST_SURE = 0.05  # of the outer panels' mean drive for two points


def loaded(model: str) -> UnrolledPredictor:
    """A shipped model on the small panels."""
    predictor = ready(model, STACK)
    assert isinstance(predictor, UnrolledPredictor)
    return predictor


def answer_of(model: str, need: F64, doubt: tuple[float, float, float]) -> F64:
    """(2, rows, columns) rear and front for what the right eye lacks (rows, columns), the left one the opposite."""
    session = loaded(model).session
    columns = 2 * session.contract.cell_px
    cells = need.shape[1] // columns
    codes = np.rint(need * FULL).astype(np.int16).reshape(ROWS, cells, columns)
    modes: Mapping[str, Any] = dict(
        zip(("waves", "shifted_waves", "spectrum", "modes_in"), chain_modes(cells), strict=True)
    )
    shape = (ROWS, cells + 1, columns)
    feeds = {"left": -codes, "right": codes, **modes, "doubt": np.array(doubt, np.float32)}
    found = session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
    return np.stack([found[name].reshape(ROWS, -1) for name in ("rear", "front")]) / FULL


def unsure(model: str, sigma_columns: float) -> Answer:
    """One wave, even along rows and within cells, against its own least squares.

    Even in every cell, the centre's parallax nothing: g = s/(s² + 8(1 - m²)cos(2ws)-terms + floor)·2·need per mode of
    the chain (the network's docstring). What an even pattern has of doubt is its mode's own frequency; the floor is
    bounded, not known: the answer must lie between none and a hundredth.
    """
    cell = loaded(model).session.contract.cell_px
    cells, k = 12, 3
    angle = np.pi * k / (cells + 1)
    along = np.repeat(np.sin(angle * np.arange(1, cells + 1)), 2 * cell) * 0.05
    need = np.tile(along, (ROWS, 1))
    rear, front = answer_of(model, need, (sigma_columns, 0.0, 0.0))
    s2 = (4 * np.sin(angle / 2)) ** 2
    m2 = np.exp(-((sigma_columns * angle / (2 * cell)) ** 2))
    noise = 8 * (1 - m2) + 8 * (1 - s2 / 8) * (m2 - m2 * m2)
    at = np.repeat(np.cos(angle * (np.arange(cells + 1) + 0.5)), 2 * cell)
    found = float((front - rear).mean(axis=0) @ at / (at @ at) / 2)
    wanted = [-2 * 0.05 * math.sqrt(m2 * s2) / (m2 * s2 + noise + floor) for floor in (0.0, 0.05)]
    off = max(min(wanted) - found, found - max(wanted), 0.0)
    return Answer(
        off, PANEL_CODE, 1 / (m2 * s2 + noise + 1e-3), note=f"{found:.4f}, between {wanted[0]:.4f} and {wanted[1]:.4f}"
    )


def whole(model: str, sigma_mm: float) -> Answer:
    """A whole prediction of eyes that disagree everywhere: the outer panels nearer to even, the less is known."""
    driven, sure = (
        float(np.abs(layers_of(model, sigma)[[0, 2]].astype(float) - 128).mean() / 255) for sigma in (sigma_mm, 0.0)
    )
    most = sure * min((share for least_mm, share in DRIVEN_MOST if sigma_mm >= least_mm), default=1.0)
    note = f"outer panels {driven:.3f} from even, for two points {sure:.3f}"
    return Answer(max(driven - most, LEAST_SURE - sure, 0.0), 0.001, note=note)


def layers_of(model: str, sigma_mm: float, separation_m: float = 0.062) -> U8:
    """(3, h, w, 3) what a model shows to eyes that disagree everywhere."""
    random = np.random.default_rng(3)
    images = [[random.integers(0, 256, (108, 192, 4), dtype=np.uint8)] for _ in range(2)]
    eyes = np.array([[0.6, -separation_m / 2, 0.0], [0.6, separation_m / 2, 0.0]])
    return loaded(model).solve(Job(images, eyes, eye_sigma_mm=sigma_mm)).layers[..., :3].copy()


def trials() -> Iterator[Trial]:
    """What there is to try."""
    for model in MODELS:
        for columns in (0.0, 0.01, 0.13, 1.0, 6.0, 100.0):
            yield Trial(
                STAGE,
                f"{model}: a wave, doubt of {columns:g} columns",
                partial(unsure, model, columns),
                measure="phase",
            )
    for sigma_mm in SIGMAS_MM:
        yield Trial(
            STAGE,
            f"balanced: eyes off by {sigma_mm:g} mm",
            partial(whole, "balanced", sigma_mm),
            measure="phase",
        )
    for name, sigma_mm in (("NaN", math.nan), ("infinite", math.inf)):
        yield refusal(STAGE, f"balanced: {name} doubt", partial(layers_of, "balanced", sigma_mm))
    yield refusal(STAGE, "balanced: separation vanishes", partial(layers_of, "balanced", 1.0, 1e-15))
