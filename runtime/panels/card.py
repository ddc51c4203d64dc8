"""Test card for `phasestack identify` that shows a panel's index, orientation, colours and edges."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from runtime.records import U8

INK = (255,) * 4
PAPER = (24, 28, 36, 255)
BARS = ((255, 0, 0), (0, 255, 0), (0, 0, 255), (0, 255, 255), (255, 0, 255), (255, 255, 0), (255, 255, 255))
FONT = cv2.FONT_HERSHEY_SIMPLEX


def identity_card(width_px: int, height_px: int, *, title: str, lines: Sequence[str]) -> U8:
    """Draw a (height_px, width_px, 4) test card with text, an upward arrow, colour bars and grey steps.
    If a line one pixel wide along an edge cannot be seen, the panel is cropped or misaligned. Text is kept away from
    the edges, because a nearby viewer sees no lit panel behind the front panel's rim.
    """
    card = np.empty((height_px, width_px, 4), np.uint8)
    card[:] = PAPER
    unit = min(width_px, height_px) / 100
    _bars(card, top=round(height_px * 0.76))
    _arrow(card, x_px=round(width_px * 0.78), top=round(height_px * 0.13), bottom=round(height_px * 0.63), unit=unit)
    left, room = round(0.12 * width_px), 0.56 * width_px
    baseline = round(height_px * 0.26)
    _text(card, title, x_px=left, y_px=baseline, height=14 * unit, room=room)
    baseline += round(3 * unit)
    for line in lines:
        baseline += round(8.5 * unit)
        _text(card, line, x_px=left, y_px=baseline, height=5 * unit, room=room)
    edge = ((0, 0), (width_px - 1, height_px - 1))
    cv2.rectangle(card, *edge, INK, 1)
    corner = round(3 * unit)
    cv2.rectangle(card, (corner, corner), (width_px - 1 - corner, height_px - 1 - corner), (120, 130, 150, 255), 1)
    return card


def alone(cards: Sequence[U8], index: int) -> U8:
    """Return layers (N, H, W, 4) with the card for panel `index`, and with zeros on all other panels."""
    layers = np.zeros((len(cards), *cards[index].shape), np.uint8)
    layers[..., 3] = 255
    layers[index] = cards[index]
    return layers


def _bars(card: U8, *, top: int) -> None:
    height, width = card.shape[:2]
    middle = (top + height) // 2
    for index, colour in enumerate(BARS):  # each as far as the edge, where the next ones are drawn over it
        card[top:middle, width * index // len(BARS) :, :3] = colour
    steps = 16
    for index in range(steps):
        card[middle:, width * index // steps :, :3] = round(255 * index / (steps - 1))


def _arrow(card: U8, *, x_px: int, top: int, bottom: int, unit: float) -> None:
    cv2.arrowedLine(card, (x_px, bottom), (x_px, top), INK, math.ceil(2 * unit), cv2.LINE_AA, tipLength=0.25)
    _text(card, "UP", x_px=x_px + round(4 * unit), y_px=(top + bottom) // 2, height=6 * unit, room=14 * unit)
    _text(card, "RIGHT >", x_px=x_px - round(10 * unit), y_px=bottom + round(8 * unit), height=4 * unit, room=26 * unit)


def _text(card: U8, text: str, *, x_px: int, y_px: int, height: float, room: float) -> None:
    # OpenCV's Hershey fonts cover only ASCII.
    plain = text.encode("ascii", "replace").decode()
    (full, tall), _ = cv2.getTextSize(plain, FONT, 1.0, 1)
    scale = min(height / tall, room / full)
    cv2.putText(card, plain, (x_px, y_px), FONT, scale, INK, math.ceil(scale * 1.6), cv2.LINE_AA)
