"""Slow, exact reference for splats in float64, one at a time. Shares no code with the product."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y


def harmonics(direction: np.ndarray, count: int) -> np.ndarray:
    """Real spherical harmonics without the Condon-Shortley phase, then the reference implementation's signs."""
    polar, azimuth = np.arccos(np.clip(direction[2], -1, 1)), np.arctan2(direction[1], direction[0])
    values = []
    for degree in range(int(np.sqrt(count))):
        for order in range(-degree, degree + 1):
            complex_value = sph_harm_y(degree, abs(order), polar, azimuth)
            if order == 0:
                value = complex_value.real
            else:
                # scipy's carries (-1)^m; the reference implementation's odd orders are negative, which is the same.
                value = np.sqrt(2) * (complex_value.real if order > 0 else complex_value.imag)
            values.append(value)
    return np.array(values)


def render(
    centres: np.ndarray,
    scales: np.ndarray,
    quaternions: np.ndarray,
    opacities: np.ndarray,
    coefficients: np.ndarray,
    *,
    stack_from_scene: np.ndarray,
    projection: np.ndarray,
    eye: np.ndarray,
    width: int,
    height: int,
    background: tuple[float, float, float],
) -> np.ndarray:
    """(h, w, 3) float intensities, front to back with transmittance, without early stopping."""
    linear, shift = stack_from_scene[:3, :3], stack_from_scene[:3, 3]
    rotation = linear / np.cbrt(np.linalg.det(linear))
    rows, columns = np.mgrid[0:height, 0:width] + 0.5
    items = []
    for centre, scale, quaternion, opacity, coefficient in zip(
        centres, scales, quaternions, opacities, coefficients, strict=True
    ):
        place = linear @ centre + shift
        u, v, w = projection @ np.append(place, 1.0)
        if w <= 1e-3:
            continue
        turn = Rotation.from_quat(np.roll(quaternion, -1)).as_matrix()
        covariance = linear @ turn @ np.diag(scale**2) @ turn.T @ linear.T
        jacobian = np.array(
            [projection[0, :3] * w - projection[2, :3] * u, projection[1, :3] * w - projection[2, :3] * v]
        )
        jacobian /= w**2
        flat = jacobian @ covariance @ jacobian.T + 0.3 * np.eye(2)
        direction = rotation.T @ ((place - eye) / np.linalg.norm(place - eye))
        colour = np.maximum(0.5 + harmonics(direction, len(coefficient)) @ coefficient, 0)
        items.append((w, np.array([u, v]) / w, flat, opacity, colour))
    picture, transmittance = np.zeros((height, width, 3)), np.ones((height, width))
    for _, centre, flat, opacity, colour in sorted(items, key=lambda item: item[0]):
        if opacity < 1 / 255:
            continue
        # Beyond this box the splat's alpha is below 1/255 everywhere: skipping it changes no pixel.
        half = np.sqrt(2 * np.log(255 * opacity) * np.diag(flat)) + 1
        low, high = np.clip([centre - half, centre + half + 1], 0, [width, height]).astype(int)
        area = np.s_[low[1] : high[1], low[0] : high[0]]
        dx, dy = columns[area] - centre[0], rows[area] - centre[1]
        inverse = np.linalg.inv(flat)
        power = -0.5 * (inverse[0, 0] * dx**2 + 2 * inverse[0, 1] * dx * dy + inverse[1, 1] * dy**2)
        alpha = np.minimum(0.99, opacity * np.exp(power))
        alpha[alpha < 1 / 255] = 0
        picture[area] += (transmittance[area] * alpha)[..., None] * colour
        transmittance[area] *= 1 - alpha
    return picture + transmittance[..., None] * np.array(background)
