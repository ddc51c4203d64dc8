"""What a step of setting up is worth: displayed dB of the configured scene from the viewing place."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.pictures import layers_for, scene_pictures
from calib.viewpoints import IPD_M, eyes_at, viewing_place_m
from runtime.config import Settings
from runtime.optics.carried import carried_quality, expected_psnr_db
from runtime.panels.lut import measured_curve
from runtime.records import F32, F64, U8


def _solved(settings: Settings) -> tuple[U8, tuple[U8, U8], F64]:
    """Layers, the two eyes' pictures, and the eyes (2, 3) for which they were made."""
    stack = settings.stack.stack()
    eyes_m = eyes_at(viewing_place_m(settings.calibration), settings.calibration.ipd_m or IPD_M)
    pictures = scene_pictures(settings, stack, eyes_m)
    fov_deg = settings.content.fov_deg
    layers = layers_for(pictures, stack, eyes_m, settings=settings, model=settings.model.name, fov_deg=fov_deg)
    return layers, pictures, eyes_m


def turned_to(greys: F32, grey: F64) -> F64:
    """(n, 3) phases to which a panel turns for greys (n, 3), where a LUT (256, 3) has the greys for even phases."""
    phases = np.linspace(0.0, 1.0, len(greys))
    found = [np.interp(grey[:, channel], greys[:, channel], phases) for channel in range(greys.shape[1])]
    return np.stack(found, axis=-1)


def grey_worth(settings: Settings) -> dict[str, dict[str, float]]:
    """dB with panels that follow exactly, with the measured curves as they are sent (eight bits), and without them.

    A panel without a curve counts as one that follows exactly. Raises InputError.
    """
    layers, pictures, eyes_m = _solved(settings)
    codes = np.repeat(np.arange(256)[:, None] / 255, 3, axis=1)
    sent: F32 = layers[..., :3].astype(np.float32) / np.float32(255)
    bare = sent.copy()
    for number, panel in enumerate(settings.output.panels):
        if not panel.lut:
            continue
        greys = measured_curve(Path(panel.lut))
        with_curve, without = turned_to(greys, np.rint(255 * greys) / 255), turned_to(greys, codes)
        for channel in range(3):
            shown = layers[number, ..., channel]
            sent[number, ..., channel] = with_curve[shown, channel]
            bare[number, ..., channel] = without[shown, channel]

    def seen(shown: U8 | F32) -> float:
        return carried_quality(
            shown, pictures, settings.stack.stack(), solved_for_m=eyes_m, eyes_m=eyes_m,
            fov_deg=settings.content.fov_deg,
        ).psnr_db  # fmt: skip

    return {"psnr_db": {"perfect panels": seen(layers), "with curves": seen(sent), "without": seen(bare)}}


def calibration_worth(settings: Settings, *, eye_error_m: float) -> dict[str, float]:
    """dB for eyes that are exactly known, and expected for eyes that are off by so much (RMS distance)."""
    layers, pictures, eyes_m = _solved(settings)

    def expected(sigma_mm: float) -> float:
        return expected_psnr_db(
            layers, pictures, settings.stack.stack(), eyes_m=eyes_m, fov_deg=settings.content.fov_deg,
            sigma_mm=sigma_mm, step=2,
        )  # fmt: skip

    return {"eyes known exactly": expected(0.0), "as calibrated": expected(1e3 * eye_error_m / np.sqrt(3))}
