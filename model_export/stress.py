"""Inputs used to check a model: an ordinary pair of pictures, and extreme ones."""

from __future__ import annotations

import numpy as np

from model_export.data import random_pair
from runtime.kernels import FULL
from runtime.model.chain import cell_waves, chain_modes
from runtime.model.contract import Contract
from runtime.model.proposal import INPUTS
from runtime.optics.malus import phase_from_intensity
from runtime.records import F32

Feeds = dict[str, np.ndarray]
ORDINARY = "ordinary pair"
EXTRA = ("one eye black", "noise")
LARGE_PX = 1_000_000  # number of pixels above which the `EXTRA` cases are skipped


def stress_pictures(height: int, width: int) -> dict[str, tuple[F32, F32]]:
    """Return extreme pairs of pictures, keyed by name: left and right intensities (h, w, 3) in [0, 1]."""
    v, u = np.mgrid[0:height, 0:width]

    def grey(values: np.ndarray) -> F32:
        return np.repeat(values[..., None], 3, axis=2).astype(np.float32)

    black, white = grey(np.zeros((height, width))), grey(np.ones((height, width)))
    checker, lines = grey((u // 8 + v // 8) % 2), grey(u % 2)
    bars = grey((u // max(1, width // 6)) % 2)
    random = np.random.default_rng(11)
    left, right = (random.random((height, width, 3), dtype=np.float32) for _ in range(2))
    return {
        "all black": (black, black),
        "all white": (white, white),
        "checkerboard": (checker, 1 - checker),
        "one-pixel lines": (lines, np.roll(lines, 1, axis=1)),
        "extreme disparity": (bars, np.roll(bars, width // 3, axis=1)),
        "one eye black": (black, white),
        "noise": (left, right),
    }


def ordinary_pictures(height: int, width: int) -> tuple[F32, F32]:
    """Return left and right pictures (h, w, 3) of a random scene, with intensities in [0, 1]."""
    pair = random_pair(np.random.default_rng([77, 0]), width_px=width, height_px=height)
    left, right = (image.astype(np.float32) / np.float32(255) for image in pair.images)
    return left, right


def spectral_cases(cell_px: int) -> dict[str, Feeds]:
    """Return inputs for the spectral solver, keyed by name, with three row lengths and tracking errors."""
    cases = {}
    for cells, eye_sigma_px in ((16, (0.0, 0.0, 0.5)), (112, (0.13, 0.15, 0.3)), (400, (0.5, 0.6, 0.1))):
        size = (64, cells * 2 * cell_px)
        for name, pictures in {ORDINARY: ordinary_pictures(*size), **stress_pictures(*size)}.items():
            left, right = (phase_from_intensity(picture) for picture in pictures)
            half = np.rint((right - left).reshape(64, cells, -1) * (FULL / 2)).astype(np.int16)
            modes = dict(zip(INPUTS[2:-1], (*chain_modes(cells), *cell_waves(cell_px)), strict=True))
            cases[f"{name}, {cells} cells"] = {
                "left": -half,
                "right": half,
                **modes,
                "eye_sigma_px": np.array(eye_sigma_px, np.float32),
            }
    return cases


def picture_cases(contract: Contract, height: int, width: int) -> dict[str, Feeds]:
    """Return inputs for a picture network, keyed by name. The pictures are the same for every panel."""
    cases = {ORDINARY: ordinary_pictures(height, width), **stress_pictures(height, width)}
    if height * width > LARGE_PX:  # the published network takes seconds per case
        for name in EXTRA:
            del cases[name]
    panels = contract.panels if contract.input_frame == "panel" else 1
    return {name: picture_feeds(pictures, contract, panels) for name, pictures in cases.items()}


def picture_feeds(pictures: tuple[F32, F32], contract: Contract, panels: int) -> Feeds:
    """Return a picture network's named input (1, 6·panels, h, w), by panel, eye, RGB, for intensities."""
    if contract.input_value == "phase":
        left, right = (phase_from_intensity(picture, contract.branch) for picture in pictures)
        pictures = left, right
    eyes = np.concatenate([picture.transpose(2, 0, 1) for picture in pictures])
    return {contract.inputs[0].name: np.ascontiguousarray(np.tile(eyes, (panels, 1, 1))[None], np.float32)}
