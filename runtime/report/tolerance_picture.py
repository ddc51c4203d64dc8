"""Picture of what an eye sees through real panels."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from runtime.optics.pupil import PUPIL_MM
from runtime.optics.real.panels import RealPanels
from runtime.optics.real.trace import Tables, crossings
from runtime.optics.views import image_from_camera, stack_from_eye
from runtime.records import F32
from runtime.report.page import Figure, drawing, png
from runtime.report.tolerance import Subject

CROP_PX = (160, 120)  # width and height of the part in the middle of the left eye's picture that is shown
RAYS_PASSED = 18  # rays per pixel that pass all panels, about


def seen_through(
    subject: Subject, real: RealPanels, rays: int = RAYS_PASSED, size_px: tuple[int, int] = CROP_PX
) -> F32:
    """Return a crop of what the left eye sees through panels, relative to full white, from 0 to 1."""
    pair, random = subject.pair, np.random.default_rng(2)
    stack, eye_m, pose = pair.stack, pair.eyes_m[0], stack_from_eye(pair.eyes_m[0])
    height, width = pair.images[0].shape[:2]
    focal_px = image_from_camera(width_px=width, height_px=height, fov_deg=pair.fov_deg)[0, 0]
    columns, rows = min(size_px[0], width), min(size_px[1], height)
    corner = np.array([(height - rows) // 2, (width - columns) // 2])
    v, u = np.mgrid[0:rows, 0:columns].reshape(2, -1) + corner[:, None]
    tables, light, white = Tables(subject.layers, stack, real), np.zeros((len(u), 3)), np.zeros((len(u), 3))
    for _ in range(math.ceil(rays / real.optics.passed)):
        place = random.random((2, len(u)))
        radius = PUPIL_MM / 2e3 * np.sqrt(random.random(len(u)))
        angle = 2 * np.pi * random.random(len(u))
        start_m = eye_m + np.outer(radius * np.cos(angle), pose[:3, 0]) + np.outer(radius * np.sin(angle), pose[:3, 1])
        gaze = np.stack([u + place[0] - width / 2, height / 2 - v - place[1]], -1) / focal_px
        gaze = gaze @ pose[:3, :2].T - pose[:3, 2]
        middle_m = eye_m + gaze * ((stack.x_m[stack.count // 2] - eye_m[0]) / gaze[:, :1])
        both = tables.light(crossings(start_m, middle_m, stack, real, random), float(eye_m[0]))
        light, white = light + both[0], white + both[1]
    veil = real.lighting.veil
    seen = (light / white.mean(axis=0) + veil) / (1 + veil)
    return np.asarray(seen.reshape(rows, columns, 3).clip(0, 1), np.float32)


def seen_figure(subject: Subject, panels: Sequence[tuple[str, RealPanels]]) -> Figure:
    """Return a figure of what the left eye sees through each of the named panels."""
    with drawing(12.0, 3.2) as figure:
        for axes, (name, real) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            axes.imshow(seen_through(subject, real), interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.set_title(name, fontsize=10)
        return Figure("seen-left", png(figure), "The middle of what the left eye sees.")
