"""Locate the saddle points of calibration boards in a photograph, to hundredths of a pixel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from calib.board import MARKER, Mark, dictionary, marks
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

DETECTION_PX = 2400  # size of the copy searched for marks; corners are located in the original photograph
MIN_MARKS = 3  # minimum number of marks per panel (twelve points)
MIN_EXTENT = 0.3  # share of a panel that its marks must span, because marks in one corner barely determine the panel
MIN_UNIT_PX = 1.7  # minimum size of a marker bit in the photograph
BLURRED_BITS = 1.1  # maximum width of an edge, in marker bits
MIN_CONTRAST = 0.35  # minimum contrast at a saddle point, relative to the mark's contrast
MIN_DYNAMIC = 24  # minimum difference between black and white in 8-bit levels


@dataclass(frozen=True, slots=True)
class SeenMarks:
    """Saddle points found in one photograph."""

    name: str  # the photograph's file name
    width_px: int
    height_px: int
    panel: Any  # (K,) index of the panel that shows each point
    panel_px: F64  # (K, 2) positions on the panel
    image_px: F64  # (K, 2) positions in the photograph; pixel centres are integers
    marks: tuple[int, ...]  # number of marks found on each panel
    fault: str  # reason why the photograph is unusable, or an empty string


def _detector() -> Any:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin, parameters.adaptiveThreshWinSizeMax = 11, 43
    parameters.adaptiveThreshWinSizeStep = 16
    parameters.minMarkerPerimeterRate = 0.008
    parameters.errorCorrectionRate = 0.3  # low, so that overlapping marks are not misread
    parameters.minDistanceToBorder = 2
    return cv2.aruco.ArucoDetector(dictionary(), parameters)


def _markers(picture: U8, known: dict[int, Mark]) -> list[tuple[Mark, F64]]:
    """Return the legible marks, each with its corners (4, 2) in pixels, except those that appear more than once.
    `known` maps the ids of all markers to their marks.
    """
    scale = min(2.0, DETECTION_PX / max(picture.shape))
    kind = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=kind)
    corners, numbers, _ = _detector().detectMarkers(small)
    if numbers is None:
        return []
    ids = [int(number) for number in np.ravel(numbers)]
    return [
        (known[number], (np.asarray(quad, dtype=np.float64).reshape(4, 2) + 0.5) / scale - 0.5)
        for number, quad in zip(ids, corners, strict=True)
        if number in known and ids.count(number) == 1
    ]


def find_marks(picture: U8, stack: PanelStack, *, name: str) -> SeenMarks:
    """Find the saddle points of all boards in a grey photograph (h, w) with the file name `name`."""
    known = {mark.number: mark for mark in marks(stack)}
    markers = _markers(picture, known)
    panel, panel_px, image_px, edges = [], [np.zeros((0, 2))], [np.zeros((0, 2))], []
    unit_px = float(np.median([_unit_px(quad) for _, quad in markers])) if markers else 0.0
    window = int(np.clip(round(1.3 * unit_px), 2, 15))
    for mark, quad in markers:
        image_from_panel: Any = cv2.findHomography(mark.marker_px, quad)[0]
        if image_from_panel is None:
            continue
        guess = cv2.perspectiveTransform(mark.saddles_px[None], image_from_panel)[0]
        good, refined = _refined(picture, guess, quad, window=window)
        if good.any():
            panel.append(np.full(int(good.sum()), mark.panel))
            panel_px.append(mark.saddles_px[good])
            image_px.append(refined[good])
            edges.append(_edge_px(picture, quad) / _unit_px(quad))
    owners, places_px = np.concatenate([np.zeros(0, np.intp), *panel]), np.concatenate(panel_px)
    counts = [sum(int(part[0]) == index for part in panel) for index in range(stack.count)]
    height, width = picture.shape
    return SeenMarks(
        name=name,
        width_px=width,
        height_px=height,
        panel=owners,
        panel_px=places_px,
        image_px=np.concatenate(image_px),
        marks=tuple(counts),
        fault=_mirrored(picture, known, counts)
        or _unreadable(counts, edges, unit_px)
        or _covered(counts, places_px / [stack.width_px, stack.height_px], owners),
    )


def _mirrored(picture: U8, known: dict[int, Mark], counts: list[int]) -> str:
    """Return a message if marks, counted by panel, can be read only in a picture's mirror image, otherwise ""."""
    if min(counts) >= MIN_MARKS:
        return ""
    turned = [mark.panel for mark, _ in _markers(np.ascontiguousarray(picture[:, ::-1]), known)]
    for panel, count in enumerate(counts):
        if count < MIN_MARKS <= turned.count(panel):
            if max(counts) < MIN_MARKS:
                return "is mirrored; use a camera that does not mirror, or correct `mirror` in the configuration"
            return f"shows panel {panel} mirrored; correct its `mirror` in the configuration"
    return ""


def _unreadable(counts: list[int], edges: list[float], unit_px: float) -> str:
    """Return a message if marks, counted by panel, are missing, blurred (edges in bits) or too small, otherwise "".
    `unit_px` is the size of a marker bit in the photograph.
    """
    if sum(counts) == 0:
        return "shows no marks because the display is out of view or the picture is blurred or too dark"
    edge_bits = float(np.median(edges))
    if edge_bits > BLURRED_BITS:
        return f"is blurred (edges are {edge_bits * unit_px:.1f} px wide); take a sharper photograph"
    if unit_px < MIN_UNIT_PX:
        return f"shows marks that are too small ({unit_px:.1f} px per bit); move closer or use a higher resolution"
    return ""


def _covered(counts: list[int], places: F64, owners: Any) -> str:
    """Return a message if a panel's marks are too few or too close together to locate the panel, otherwise "". `places`
    (K, 2) are the saddle points as fractions of the panel that shows each (`owners`).
    """
    fewest = min(counts)
    if fewest < MIN_MARKS:
        panel = counts.index(fewest)
        return (
            f"shows {fewest} marks of panel {panel}, but at least {MIN_MARKS} are needed; keep the whole panel in view"
        )
    for panel in range(len(counts)):
        share = float(np.ptp(places[owners == panel], axis=0).min())
        if share < MIN_EXTENT:
            return (
                f"shows only {100 * share:.0f}% of the width or height of panel {panel}; keep the whole panel in view"
            )
    return ""


def _unit_px(quad: F64) -> float:
    """Return the size of a marker bit in the photograph, along the marker's shortest side."""
    sides = np.linalg.norm(quad - np.roll(quad, 1, axis=0), axis=1)
    return float(sides.min()) / MARKER


def _refined(picture: U8, guess: F64, quad: F64, *, window: int) -> tuple[Any, F64]:
    """Locate a mark's four saddle points (4, 2) in a grey photograph, from a guess; `window` is half the search's side.
    Also return a mask (4,) of points that are white along the mark's diagonal and black across it.
    """
    height, width = picture.shape
    inside = (
        (guess[:, 0] > window + 2) & (guess[:, 0] < width - window - 3)
        & (guess[:, 1] > window + 2) & (guess[:, 1] < height - window - 3)
    )  # fmt: skip
    if not inside.all():
        return inside & False, guess
    points = guess.astype(np.float32).reshape(-1, 1, 2).copy()
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-3)
    cv2.cornerSubPix(picture, points, (window, window), (-1, -1), criteria)
    refined = points.reshape(-1, 2).astype(np.float64)
    near = np.linalg.norm(refined - guess, axis=1) < 0.8 * window
    # Offsets of about one bit along and across the mark's diagonals.
    out = (guess - guess.mean(axis=0)) / 5 * 0.9
    arms = np.stack([refined + out, refined - out, refined + _quarter(out, guess), refined - _quarter(out, guess)])
    values = _samples(picture, arms)
    white, black = values[:2].min(axis=0), values[2:].max(axis=0)
    whole = float(np.ptp(_samples(picture, np.stack([guess.mean(axis=0)[None] + (quad - guess.mean(axis=0)) * s
                                                      for s in (0.9, 1.3)]))))  # fmt: skip
    return near & (white - black > max(MIN_CONTRAST * whole, MIN_DYNAMIC)), refined


def _quarter(out: F64, guess: F64) -> F64:
    """Return offsets (4, 2) across the diagonal at each corner, about as long as the offsets `out`. Each offset is
    parallel to the line between the neighbouring corners, which allows for perspective.
    """
    following, before = np.roll(guess, -1, axis=0) - guess, np.roll(guess, 1, axis=0) - guess
    return np.asarray((following - before) / 10 * 0.9, dtype=np.float64)


def _samples(picture: U8, points: F64) -> F64:
    """Sample a picture at pixel coordinates (..., 2), using bilinear interpolation."""
    flat = np.ascontiguousarray(points.reshape(-1, 1, 2).astype(np.float32))
    values = cv2.remap(picture, flat[..., 0], flat[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).reshape(points.shape[:-1])


def _edge_px(picture: U8, quad: F64) -> float:
    """Return the width of a marker's edge in pixels, for blur: contrast over slope, median of four sides."""
    widths = []
    centre = quad.mean(axis=0)
    for first, second in zip(quad, np.roll(quad, -1, axis=0), strict=True):
        middle = (first + second) / 2
        outward = (middle - centre) / 3  # length of one bit
        length = float(np.linalg.norm(outward))
        steps = np.linspace(-0.9, 1.6, 51)
        along = np.linspace(-0.25, 0.25, 9)[:, None, None] * (second - first)
        profile = _samples(picture, middle + along + steps[:, None] * outward).mean(axis=0)
        step_px = length * (steps[1] - steps[0])
        steepest = float(np.abs(np.gradient(profile)).max()) / step_px
        widths.append(float(np.ptp(profile)) / max(steepest, 1e-9))
    return float(np.median(widths))
