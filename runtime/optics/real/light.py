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
from runtime.optics.real.trace import Ints, Tables, crossings, moments
from runtime.optics.retina import checked_eye
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_camera, stack_from_eye
from runtime.records import F32, F64, U8, Eyes

BATCH = 1 << 15  # rays traced at the same time, about; their arrays fit in a core's cache
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

    step: int = 1  # one pixel of each square of `step` by `step` pixels
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
            eye = _Eye(eye_m, seen_from_m + move, target, sight.fov_deg)
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
    target: U8 | F32
    fov_deg: float


@dataclass(frozen=True, slots=True)
class _View:
    """Light that an eye sees at the sampled pixels. Only pixels that count are included."""

    light: F32  # (sets, P, 3)
    white: F32  # (sets, P, 3) its view of white panels
    target: F32  # (P, 3)
    mask: F32  # (pixels,) 1 for a pixel that counts

    def errors(self, white: F64, veil: float) -> F32:
        """Return the squared errors (P, 3), given full white per band and the room light's share."""
        first, second = (self.light / white.astype(np.float32) + np.float32(veil)) / np.float32(1 + veil) - self.target
        return np.asarray(first * second)


def _chosen_pixels(height: int, width: int, step: int, random: np.random.Generator) -> tuple[Ints, Ints]:
    """Return the rows and columns of a pixel at random from each square of `step` pixels. Evenly spaced pixels would
    meet moiré at some of its phases only.
    """
    corners = np.mgrid[0:height:step, 0:width:step].reshape(2, -1)
    rows, columns = corners + (random.integers(step, size=corners.shape) if step > 1 else 0)
    inside = (rows < height) & (columns < width)
    return rows[inside], columns[inside]


def _view(
    tables: Tables, eye: _Eye, sampling: RealSampling, random: np.random.Generator, scattering: np.random.Generator
) -> _View:
    stack, real = tables.stack, tables.real
    height, width = eye.target.shape[:2]
    rows, columns = _chosen_pixels(height, width, sampling.step, random)
    v, u = rows + 0.5, columns + 0.5
    checked_eye(eye.seen_from_m, stack)
    pose = stack_from_eye(checked_eye(eye.solved_for_m, stack))
    middle_x = stack.x_m[stack.count // 2]
    focal_px = image_from_camera(width_px=width, height_px=height, fov_deg=eye.fov_deg)[0, 0]
    lags = moments(stack, real.timing)[0]
    mask = np.ones(len(u), bool)
    lights, whites = [], []
    corners = np.stack(np.meshgrid(np.arange(sampling.rays), np.arange(sampling.rays)), -1).reshape(-1, 2)
    together = max(1, BATCH // max(len(u), 1))  # rays of a pixel that are traced at the same time
    for _ in range(SETS):
        light, white = np.zeros((len(u), 3), np.float32), np.zeros((len(u), 3), np.float32)
        for first in range(0, len(corners), together):
            corner = corners[first : first + together, :, None]
            drawn = random.random((len(corner), 4, len(u)))
            place = (corner + drawn[:, :2]) / sampling.rays - 0.5
            radius, angle = sampling.pupil_mm / 2e3 * np.sqrt(drawn[:, 2]).ravel(), 2 * math.pi * drawn[:, 3].ravel()
            pupil = np.outer(radius * np.cos(angle), pose[:3, 0]) + np.outer(radius * np.sin(angle), pose[:3, 1])
            gaze = np.stack([u + place[:, 0] - width / 2, height / 2 - v - place[:, 1]], -1).reshape(-1, 2) / focal_px
            gaze = gaze @ pose[:3, :2].T - pose[:3, 2]
            through = eye.solved_for_m + gaze * ((middle_x - eye.solved_for_m[0]) / gaze[:, :1])
            start = eye.seen_from_m + pupil
            if not lags.is_none:
                late = lags.starts(0.5 - through[:, 2] / stack.height_m).min(axis=0)
                start = start + np.outer(late * real.timing.step_m, [0.0, 1.0, 0.0])
            crossed = crossings(start, through, stack, real, scattering)
            inside = (crossed.u > 0.5).all(0) & (crossed.u < stack.width_px - 0.5).all(0)
            inside &= (crossed.v > 0.5).all(0) & (crossed.v < stack.height_px - 0.5).all(0)
            mask &= inside.reshape(-1, len(u)).all(0)
            part, white_part = tables.light(crossed, float(eye.seen_from_m[0]))
            light += part.reshape(-1, len(u), 3).sum(axis=0)
            white += np.broadcast_to(white_part, part.shape).reshape(-1, len(u), 3).sum(axis=0)
        lights.append(light)
        whites.append(white)
    rays = np.float32(sampling.rays**2)
    return _View(
        np.stack([light / rays for light in lights])[:, mask],
        np.stack([white / rays for white in whites])[:, mask],
        intensities(eye.target[rows, columns][mask]),
        mask.astype(np.float32),
    )
