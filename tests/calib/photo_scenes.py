"""Photographs for tests: simulated pictures, and points alone where pictures would only take time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from calib.board import board, marks
from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, corner_pixels, stack_from_pixels, through
from calib.registration import Registration, homographies
from calib.simulator import Exposure, Lens, Scene, by_hand, camera_rays, phone, photograph
from runtime.optics.stack import PanelStack

PHONE_MEGAPIXELS = 12.0
HALF_WIDTH_95 = 1.959964


@dataclass(frozen=True)
class Errors:
    """What a registration is off by, in the frame of the reference panel."""

    pixels: np.ndarray  # (K,) distance over an even grid of points of every panel but the reference
    gap_m: np.ndarray  # (N-1,)
    inside_95: Any  # (M,) which of the stated 95% intervals hold the truth: gaps, then corners' coordinates


def in_frame_of(panels: tuple[PlacedPanel, ...], *, reference: int, reference_x_m: float) -> tuple[PlacedPanel, ...]:
    """The same panels in the frame that a registration has: of the reference panel, which lies at its ideal place."""
    turn = panels[reference].rotation.T
    middle, shift = panels[reference].centre_m, np.array([reference_x_m, 0.0, 0.0])
    return tuple(PlacedPanel(turn @ p.rotation, turn @ (p.centre_m - middle) + shift) for p in panels)


def errors_of(found: Registration, truth: tuple[PlacedPanel, ...]) -> Errors:
    """Compare with the true panels, in any frame."""
    stack, reference = found.stack, found.bundle.reference
    true = in_frame_of(truth, reference=reference, reference_x_m=stack.x_m[reference])
    matrices, corners = homographies(true, stack, found.eye_m), corner_pixels(stack)
    moving = [index for index in range(stack.count) if index != reference]
    off = np.stack([through(found.homographies[i], corners) - through(matrices[i], corners) for i in moving])
    gap_m = np.diff(found.stack.x_m) - np.diff([panel.axis_x_m for panel in true])
    inside = np.concatenate([
        np.abs(gap_m) <= HALF_WIDTH_95 * found.gap_sigma_m,
        (np.abs(off) <= HALF_WIDTH_95 * found.corner_sigma_px[moving]).ravel(),
    ])  # fmt: skip
    pixels = [error_over_panel_px(found.homographies[i], matrices[i], stack) for i in moving]
    return Errors(np.concatenate(pixels), gap_m, inside)


def error_over_panel_px(found: np.ndarray, truth: np.ndarray, stack: PanelStack) -> np.ndarray:
    """(K,) distance between two homographies at an even grid of a panel's points, pixels."""
    u, v = np.meshgrid(np.linspace(0, stack.width_px, 17), np.linspace(0, stack.height_px, 10))
    points = np.column_stack([u.ravel(), v.ravel()])
    return np.linalg.norm(through(found, points) - through(truth, points), axis=1)


def simulated_photographs(
    stack: PanelStack, truth: tuple[PlacedPanel, ...], *, count: int, megapixels: float, random: np.random.Generator
) -> list[np.ndarray]:
    """`count` photographs (h, w) by hand of the boards on a stack, with one phone of many."""
    layers = np.stack([board(stack, index) for index in range(stack.count)])
    lens = phone(random=random, size=float(np.sqrt(megapixels / PHONE_MEGAPIXELS)))
    scene, rays = Scene(stack, truth, layers), camera_rays(lens)
    poses = by_hand(count, stack, random=random)
    return [photograph(scene, lens, pose, Exposure(), random=random, rays=rays) for pose in poses]


def points_of(
    stack: PanelStack,
    panels: tuple[PlacedPanel, ...],
    lens: Lens,
    pose: np.ndarray,
    *,
    name: str,
    noise_px: float,
    random: np.random.Generator,
) -> SeenMarks:
    """What `find_marks` would find without a picture: every saddle that lies in it, with noise."""
    panel, panel_px, image_px = [], [], []
    for mark in marks(stack):
        points = np.column_stack([mark.saddles_px, np.ones(4)]) @ stack_from_pixels(panels[mark.panel], stack).T
        seen = cv2.projectPoints(
            points, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], lens.matrix, np.array(lens.distortion)
        )[0].reshape(-1, 2)
        if (seen > 0).all() and (seen < [lens.width_px, lens.height_px]).all():
            panel += [mark.panel] * 4
            panel_px.append(mark.saddles_px)
            image_px.append(seen + random.normal(size=(4, 2)) * noise_px)
    counts = tuple(panel.count(index) // 4 for index in range(stack.count))
    return SeenMarks(
        name, lens.width_px, lens.height_px, np.array(panel), np.concatenate(panel_px), np.concatenate(image_px),
        counts, fault="",
    )  # fmt: skip


def photographed(
    stack: PanelStack,
    panels: tuple[PlacedPanel, ...],
    *,
    count: int,
    noise_px: float,
    random: np.random.Generator,
    poses: list[np.ndarray] | None = None,
) -> list[SeenMarks]:
    """Points of `count` photographs by hand, with one phone."""
    lens = phone(random=random)
    chosen = by_hand(count, stack, random=random) if poses is None else poses
    return [
        points_of(stack, panels, lens, pose, name=f"{number + 1}.jpg", noise_px=noise_px, random=random)
        for number, pose in enumerate(chosen)
    ]
