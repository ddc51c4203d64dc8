"""Light PSNR of layers that real panels show (docs/contracts.md, Error)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from runtime.optics.carried import intensities
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.quality import psnr_db
from runtime.optics.real.panels import RealPanels
from runtime.optics.real.trace import Tables, crossings, moments
from runtime.optics.retina import checked_eye
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_camera, stack_from_eye
from runtime.records import F32, F64, U8, Eyes

SETS = 2  # independent sets of rays; the squared error is the product of their errors


@dataclass(frozen=True, slots=True)
class Sight:
    """Targets for the viewers' eyes, and the eyes' positions."""

    eyes_m: Eyes  # (V, 3) eyes that the layers were solved for, frame `stack`
    targets: tuple[U8 | F32, ...]  # (h, w, 3) the eyes' pictures
    fov_deg: float  # the pictures' horizontal field of view
    sigma_mm: float = 1.0  # standard deviation of the tracking error along each axis
    seen_from_m: F64 | None = None  # (V, 3) true eyes; by default `eyes_m`


class RealSampling(NamedTuple):
    """Choice of the rays."""

    step: int = 1  # every `step`-th pixel of every `step`-th row
    rays: int = 2  # rays across and down a pixel, in each of two sets
    pupil_mm: float = PUPIL_MM
    seed: int = 1
    thinned: bool = False  # at displaced eyes, only a quarter of the pixels is measured


class RealLight(NamedTuple):
    """Light that reaches the eyes through real panels."""

    error: float  # mean squared error of the light, relative to full white as the eyes see it on average
    brightness: float  # full white's luminance, as a share of ideal panels'
    tint: tuple[float, float, float]  # each band's full white, divided by their mean

    @property
    def light_db(self) -> float:
        return psnr_db(self.error)


def real_light(layers: U8, stack: PanelStack, real: RealPanels, sight: Sight, sampling: RealSampling) -> RealLight:
    """Measure layers on real panels, relative to full white, averaged over the picture in each band. Eyes
    and cameras adapt to a darker or tinted display, but not to dark corners or moiré. Raises ValueError if an eye is
    not in front of every panel, no pixel counts, or `real` does not fit the stack.
    """
    real.check(stack.count)
    tables = Tables(layers, stack, real)
    true_m = sight.eyes_m if sight.seen_from_m is None else sight.seen_from_m
    random = np.random.default_rng(sampling.seed)
    scattering = np.random.default_rng(sampling.seed + 1)
    views, whites, counted = [], np.zeros(3), 0
    for weight, move in _moves(sight):
        for eye_m, seen_from_m, target in zip(sight.eyes_m, true_m, sight.targets, strict=True):
            eye = _Eye(eye_m, seen_from_m + move, intensities(target), sight.fov_deg)
            chosen = sampling._replace(step=2 * sampling.step) if sampling.thinned and move.any() else sampling
            view = _view(tables, eye, chosen, random, scattering)
            views.append((weight, view))
            whites += view.white.sum(axis=(0, 1))
            counted += SETS * int(view.mask.sum())
    if not counted:
        raise ValueError("no ray from these eyes crosses every panel")
    white = whites / counted
    total = 0.0
    eyes = len(sight.eyes_m)
    for start in range(0, len(views), eyes):  # all eyes of one move
        errors = [view.errors(white, real.lighting.veil) for _, view in views[start : start + eyes]]
        total += views[start][0] * float(np.concatenate(errors).mean())
    mean = float(white.mean())
    tint = tuple(float(part) for part in white / mean)
    return RealLight(total, mean, (tint[0], tint[1], tint[2]))


def _moves(sight: Sight) -> Iterator[tuple[float, F64]]:
    """Return the weights and displacements (3,) of five eye positions that represent the tracking error."""
    yield (0.5 if sight.sigma_mm else 1.0), np.zeros(3)
    if sight.sigma_mm:
        right = stack_from_eye(sight.eyes_m.mean(axis=0))[:3, 0]
        for axis in (right, np.array([0.0, 0.0, 1.0])):
            for side in (-1, 1):
                yield 0.125, side * 2e-3 * sight.sigma_mm * axis


class _Eye(NamedTuple):
    solved_for_m: Eyes
    seen_from_m: F64
    target: F32
    fov_deg: float


@dataclass(frozen=True, slots=True)
class _View:
    """Light that an eye sees at the sampled pixels. Only pixels that count are included."""

    light: F32  # (sets, P, 3)
    white: F32  # (sets, P, 3) what it would see of white panels
    target: F32  # (P, 3)
    mask: F32  # (pixels,) 1 for a pixel that counts

    def errors(self, white: F64, veil: float) -> F32:
        """Return the squared errors (P, 3), given full white per band and the room light's share."""
        first, second = (self.light / white.astype(np.float32) + np.float32(veil)) / np.float32(1 + veil) - self.target
        return np.asarray(first * second)


def _view(
    tables: Tables, eye: _Eye, sampling: RealSampling, random: np.random.Generator, scattering: np.random.Generator
) -> _View:
    stack, real = tables.stack, tables.real
    height, width = eye.target.shape[:2]
    rows, columns = np.mgrid[sampling.step // 2 : height : sampling.step, sampling.step // 2 : width : sampling.step]
    v, u = rows.ravel() + 0.5, columns.ravel() + 0.5
    checked_eye(eye.seen_from_m, stack)
    pose = stack_from_eye(checked_eye(eye.solved_for_m, stack))
    middle_x = stack.x_m[stack.count // 2]
    focal_px = image_from_camera(width_px=width, height_px=height, fov_deg=eye.fov_deg)[0, 0]
    lags = moments(stack, real.timing)[0]
    mask = np.ones(len(u), bool)
    lights, whites = [], []
    for _ in range(SETS):
        light, white = np.zeros((len(u), 3), np.float32), np.zeros((len(u), 3), np.float32)
        for down in range(sampling.rays):
            for along in range(sampling.rays):
                place = (np.array([along, down])[:, None] + random.random((2, len(u)))) / sampling.rays - 0.5
                radius = sampling.pupil_mm / 2e3 * np.sqrt(random.random(len(u)))
                angle = 2 * math.pi * random.random(len(u))
                pupil = np.outer(radius * np.cos(angle), pose[:3, 0]) + np.outer(radius * np.sin(angle), pose[:3, 1])
                gaze = np.stack([(u + place[0] - width / 2) / focal_px, (height / 2 - v - place[1]) / focal_px], -1)
                gaze = gaze @ pose[:3, :2].T - pose[:3, 2]
                through = eye.solved_for_m + gaze * ((middle_x - eye.solved_for_m[0]) / gaze[:, :1])
                start = eye.seen_from_m + pupil
                if not lags.is_none:
                    late = lags.starts(0.5 - through[:, 2] / stack.height_m).min(axis=0)
                    start = start + np.outer(late * real.timing.step_m, [0.0, 1.0, 0.0])
                crossed = crossings(start, through, stack, real, scattering)
                mask &= (crossed.u > 0.5).all(0) & (crossed.u < stack.width_px - 0.5).all(0)
                mask &= (crossed.v > 0.5).all(0) & (crossed.v < stack.height_px - 0.5).all(0)
                part, white_part = tables.light(crossed, float(eye.seen_from_m[0]))
                light += part
                white += white_part
        lights.append(light)
        whites.append(white)
    rays = np.float32(sampling.rays**2)
    return _View(
        np.stack([light / rays for light in lights])[:, mask],
        np.stack([white / rays for white in whites])[:, mask],
        eye.target[rows.ravel(), columns.ravel()][mask],
        mask.astype(np.float32),
    )
