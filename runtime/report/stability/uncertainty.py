"""Extreme cases of unsure eyes: the network along the eyes' line against least squares written out in double."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Any

import numpy as np

from runtime.model.chain import chain_modes
from runtime.model.transfer import FULL
from runtime.model.unrolled import UnrolledPredictor
from runtime.records import F64
from runtime.report.stability.networks import MODELS, STACK, ready
from runtime.report.stability.trial import Answer, Trial

STAGE = "unsure eyes"
ROWS, PANEL_CODE = 8, 1 / 255


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
