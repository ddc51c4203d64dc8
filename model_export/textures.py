"""Textures of the training scenes: (h, w, 4) RGBA pictures out of a random generator."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from runtime.records import U8

Random = np.random.Generator
Texture = Callable[[Random, int, int], U8]
WORDS = ["AaBb", "Phase", "3D", "0123", "light", "Stack", "eye", "&", "field", "42%", "panel", "Wg#?", "depth"]


def _opaque(rgb: np.ndarray) -> U8:
    picture = np.full((*rgb.shape[:2], 4), 255, np.uint8)
    picture[..., :3] = np.clip(np.rint(rgb * 255), 0, 255)
    return picture


def _colour(random: Random) -> np.ndarray:
    """A colour; now and then dark, white or fully saturated."""
    kind = random.random()
    if kind < 0.15:
        return random.uniform(0, 0.06, 3)
    if kind < 0.25:
        return np.full(3, random.uniform(0.95, 1.0))
    if kind < 0.4:
        return np.rint(random.random(3))
    return random.random(3)


def noise(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) noise whose power falls with frequency: 1/f to some exponent from white to clouds."""
    exponent = random.uniform(0.3, 2.0)
    fu, fv = np.fft.rfftfreq(width), np.fft.fftfreq(height)[:, None]
    gain = 1 / np.maximum(np.hypot(fu, fv), 1 / max(width, height)) ** exponent
    layers = []
    for _ in range(3):
        spectrum = gain * np.exp(2j * np.pi * random.random((height, width // 2 + 1)))
        layer = np.fft.irfft2(spectrum, s=(height, width))
        layers.append(layer / (layer.std() + 1e-9))
    mixed = np.stack(layers, axis=-1) * random.uniform(0.08, 0.35)
    grey = random.random()
    mixed = grey * mixed.mean(axis=-1, keepdims=True) + (1 - grey) * mixed
    return _opaque(_colour(random) * 0.5 + 0.25 + mixed)


def checker(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) squares of two colours, turned."""
    v, u = np.mgrid[0:height, 0:width]
    angle, size = random.uniform(0, np.pi), random.uniform(4, 40)
    a = np.floor((u * np.cos(angle) + v * np.sin(angle)) / size)
    b = np.floor((v * np.cos(angle) - u * np.sin(angle)) / size)
    return _opaque(np.where(((a + b) % 2 > 0)[..., None], _colour(random), _colour(random)))


def gradient(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) a smooth run between two colours, nearly without detail."""
    v, u = np.mgrid[0:height, 0:width]
    angle = random.uniform(0, np.pi)
    t = 0.5 + (u / width - 0.5) * np.cos(angle) + (v / height - 0.5) * np.sin(angle)
    return _opaque(t[..., None] * _colour(random) + (1 - t[..., None]) * _colour(random))


def shapes(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) discs, boxes and lines of all sizes over one another."""
    picture = _opaque(np.tile(_colour(random), (height, width, 1)))
    for _ in range(int(random.integers(10, 60))):
        colour = [int(c * 255) for c in _colour(random)] + [255]
        x, y = int(random.integers(width)), int(random.integers(height))
        size = int(max(width, height) * 0.3 * random.random() ** 2) + 1
        kind = random.integers(3)
        if kind == 0:
            cv2.circle(picture, (x, y), size, colour, -1, cv2.LINE_AA)
        elif kind == 1:
            cv2.rectangle(picture, (x, y), (x + size, y + int(random.integers(1, size + 1))), colour, -1)
        else:
            end = (int(random.integers(width)), int(random.integers(height)))
            cv2.line(picture, (x, y), end, colour, int(random.integers(1, 4)), cv2.LINE_AA)
    return picture


def text(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) lines of words on a plate."""
    picture = _opaque(np.tile(_colour(random), (height, width, 1)))
    colour = [int(c * 255) for c in _colour(random)] + [255]
    y = 0
    while y < height:
        scale = float(random.uniform(0.3, 1.2))
        y += int(30 * scale) + 2
        line = " ".join(random.choice(WORDS) for _ in range(12))
        cv2.putText(picture, line, (3, y), cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1 + (scale > 0.7), cv2.LINE_AA)
    return picture


def wires(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) thin structures with nothing between them."""
    picture = np.zeros((height, width, 4), np.uint8)
    picture[..., :3] = np.rint(_colour(random) * 255)
    alpha = np.zeros((height, width), np.uint8)
    for _ in range(int(random.integers(3, 25))):
        start, end = ((int(random.integers(width)), int(random.integers(height))) for _ in range(2))
        cv2.line(alpha, start, end, 255, int(random.integers(1, 4)), cv2.LINE_AA)
    picture[..., 3] = alpha
    return picture


def blob(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) a textured patch with an irregular outline."""
    texture: Texture = random.choice([noise, shapes, checker])  # type: ignore[arg-type]
    picture = texture(random, width, height)
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    radius = 0.42 * (0.75 + 0.25 * np.sin(angles * int(random.integers(2, 7)) + random.uniform(0, 6)))
    points = np.stack([(0.5 + radius * np.cos(angles)) * width, (0.5 + radius * np.sin(angles)) * height], axis=-1)
    alpha = np.zeros((height, width), np.uint8)
    cv2.fillPoly(alpha, [np.rint(points).astype(np.int32)], 255, cv2.LINE_AA)
    picture[..., 3] = alpha
    return picture


def glint(random: Random, width: int, height: int) -> U8:
    """(height, width, 4) a specular highlight: white, brightest in its middle."""
    v, u = np.mgrid[0:height, 0:width]
    radius = np.hypot(u / width - 0.5, v / height - 0.5) * 2
    picture = np.full((height, width, 4), 255, np.uint8)
    picture[..., 3] = np.rint(255 * np.exp(-((radius * random.uniform(1.5, 3)) ** 2)) * (radius < 1))
    return picture


BACKDROPS: tuple[Texture, ...] = (noise, noise, noise, shapes, gradient, checker)
OBJECTS: tuple[Texture, ...] = (
    noise,
    checker,
    gradient,
    shapes,
    shapes,
    text,
    wires,
    wires,
    blob,
    blob,
)
