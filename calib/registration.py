"""Where the panels really are: a homography per panel from vernier settings, with its uncertainty.

`true_from_ideal` of a panel takes the pixel at which a point of a perfectly mounted panel would lie to the pixel
that really lies there (the homography of the panels' configuration). It is held as the displacement of the panel's
four corners, eight numbers in pixels, so that the fit and its covariance are well scaled.

What verniers cannot tell is where all panels are together: one panel is the reference, at its ideal place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares

from runtime.optics.rpu import image_from_panel_four_points
from runtime.optics.stack import PanelStack
from runtime.optics.views import relative_scale_shift
from runtime.records import F64

VIEWPOINT_SIGMA_M = 0.002  # of a marked viewpoint, each axis
SETTING_SIGMA_PX = 0.15  # of one vernier setting: assumed until the residuals say otherwise
CONDITION_LIMIT = 1e6


@dataclass(frozen=True, slots=True)
class Setting:
    """One vernier, nudged until its halves met for an eye."""

    reference: int  # panel that shows the fixed half
    panel: int  # panel that shows the moved half
    eye_m: tuple[float, float, float]  # frame `stack`
    reference_px: tuple[float, float]  # true pixel (u, v) of the fixed half
    panel_px: tuple[float, float]  # true pixel of the moved half when they met


@dataclass(frozen=True, slots=True)
class Registration:
    """Where one panel is."""

    true_from_ideal: F64  # (3, 3), last entry 1
    corners_px: F64  # (4, 2) displacement of the corners (0, 0), (W, 0), (W, H), (0, H)
    setting_covariance: F64  # (8, 8) of the corners, px², from the scatter of the settings
    viewpoint_covariance: F64  # (8, 8) from not knowing the viewpoint better than `VIEWPOINT_SIGMA_M`
    settings: int

    @property
    def setting_sigma_px(self) -> float:
        """RMS uncertainty of a corner's place from the settings' scatter."""
        return float(np.sqrt(np.trace(self.setting_covariance) / 4))

    @property
    def viewpoint_sigma_px(self) -> float:
        """The same from the viewpoint: a shift that every setting from one place shares."""
        return float(np.sqrt(np.trace(self.viewpoint_covariance) / 4))


@dataclass(frozen=True, slots=True)
class StackRegistration:
    """All panels, and how well the settings fit."""

    panels: tuple[Registration, ...]  # rear to front
    reference: int
    residual_px: F64  # (K, 2)
    sigma_px: float  # of one coordinate of a setting


def true_from_ideal(corners_px: F64, *, width_px: int, height_px: int) -> F64:
    """3x3 homography from the displacement (4, 2) of a panel's corners. Raises ValueError for degenerate ones."""
    ideal = np.array([[0, 0], [width_px, 0], [width_px, height_px], [0, height_px]], dtype=np.float64)
    return image_from_panel_four_points(ideal + corners_px, width_px=width_px, height_px=height_px)


def through(matrix: F64, points_px: F64) -> F64:
    """(K, 2) pixels through a 3x3 homography."""
    moved = points_px @ matrix[:, :2].T + matrix[:, 2]
    return moved[:, :2] / moved[:, 2:]


def _inverse(matrix: F64) -> F64:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def ideal_partner(points_px: F64, eye_m: ArrayLike, stack: PanelStack, *, reference: int, panel: int) -> F64:
    """(K, 2) ideal pixels of `panel` behind or before ideal pixels (K, 2) of `reference`, as one eye sees them."""
    scale, shift = relative_scale_shift(eye_m, from_x_m=stack.x_m[reference], to_x_m=stack.x_m[panel])
    source, target = stack.panel(reference), stack.panel(panel)
    plane = through(source.plane_from_raster(), points_px) * scale + shift
    return through(target.raster_from_plane(), plane)


def register(settings: Sequence[Setting], stack: PanelStack, *, reference: int) -> StackRegistration:
    """Fit every panel but the reference to all settings at once (Levenberg-Marquardt, linear loss).

    Raises ValueError, saying which panel, where the settings do not determine it.
    """
    moving = [index for index in range(stack.count) if index != reference]
    _refuse_too_few(settings, stack, moving)
    groups = _grouped(settings)

    def residuals(parameters: F64, eye_offset_m: F64 | None = None) -> F64:
        matrices = _matrices(parameters, stack, moving)
        found = np.empty((len(settings), 2))
        for (eye, first, second), (index, first_px, second_px) in groups.items():
            place = np.array(eye) if eye_offset_m is None else np.array(eye) + eye_offset_m
            ideal = through(_inverse(matrices[first]), first_px)
            partner = ideal_partner(ideal, place, stack, reference=first, panel=second)
            found[index] = through(matrices[second], partner) - second_px
        return found.ravel()

    fit = least_squares(residuals, np.zeros(8 * len(moving)), method="trf", x_scale=1.0, xtol=1e-12, ftol=1e-14)
    values = np.linalg.svd(fit.jac, compute_uv=False)
    if values[-1] * CONDITION_LIMIT <= values[0]:
        raise ValueError("the settings lie too close together or on a line: some panel's corners are not determined")
    freedom = fit.jac.shape[0] - fit.jac.shape[1]
    sigma_px = float(np.sqrt((fit.fun**2).sum() / freedom)) if freedom > 0 else SETTING_SIGMA_PX
    inverse = np.linalg.pinv(fit.jac)
    setting = inverse @ inverse.T * sigma_px**2
    by_eye = _viewpoint_covariance(settings, fit.x, inverse, residuals)
    panels = []
    for index in range(stack.count):
        if index == reference:
            panels.append(Registration(np.eye(3), np.zeros((4, 2)), np.zeros((8, 8)), np.zeros((8, 8)), 0))
            continue
        part = slice(8 * moving.index(index), 8 * moving.index(index) + 8)
        corners = fit.x[part].reshape(4, 2)
        panels.append(
            Registration(
                true_from_ideal(corners, width_px=stack.width_px, height_px=stack.height_px),
                corners,
                setting[part, part],
                by_eye[part, part],
                sum(index in (s.reference, s.panel) for s in settings),
            )
        )
    return StackRegistration(tuple(panels), reference, fit.fun.reshape(-1, 2), sigma_px)


def _grouped(settings: Sequence[Setting]) -> dict[tuple[tuple[float, ...], int, int], tuple[F64, F64, F64]]:
    """Settings of one eye and one pair of panels: their rows, and (k, 2) pixels on either panel."""
    rows: dict[tuple[tuple[float, ...], int, int], list[int]] = {}
    for row, s in enumerate(settings):
        rows.setdefault((s.eye_m, s.reference, s.panel), []).append(row)
    return {
        key: (
            np.array(index),
            np.array([settings[row].reference_px for row in index], dtype=np.float64),
            np.array([settings[row].panel_px for row in index], dtype=np.float64),
        )
        for key, index in rows.items()
    }


def _matrices(parameters: F64, stack: PanelStack, moving: Sequence[int]) -> list[F64]:
    matrices = [np.eye(3)] * stack.count
    for number, index in enumerate(moving):
        corners = parameters[8 * number : 8 * number + 8].reshape(4, 2)
        matrices[index] = true_from_ideal(corners, width_px=stack.width_px, height_px=stack.height_px)
    return matrices


def _viewpoint_covariance(
    settings: Sequence[Setting], parameters: F64, inverse: F64, residuals: Callable[[F64, F64], F64]
) -> F64:
    """Covariance from each marked viewpoint's own error, shared by all that was set from it."""
    step_m = 1e-4
    covariance = np.zeros((len(parameters), len(parameters)))
    eyes = np.repeat([s.eye_m for s in settings], 2, axis=0)
    for eye in np.unique(eyes, axis=0):
        here = (eyes == eye).all(axis=1)
        for axis in range(3):
            offset = step_m * np.eye(3)[axis]
            slope = (residuals(parameters, offset) - residuals(parameters, -offset)) / (2 * step_m) * here
            moved = inverse @ slope * VIEWPOINT_SIGMA_M
            covariance += np.outer(moved, moved)
    return covariance


def _refuse_too_few(settings: Sequence[Setting], stack: PanelStack, moving: Sequence[int]) -> None:
    for index in moving:
        count = sum(index in (s.reference, s.panel) for s in settings)
        if count < 4:
            raise ValueError(f"panel {index} has {count} settings: at least 4 are needed")


@dataclass(frozen=True, slots=True)
class Parts:
    """A registration in words a person can use, about the panel's middle."""

    shift_px: tuple[float, float]
    rotation_deg: float
    scale: tuple[float, float]
    keystone_px: float  # how far the corners are from where a similarity and a stretch would put them


def parts(matrix: F64, *, width_px: int, height_px: int) -> Parts:
    """Shift, rotation, scale and keystone of a homography near the identity."""
    middle = np.array([[width_px / 2, height_px / 2]])
    corners = np.array([[0, 0], [width_px, 0], [width_px, height_px], [0, height_px]], dtype=np.float64)
    shift = (through(matrix, middle) - middle)[0]
    arms, moved = corners - middle, through(matrix, corners) - through(matrix, corners).mean(axis=0)
    affine = np.linalg.lstsq(arms, moved, rcond=None)[0].T
    left, values, right = np.linalg.svd(affine)
    rotation = left @ right
    stretch = right.T @ np.diag(values) @ right
    return Parts(
        (float(shift[0]), float(shift[1])),
        float(np.degrees(np.arctan2(rotation[1, 0], rotation[0, 0]))),
        (float(stretch[0, 0]), float(stretch[1, 1])),
        float(np.abs(moved - arms @ affine.T).max()),
    )


def error_over_panel_px(found: F64, truth: F64, *, width_px: int, height_px: int) -> F64:
    """(N,) distance between two homographies at an even grid of a panel's points, pixels."""
    u, v = np.meshgrid(np.linspace(0, width_px, 17), np.linspace(0, height_px, 10))
    points = np.column_stack([u.ravel(), v.ravel()])
    apart_px: F64 = np.linalg.norm(through(found, points) - through(truth, points), axis=1)
    return apart_px
