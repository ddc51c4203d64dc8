"""The closed-form filter: each spatial frequency of the two-eye problem solved on its own, by Tikhonov's rule.

On the middle panel's plane, seen along the rays of the point between the eyes, an eye sees panel n shifted by
s = (e - middle)·t/(1 - t), t = (x_n - x_plane)/(middle_x - x_plane), in y and z. Per frequency k that is the
2xN matrix A of exp(i·k·s), and the least panel values are A^H·(A·A^H + eps)^-1 times what the eyes should see.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from runtime.optics.malus import Branch, phase_from_intensity
from runtime.optics.retina import sample_bilinear
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_raster, image_from_stack, relative_scale_shift
from runtime.records import F32, F64
from runtime.report.baselines import START

EPSILON = 0.03
LEAST_MARGIN_PX = 16


def filtered_layers(
    eyes_m: ArrayLike,
    wanted: Sequence[F32],
    stack: PanelStack,
    *,
    fov_deg: float,
    steps: int = 1,
    epsilon: float = EPSILON,
    branch: Branch = 2,
) -> F32:
    """Layers by the filter, and again on what is left, `steps` times.

    wanted: per eye (h, w, C) intensities in [0, 1]. Returns (N, height_px, width_px, C) panel values in [0, 1].
    Exact for eyes at one distance; borders wrap around beyond a margin of continued edges.
    """
    eyes = np.asarray(eyes_m, dtype=np.float64)
    plane = stack.panel(stack.count // 2)
    targets = [_on_plane(eye, image, plane, fov_deg=fov_deg, branch=branch) for eye, image in zip(eyes, wanted)]
    layers = np.full((stack.count, *targets[0].shape), START, np.float32)
    for _ in range(steps):
        left = [t - _seen(eye, layers, stack, plane) for eye, t in zip(eyes, targets)]
        for index, aligned in enumerate(_solved(eyes, left, stack, plane, epsilon=epsilon)):
            layers[index] += _to_panel(eyes.mean(axis=0), aligned, stack, plane, index=index)
        np.clip(layers, 0, 1, out=layers)
    return layers


def _grid(plane: PlaneRaster) -> tuple[F64, F64]:
    u = np.arange(plane.width_px, dtype=np.float64) + 0.5
    v = np.arange(plane.height_px, dtype=np.float64)[:, None] + 0.5
    return np.asarray(u, np.float64), np.asarray(v, np.float64)


def _on_plane(eye_m: F64, image: F32, plane: PlaneRaster, *, fov_deg: float, branch: Branch) -> F32:
    """An eye's target phases on the plane's pixels."""
    height, width = image.shape[:2]
    h = image_from_raster(image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg), plane)
    u, v = _grid(plane)
    weight = h[2, 0] * u + h[2, 1] * v + h[2, 2]
    x, y = (((row[0] * u + row[1] * v + row[2]) / weight).astype(np.float32) for row in h[:2])
    return sample_bilinear(phase_from_intensity(image.astype(np.float32), branch), u=x, v=y)


def _axis_aligned(plane: PlaneRaster, *, scale: float, shift_m: F64) -> tuple[F32, F32]:
    """Where the plane's pixels go under q = p·scale + shift, on a raster of the same extent; u and v, (h, w)."""
    u, v = _grid(plane)
    y = (plane.left_m + u * plane.pitch_u_m) * scale + shift_m[0]
    z = (plane.top_m - v * plane.pitch_v_m) * scale + shift_m[1]
    a, b = np.broadcast_arrays((y - plane.left_m) / plane.pitch_u_m, (plane.top_m - z) / plane.pitch_v_m)
    return a.astype(np.float32), b.astype(np.float32)


def _seen(eye_m: F64, layers: F32, stack: PanelStack, plane: PlaneRaster) -> F32:
    """Phase sums along an eye's rays through the plane's pixels."""
    total = np.zeros(layers.shape[1:], np.float32)
    for index, layer in enumerate(layers):
        scale, shift_m = relative_scale_shift(eye_m, from_x_m=plane.x_m, to_x_m=stack.x_m[index])
        u, v = _axis_aligned(plane, scale=scale, shift_m=shift_m)
        total += sample_bilinear(layer, u=u, v=v)
    return total


def _to_panel(middle_m: F64, aligned: F32, stack: PanelStack, plane: PlaneRaster, *, index: int) -> F32:
    """A picture on the plane carried to a panel along the rays of the point between the eyes."""
    scale, shift_m = relative_scale_shift(middle_m, from_x_m=stack.x_m[index], to_x_m=plane.x_m)
    u, v = _axis_aligned(plane, scale=scale, shift_m=shift_m)
    return sample_bilinear(aligned, u=u, v=v)


def _solved(eyes_m: F64, left: Sequence[F32], stack: PanelStack, plane: PlaneRaster, *, epsilon: float) -> list[F32]:
    """Per panel what to add, on the plane, for what two eyes lack there."""
    from scipy import fft

    middle = eyes_m.mean(axis=0)
    t = (np.array(stack.x_m) - plane.x_m) / (middle[0] - plane.x_m)
    shifts_m = (eyes_m - middle)[:, None, 1:] * (t / (1 - t))[None, :, None]  # (eye, panel, y and z)
    shifts_px = shifts_m / [plane.pitch_u_m, -plane.pitch_v_m]
    margin = LEAST_MARGIN_PX + int(np.ceil(2 * np.abs(shifts_px).max()))
    margin = min(margin, plane.width_px // 2, plane.height_px // 2)
    padded = [np.pad(image, ((margin, margin), (margin, margin), (0, 0)), mode="edge") for image in left]
    height, width = padded[0].shape[:2]
    size = (fft.next_fast_len(height, real=True), fft.next_fast_len(width, real=True))
    first, second = (fft.rfft2(image, size, axes=(0, 1), workers=2) for image in padded)
    ku = 2 * np.pi * fft.rfftfreq(size[1])
    kv = 2 * np.pi * fft.fftfreq(size[0])[:, None]
    # (eye, panel) transfer: the eye sees the panel's picture moved by its shift.
    waves = [[np.exp(1j * (ku * s[0] + kv * s[1])).astype(np.complex64) for s in eye] for eye in shifts_px]
    cross = sum(a * b.conj() for a, b in zip(*waves, strict=True))
    diagonal = np.float32(stack.count + epsilon)
    factor = 1 / (diagonal**2 - np.abs(cross) ** 2)
    one = ((diagonal * first - cross[..., None] * second) * factor[..., None]).astype(np.complex64)
    other = ((diagonal * second - cross.conj()[..., None] * first) * factor[..., None]).astype(np.complex64)
    answers = []
    for a, b in zip(*waves, strict=True):
        spectrum = a.conj()[..., None] * one + b.conj()[..., None] * other
        picture = fft.irfft2(spectrum, size, axes=(0, 1), workers=2)
        inner = picture[margin : margin + plane.height_px, margin : margin + plane.width_px]
        answers.append(np.ascontiguousarray(inner, dtype=np.float32))
    return answers
