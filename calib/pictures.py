"""Pictures and layers to judge panels with: the configured scene, or two image files, through a model."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from runtime.config import Settings
from runtime.content.base import View
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8
from runtime.support.artifacts import read_image
from runtime.support.gl import offscreen_context


def scene_pictures(settings: Settings, stack: PanelStack, eyes_m: F64) -> tuple[U8, U8]:
    """(h, w, 4) what a left and a right eye (2, 3) should see of the configured scene. Raises InputError."""
    content = open_content(settings.content, stack, offscreen_context(), limits=settings.limits)
    try:
        found = []
        for side, eye_m in enumerate(eyes_m):
            projection = image_from_stack(
                eye_m, width_px=stack.width_px, height_px=stack.height_px, fov_deg=settings.content.fov_deg
            )
            view = View(eye_m, side, projection, stack.width_px, stack.height_px)
            found.append(content.render(view, time_ns=0).copy())
    finally:
        content.close()
    return found[0], found[1]


def file_pictures(paths: tuple[Path, Path]) -> tuple[U8, U8]:
    """(h, w, 3) two image files of one size. Raises InputError."""
    left, right = read_image(paths[0]), read_image(paths[1])
    if left.shape != right.shape:
        raise InputError(paths[1], "", "is not of the left picture's size")
    return left, right


def layers_for(
    pictures: tuple[U8, U8], stack: PanelStack, eyes_m: F64, *, settings: Settings, model: str, fov_deg: float
) -> U8:
    """(N, H, W, 4) what a model makes of two pictures. Raises InputError, MissingPart."""
    predictor = load_predictor(model, stack, settings.model)
    try:
        prediction = solve_still(pictures[0], pictures[1], eyes_m=eyes_m, fov_deg=fov_deg, predictor=predictor)
        return np.array(prediction.layers)
    finally:
        predictor.close()
