"""Photographs for tests: simulated pictures, and points alone where pictures would only take time."""

from __future__ import annotations

import cv2
import numpy as np

from calib.board import marks
from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, stack_from_pixels
from calib.simulator import Lens, by_hand, phone
from runtime.optics.stack import PanelStack


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
        counts, edge_bits=0.5, unit_px=5.0, extents=(1.0,) * stack.count, mirrored=(0,) * stack.count,
    )  # fmt: skip


def photographed(
    stack: PanelStack,
    panels: tuple[PlacedPanel, ...],
    *,
    count: int,
    noise_px: float,
    random: np.random.Generator,
    poses: list[np.ndarray] | None = None,
) -> tuple[list[SeenMarks], Lens]:
    """Points of `count` photographs by hand, with one phone."""
    lens = phone(random=random)
    chosen = by_hand(count, stack, random=random) if poses is None else poses
    return [
        points_of(stack, panels, lens, pose, name=f"{number + 1}.jpg", noise_px=noise_px, random=random)
        for number, pose in enumerate(chosen)
    ], lens
