"""Measure focal parallax (supplement, 1.4), which lets an eye focus on planes beyond the panels.

The eye sees the mean of the pinhole pictures through all points of its pupil. To focus at a distance f along the gaze,
these pictures are shifted until they coincide for points at that distance: the picture through the point (right, up) of
the pupil is shifted by focal_px·right/f to the right and by focal_px·up/f upwards.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.config import ModelSettings
from runtime.content import shapes
from runtime.content.scenes import Scene, Thing
from runtime.model.job import drawn_job
from runtime.model.predictor import load_predictor
from runtime.optics.carried import intensities
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import Rays, Retina, average, pupil_points, through_layers
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, raster_from_stack, stack_from_eye
from runtime.records import F32, F64, U8
from runtime.report.pairs import PairPainter, eyes_at

WIDTH_PX, HEIGHT_PX, FOV_DEG = 720, 300, 18.0
PUPIL_M = PUPIL_MM / 1e3
DISTANCE_M = 0.4
CARDS_M = (-0.05, 0.0, 0.045)  # x of the three cards, frame `stack`
OFFSETS_M = (-0.043, 0.0, 0.040)  # y of the three cards, frame `stack`
PLANES_M = (-0.11, -0.08, -0.05, -0.025, 0.0, 0.022, 0.045, 0.07, 0.095)  # x of the planes in focus, frame `stack`


@dataclass(frozen=True, slots=True)
class Slice:
    """The pictures an eye sees while it focuses on one plane."""

    plane_m: float  # x of the plane in focus, frame `stack`
    shown: F32  # (h, w, 3) view through the layers
    true: F32  # (h, w, 3) view of the scene itself


@dataclass(frozen=True, slots=True)
class Accommodation:
    """Distances, in metres, from an eye to where the eyes converge on a card and to the sharpest focus."""

    card_m: float  # distance to the point where the lines of sight meet
    sharpest_shown_m: float  # focal distance where the card is sharpest through the layers
    sharpest_true_m: float  # focal distance where the card is sharpest in the scene itself


@dataclass(frozen=True, slots=True)
class FocalStack:
    """The right eye's pictures at several focal distances, and the accommodation for each card."""

    model: str
    slices: tuple[Slice, ...]  # one per plane of PLANES_M
    cards: tuple[Accommodation, ...]  # one per card of CARDS_M


def projection(eye_m: F64, point: F64, *, focus_m: float) -> F64:
    """Return the 3x4 projection matrix through a point in the pupil, refocused to a given distance.

    The third homogeneous coordinate of a projected point is its distance from the eye along the gaze, in metres.

    Args:
        eye_m: The pupil's centre, shape (3,), in the `stack` frame.
        point: Offset from the pupil's centre, to the right and up, shape (2,), in metres.
        focus_m: Distance along the gaze at which the images formed through all points coincide.
    """
    centre = image_from_stack(eye_m, width_px=WIDTH_PX, height_px=HEIGHT_PX, fov_deg=FOV_DEG)
    # As the pupil's point moves, points in front of the plane in focus move the opposite way, and points behind it the
    # same way.
    focal_px = WIDTH_PX / 2 / math.tan(math.radians(FOV_DEG / 2))
    out_of_focus = centre[2] / focus_m - [0.0, 0.0, 0.0, 1.0]
    return centre + np.outer([focal_px * point[0], -focal_px * point[1], 0.0], out_of_focus)


def card_windows(eye_m: F64) -> list[tuple[slice, slice]]:
    """Return the rows and columns of each card in the eye's picture, slightly inside the card's edges."""
    windows = []
    matrix = projection(eye_m, np.zeros(2), focus_m=DISTANCE_M)
    for x, y in zip(CARDS_M, OFFSETS_M, strict=True):
        corners = [matrix @ [x, y + dy, dz, 1.0] for dy in (-0.012, 0.012) for dz in (-0.014, 0.014)]
        pixels = np.array([c[:2] / c[2] for c in corners])
        (left, top), (right, bottom) = pixels.min(0).astype(int), np.ceil(pixels.max(0)).astype(int)
        windows.append((slice(max(top, 0), bottom), slice(max(left, 0), right)))
    return windows


def contrast(image: F32, window: tuple[slice, slice]) -> float:
    """Return the RMS brightness gradient in a window. Sharper pictures have a larger gradient."""
    grey = image[window].mean(axis=2)
    return float(np.sqrt((np.diff(grey, axis=1) ** 2).mean() + (np.diff(grey, axis=0) ** 2).mean()))


def sharpest(distances_m: Sequence[float], values: Sequence[float]) -> float:
    """Return the distance that gives the largest value, refined by a parabola through its two neighbours."""
    best = int(np.argmax(values))
    if not 0 < best < len(values) - 1:
        return distances_m[best]
    powers = np.polyfit(distances_m[best - 1 : best + 2], values[best - 1 : best + 2], 2)
    return float(-powers[1] / (2 * powers[0])) if powers[0] < 0 else distances_m[best]


def focal_stack(
    painter: PairPainter, stack: PanelStack, *, model: str, progress: Callable[[int, int], None] = lambda done, of: None
) -> FocalStack:
    """Solve for two pinhole eyes, then focus the right eye at every plane of PLANES_M.

    Args:
        painter: Painter that draws the cards (`cards_painter`).
        stack: Panel geometry.
        model: Model name, or path of an ONNX file.
        progress: Function called after each plane with the number of planes finished and the total number.
    """
    eyes = eyes_at(distance_m=DISTANCE_M)
    predictor = load_predictor(model, stack, ModelSettings())
    raster = stack.panel(stack.count // 2)
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    pictures = [painter.draw(eye, raster_from_stack(eye, raster), **size) for eye in eyes]
    layers = np.array(predictor.solve(drawn_job(pictures, eyes, stack)).layers)
    predictor.close()
    eye, points = eyes[1], pupil_points(PUPIL_M)
    gaze = -stack_from_eye(eye)[:3, 2]
    slices: list[Slice] = []
    for index, plane_m in enumerate(PLANES_M):
        focus_m = float((np.array([plane_m, 0.0, 0.0]) - eye) @ gaze)
        matrices = [projection(eye, point, focus_m=focus_m) for point in points]
        seen = [seen_through(matrix, layers, stack).image for matrix in matrices]
        drawn = [painter.draw(eye, matrix, width_px=WIDTH_PX, height_px=HEIGHT_PX) for matrix in matrices]
        slices.append(Slice(plane_m, average(seen), average([intensities(picture) for picture in drawn])))
        progress(index + 1, len(PLANES_M))
    away = [math.dist((x, 0.0, 0.0), eye) for x in PLANES_M]
    cards = tuple(
        Accommodation(
            math.dist(eye, (x, y, 0.0)),
            sharpest(away, [contrast(s.shown, window) for s in slices]),
            sharpest(away, [contrast(s.true, window) for s in slices]),
        )
        for x, y, window in zip(CARDS_M, OFFSETS_M, card_windows(eye), strict=True)
    )
    return FocalStack(model, tuple(slices), cards)


def seen_through(matrix: F64, layers: U8, stack: PanelStack) -> Retina:
    """Compute the picture of the layers as seen through a projection.

    The mask marks rays that cross all panels.
    """
    rays = Rays(matrix, np.arange(WIDTH_PX) + np.float64(0.5), (np.arange(HEIGHT_PX) + np.float64(0.5))[:, None])
    panels = [stack.panel(index) for index in range(stack.count)]
    return through_layers(layers, lambda rows: (rays.on(panel, rows) for panel in panels), rays.toward_panels(), stack)


def cards_painter(stack: PanelStack) -> PairPainter:
    """Return a painter for three finely textured cards: behind, in and in front of the middle panel."""
    card = shapes.card(0.034, 0.036, repeat=(3.4, 3.6))
    things = tuple(
        Thing(card, "checker", (x, y, 0.0), colour, lit=False)
        for x, y, colour in zip(CARDS_M, OFFSETS_M, ((1.0, 0.75, 0.7), (0.75, 1.0, 0.75), (0.7, 0.8, 1.0)), strict=True)
    )
    return PairPainter(Scene("cards", things), stack)
