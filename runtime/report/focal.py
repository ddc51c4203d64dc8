"""Measure focal parallax (supplement, 1.4), which lets an eye focus on planes beyond the panels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.config import ModelSettings
from runtime.content import shapes
from runtime.content.scenes import Scene, Thing
from runtime.model.job import Job, Targets, drawn_views
from runtime.model.predictor import load_predictor
from runtime.optics.carried import intensities
from runtime.optics.focus import RetinaPixels, points_of_pupils, retina_db
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.rect import PixelRect
from runtime.optics.retina import Retina
from runtime.optics.stack import PanelStack
from runtime.optics.views import raster_from_stack
from runtime.records import F32, F64, U8, Eyes
from runtime.report.pairs import PairPainter, eyes_at

SEEN_M = 0.126, 0.052  # width and height, in the middle panel, of the part that the pictures show
PUPIL_M = PUPIL_MM / 1e3
DISTANCE_M = 0.4
CARDS_M = (-0.05, 0.0, 0.045)  # x of the three cards, frame `stack`
OFFSETS_M = (-0.043, 0.0, 0.040)  # y of the three cards, frame `stack`
FOCUSED_M = (CARDS_M[0], CARDS_M[1], CARDS_M[2])  # x of the planes that `retina_db` is measured at
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
    retina_db: float  # both eyes, focused at each card (`optics.focus`)
    focus: bool  # True if the points of the pupils had separate pictures


def seen_pixels(stack: PanelStack) -> RetinaPixels:
    """Return the middle panel's pixels that the pictures show."""
    raster = stack.panel(stack.count // 2)
    width_px, height_px = round(SEEN_M[0] / raster.pitch_u_m), round(SEEN_M[1] / raster.pitch_v_m)
    u0, v0 = (raster.width_px - width_px) // 2, (raster.height_px - height_px) // 2
    return RetinaPixels(PixelRect(u0, v0, u0 + width_px, v0 + height_px).cut(raster))


def card_windows(pixels: RetinaPixels, eye_m: F64) -> list[tuple[slice, slice]]:
    """Return the rows and columns of each card in the eye's picture, slightly inside the card's edges."""
    windows = []
    matrix = raster_from_stack(eye_m, pixels.raster)
    for x, y in zip(CARDS_M, OFFSETS_M, strict=True):
        corners = [matrix @ [x, y + dy, dz, 1.0] for dy in (-0.012, 0.012) for dz in (-0.014, 0.014)]
        places = np.array([c[:2] / c[2] for c in corners])
        (left, top), (right, bottom) = places.min(0).astype(int), np.ceil(places.max(0)).astype(int)
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
    painter: PairPainter,
    stack: PanelStack,
    *,
    model: str,
    focus: bool = False,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> FocalStack:
    """Solve for two eyes, then focus the right eye at every plane of PLANES_M.

    `painter` draws the cards (`cards_painter`). `focus` solves with separate pictures for points of the pupils, rather
    than for pinhole eyes. `progress` receives the number of planes finished and of all planes.
    """
    eyes = eyes_at(distance_m=DISTANCE_M)
    layers = cards_layers(painter, stack, eyes, model=model, focus=focus)

    pixels = seen_pixels(stack)
    size = {"width_px": pixels.raster.width_px, "height_px": pixels.raster.height_px}

    def pictures(eye: F64, plane_m: float) -> tuple[Retina, F32]:
        true = pixels.true(lambda at, matrix: intensities(painter.draw(at, matrix, **size)), eye, plane_m=plane_m)
        return pixels.seen(layers, stack, eye, plane_m=plane_m), true

    slices: list[Slice] = []
    for index, plane_m in enumerate(PLANES_M):
        seen, true = pictures(eyes[1], plane_m)
        slices.append(Slice(plane_m, seen.image, true))
        progress(index + 1, len(PLANES_M))
    retina = retina_db(pictures(eye, plane_m) for eye in eyes for plane_m in FOCUSED_M)
    away = [math.dist((x, 0.0, 0.0), eyes[1]) for x in PLANES_M]
    cards = tuple(
        Accommodation(
            math.dist(eyes[1], (x, y, 0.0)),
            sharpest(away, [contrast(s.shown, window) for s in slices]),
            sharpest(away, [contrast(s.true, window) for s in slices]),
        )
        for x, y, window in zip(CARDS_M, OFFSETS_M, card_windows(pixels, eyes[1]), strict=True)
    )
    return FocalStack(model, tuple(slices), cards, retina, focus)


def cards_layers(painter: PairPainter, stack: PanelStack, eyes_m: Eyes, *, model: str, focus: bool) -> U8:
    """Solve the painter's scene for two eyes, and return the layers (N, h, w, 4)."""
    raster = stack.panel(stack.count // 2)
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    places = points_of_pupils(eyes_m) if focus else eyes_m
    pictures = [painter.draw(place, raster_from_stack(place, raster), **size) for place in places]
    predictor = load_predictor(model, stack, ModelSettings())
    job = Job(Targets(stack, places, drawn_views(pictures, stack), points=len(places) // len(eyes_m)))
    layers = np.array(predictor.solve(job).layers)
    predictor.close()
    return layers


def cards_painter(stack: PanelStack) -> PairPainter:
    """Return a painter for three textured cards: behind, in and in front of the middle panel. Their
    details are wider than a panel's pixel, because narrower ones are lost whether the eye can focus or not.
    """
    card = shapes.card(0.034, 0.036)
    things = tuple(
        Thing(card, "crate", (x, y, 0.0), colour, lit=False)
        for x, y, colour in zip(CARDS_M, OFFSETS_M, ((1.0, 0.75, 0.7), (0.75, 1.0, 0.75), (0.7, 0.8, 1.0)), strict=True)
    )
    return PairPainter(Scene("cards", things), stack)
