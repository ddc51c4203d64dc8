"""Simultaneous steps along a still picture's own rays: layers improved for the rays that are really looked along.

The solver's pictures lie on the centre panel's pixels, but the rays of a picture's own pixels cross all panels anywhere
between those. What is lost by one interpolation in and three out, no step on the panels' pixels can see. These steps
(`compiled.phasors`) follow the picture's rays themselves and move all panels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from runtime.model.compiled.loops import TILE
from runtime.model.compiled.panels import show_panels
from runtime.model.compiled.phasors import INTENSITY, PhasorState, fill, rays_of
from runtime.model.contract import Places, Step
from runtime.model.reprojection import CENTRE, reprojection
from runtime.model.targets import SUBCODE, without_alpha
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_raster, stack_from_eye
from runtime.records import F64, U8
from runtime.support.threads import at_once

PLACES: Mapping[Places, Sequence[tuple[float, float]]] = {  # right and up, standard deviations
    "middle": ((0.0, 0.0),),
    "rising": ((1.0, 1.0), (-1.0, -1.0)),
    "falling": ((1.0, -1.0), (-1.0, 1.0)),
}
DRIFT_PX = 1 / 4  # no row of rays lies like the next one: to lay each exactly would take a third of a step
MAX_BEND_PX = 0.2  # of a row, from the parabola that the kernel takes for a tile of it
MIN_WEIGHT = 0.05  # of a homography, beside its middle's: what is nearer to the eye's own plane is not looked along


def refined(
    layers: U8,
    pictures: Sequence[U8],
    stack: PanelStack,
    *,
    eyes_m: F64,
    projections: Sequence[F64],
    eye_sigma_mm: float,
    steps: Sequence[Step],
    box: PixelRect,
    channels: int,
    threads: int,
) -> U8:
    """(3, H, W, 4): layers (3, H, W, 4), changed within a box of every panel by what the rays of two pictures (h, w, 4)
    see of them. projections: (3, 4) `image_from_stack` of each eye (2, 3). channels: 1 for grey pictures, or 3."""
    rasters = tuple(box.cut(stack.panel(n)) for n in range(stack.count))
    pictures_from_centre = [image_from_raster(projection, rasters[CENTRE]) for projection in projections]
    looked = _looked_through(pictures_from_centre, box, pictures[0].shape[:2])
    if looked is None:
        return layers
    to_picture = np.array([[1.0, 0.0, looked.u0], [0.0, 1.0, looked.v0], [0.0, 0.0, 1.0]])
    centre_from_rays = [np.linalg.inv(matrix) @ to_picture for matrix in pictures_from_centre]
    middle = np.array([looked.width_px / 2, looked.height_px / 2, 1.0])
    right, up = stack_from_eye(eyes_m.mean(axis=0))[:3, 0], np.array([0.0, 0.0, 1.0])

    def rays(step: Step) -> F64:
        found = []
        for across, down in PLACES[step.places] if eye_sigma_mm > 0 else PLACES["middle"]:
            moved_m = eye_sigma_mm / 1e3 * (across * right + down * up)
            for eye_m, centre in zip(eyes_m + moved_m, centre_from_rays, strict=True):
                between = [
                    np.eye(3) if n == CENTRE else reprojection(stack, rasters, eye_m, of=n, on=CENTRE)
                    for n in range(stack.count)
                ]
                seen = np.stack([matrix @ centre for matrix in between])
                found.append(seen / (seen[:, 2] @ middle)[:, None, None])
        return np.array(found)

    sizes = np.array([(box.height_px, box.width_px)] * 3 + [(looked.height_px, looked.width_px)])
    state = PhasorState(sizes, channels=channels, threads=threads)
    looks = [rays_of(rays(step), sizes) for step in steps]
    pixels = TILE // channels
    for look in looks:
        if max(bend_px(look.seen, looked.width_px, pixels), bend_px(look.back, box.width_px, pixels)) > MAX_BEND_PX:
            return layers
    begun = [(numbers, layer[box.slices], SUBCODE) for numbers, layer in zip(state.panels, layers, strict=True)]
    wanted = [
        (numbers, picture[looked.slices], INTENSITY) for numbers, picture in zip(state.targets, pictures, strict=True)
    ]
    at_once(lambda of: fill(of[0], without_alpha(of[1], channels), of[2]), [*begun, *wanted])
    state.start()
    for step, look in zip(steps, looks, strict=True):
        state.step(look, size=step.size, momentum=step.momentum, floor=step.floor, drift_px=DRIFT_PX)
    made = layers.copy()
    show_panels(dict(enumerate(state.last)), made, [box] * stack.count, channels=channels, threads=threads)
    return made


def bend_px(matrices: F64, width_px: int, tile_px: int) -> float:
    """How far from a parabola through its ends and its middle a tile of a row lies, pixels, at most.

    matrices: (..., 3, 3) from a raster so wide. An eye far aside sees rows whose scale changes by more than a parabola
    (which the kernel takes for a tile) can follow.
    """
    tile_px = min(tile_px, width_px)
    starts = np.linspace(0.0, width_px - tile_px, 9)
    u = starts[:, None] + tile_px * np.array([0.0, 0.25, 0.5, 0.75, 1.0])  # (tiles, 5)
    x = matrices[..., 0, 0, None, None] * u + matrices[..., 0, 2, None, None]
    x = x / (matrices[..., 2, 0, None, None] * u + matrices[..., 2, 2, None, None])
    first, third = (
        x[..., k] - (b[0] * x[..., 0] + b[1] * x[..., 2] + b[2] * x[..., 4])
        for k, b in ((1, (0.375, 0.75, -0.125)), (3, (-0.125, 0.75, 0.375)))
    )
    return float(np.abs([first, third]).max())


def _looked_through(pictures_from_centre: Sequence[F64], box: PixelRect, size: tuple[int, int]) -> PixelRect | None:
    """The pixels of either picture of a size (height, width) that look through a box of the centre panel; None where
    an eye is nearly in its plane, or sees too little of it."""
    corners = np.array([[0.0, box.width_px, 0.0, box.width_px], [0.0, 0.0, box.height_px, box.height_px], [1.0] * 4])
    ends = []
    for matrix in pictures_from_centre:
        x, y, w = (matrix / (matrix[2] @ (box.width_px / 2, box.height_px / 2, 1.0))) @ corners
        if w.min() < MIN_WEIGHT:
            return None
        ends.append((x / w, y / w))
    low, high = np.min(ends, axis=(0, 2)), np.max(ends, axis=(0, 2))
    u0, v0 = (int(max(0, np.floor(value))) for value in low)
    u1, v1 = int(min(size[1], np.ceil(high[0]))), int(min(size[0], np.ceil(high[1])))
    return PixelRect(u0, v0, u1, v1) if u1 - u0 > 1 and v1 - v0 > 1 else None
