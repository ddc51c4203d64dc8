"""What a registration is worth: displayed dB of the configured scene from the viewing place, on the panels as found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from calib.bundle import Bundle
from calib.misregistration import corrected, seen_through
from calib.photo_registration import PhotoRegistration, geometry_of, homographies
from calib.pictures import layers_for, scene_pictures
from calib.placed import PlacedPanel, true_from_ideal_seen
from calib.viewpoints import IPD_M, eyes_at
from runtime.config import Settings
from runtime.optics.quality import quality
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8


def seen_db(
    layers: U8,
    wanted: tuple[U8, U8],
    eyes_m: F64,
    stack: PanelStack,
    panels: tuple[PlacedPanel, ...],
    *,
    fov_deg: float,
) -> float:
    """Displayed PSNR (docs/contracts.md) of layers that were made for `stack` on panels that truly stand elsewhere."""
    height, width = wanted[0].shape[:2]
    seen = []
    for eye in eyes_m:
        matrices = [true_from_ideal_seen(panel, eye, stack, index) for index, panel in enumerate(panels)]
        seen.append(seen_through(eye, layers, stack, matrices, fov_deg=fov_deg, width_px=width, height_px=height))
    targets = [picture[..., :3].astype(np.float32) / np.float32(255) for picture in wanted]
    return quality([r.image for r in seen], targets, [r.mask for r in seen]).psnr_db


def one_draw(bundle: Bundle, *, seed: int = 0) -> tuple[PlacedPanel, ...]:
    """Panels as they may be: the found ones, off by one draw from their covariance."""
    root = np.linalg.cholesky(bundle.covariance + 1e-18 * np.eye(len(bundle.covariance)))
    return bundle.placed(bundle.parameters() + root @ np.random.default_rng(seed).normal(size=len(root)))


def displayed_db(
    found: PhotoRegistration,
    settings: Settings,
    believed: PanelStack,
    *,
    model: str,
    truth: tuple[PlacedPanel, ...] | None = None,
    even: bool | None = None,
) -> dict[str, float]:
    """dB of a perfect stack, of this one as it was configured, and of this one registered.

    truth: where the panels are (a simulation knows); else as found, off by one draw of what is uncertain. With it, also
    the dB of a registration without any error (`even`: as in `register_photographs`): what is lost there is lost by
    resampling and tilts. Raises InputError, MissingPart.
    """
    panels = one_draw(found.bundle) if truth is None else truth
    eyes_m = eyes_at(found.eye_m, settings.calibration.ipd_m or IPD_M)
    fov_deg = settings.content.fov_deg
    wanted = scene_pictures(settings, believed, eyes_m)

    def solved(stack: PanelStack) -> U8:
        return layers_for(wanted, stack, eyes_m, settings=settings, model=model, fov_deg=fov_deg)

    def registered(stack: PanelStack, matrices: F64) -> float:
        shown = corrected(solved(stack), list(matrices))
        return seen_db(shown, wanted, eyes_m, replace(stack, tilt=None), panels, fov_deg=fov_deg)

    parallel = replace(found.stack, tilt=None)
    ideal = tuple(PlacedPanel(np.eye(3), np.array([x, 0.0, 0.0])) for x in found.stack.x_m)
    seen = {
        "perfect stack": seen_db(solved(parallel), wanted, eyes_m, parallel, ideal, fov_deg=fov_deg),
        "as configured": seen_db(solved(believed), wanted, eyes_m, believed, panels, fov_deg=fov_deg),
        "registered": registered(found.stack, found.homographies),
    }
    if truth is not None:
        stack = geometry_of(truth, believed, eye_m=found.eye_m, even=even, reference=found.bundle.reference)
        seen["registered without error"] = registered(stack, homographies(truth, stack, found.eye_m))
    return seen
