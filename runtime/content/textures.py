"""Procedural RGBA textures (256, 256, 4) for the built-in scenes, identical on every machine."""

from __future__ import annotations

import numpy as np

from runtime.records import F64, U8

SIZE_PX = 256


def _coordinates() -> tuple[F64, F64]:
    grid = (np.arange(SIZE_PX) + 0.5) / SIZE_PX
    u, v = np.meshgrid(grid, grid)
    return u, v


def _mixed(weight: F64, first: tuple[int, int, int], second: tuple[int, int, int]) -> U8:
    """Return a picture of two colours, 0-255, with the weight (h, w) of the first one."""
    rgb = weight[..., None] * np.array(first) + (1 - weight[..., None]) * np.array(second)
    alpha = np.full((*weight.shape, 1), 255.0)
    return np.concatenate([np.clip(np.rint(rgb), 0, 255), alpha], axis=2).astype(np.uint8)


def _noise(seed: int, octaves: int = 4) -> F64:
    """Return smooth noise in [0, 1], a sum of random waves that tiles without a seam."""
    u, v = _coordinates()
    random = np.random.default_rng(seed)
    total = np.zeros_like(u)
    for octave in range(octaves):
        for _ in range(6):
            a, b = random.integers(-(2**octave) - 1, 2**octave + 2, 2)
            total += np.sin(2 * np.pi * (a * u + b * v + random.random())) / 2**octave
    noise: F64 = (total - total.min()) / np.ptp(total)
    return noise


def checker() -> U8:
    """Return a chequerboard of 8 x 8 squares with fine lines between them."""
    u, v = _coordinates()
    squares = (np.floor(u * 8) + np.floor(v * 8)) % 2
    lines = np.minimum(np.abs(u * 8 - np.rint(u * 8)), np.abs(v * 8 - np.rint(v * 8))) < 0.04
    return _mixed(np.where(lines, 0.0, 0.35 + 0.65 * squares), (255, 246, 224), (40, 48, 66))


def crate() -> U8:
    """Return one side of a wooden crate: planks with grain, a frame and a diagonal."""
    u, v = _coordinates()
    grain = 0.5 + 0.5 * np.sin(2 * np.pi * (18 * v + 1.5 * np.sin(2 * np.pi * (u + 2 * _noise(3, 2)))))
    frame = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) < 0.11
    diagonal = np.abs(u - v) < 0.07
    gaps = (np.abs(v * 5 - np.rint(v * 5)) < 0.04) & ~frame & ~diagonal
    shade = 0.45 + 0.35 * grain + 0.2 * (frame | diagonal)
    return _mixed(np.where(gaps, 0.05, shade), (238, 178, 96), (92, 52, 22))


def globe() -> U8:
    """Return a map of land and sea with a grid of meridians and parallels."""
    u, v = _coordinates()
    lines = (np.abs(u * 12 - np.rint(u * 12)) < 0.05) | (np.abs(v * 12 - np.rint(v * 12)) < 0.05)
    land = np.clip((_noise(11) - 0.52) * 20, 0, 1)
    picture = _mixed(land, (86, 158, 62), (28, 96, 190))
    picture[lines, :3] = (picture[lines, :3] * 0.35 + np.array([255, 255, 255]) * 0.65).astype(np.uint8)
    return picture


def stripes() -> U8:
    """Return diagonal stripes in two colours."""
    u, v = _coordinates()
    return _mixed((np.floor((u + v) * 4) % 2), (226, 44, 78), (255, 214, 226))


def picture() -> U8:
    """Return a poster of rings, a gradient and dots, with detail at all scales."""
    u, v = _coordinates()
    radius = np.hypot(u - 0.5, v - 0.5)
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * 40 * radius**1.5)
    fine = _noise(5, 6)
    red, green, blue = 255 * (0.3 + 0.7 * u * rings), 255 * (0.25 + 0.6 * fine), 255 * (0.35 + 0.65 * v * (1 - rings))
    rgb = np.stack([red, green, blue, np.full_like(u, 255.0)], axis=2)
    return np.clip(np.rint(rgb), 0, 255).astype(np.uint8)


def mosaic() -> U8:
    """Return coloured tiles with grain and light grout. The texture tiles without a seam."""
    u, v = _coordinates()
    column, row = (np.floor(u * 12)).astype(int), (np.floor(v * 12)).astype(int)
    colours = np.random.default_rng(23).uniform(0.25, 1.0, (12, 12, 3))[row, column]
    grout = np.minimum(np.abs(u * 12 - np.rint(u * 12)), np.abs(v * 12 - np.rint(v * 12))) < 0.06
    rgb = np.where(grout[..., None], 0.82, colours * (0.7 + 0.3 * _noise(29, 5)[..., None]))
    return np.concatenate([np.rint(rgb * 255), np.full((SIZE_PX, SIZE_PX, 1), 255.0)], axis=2).astype(np.uint8)


TEXTURES = {
    "checker": checker,
    "crate": crate,
    "globe": globe,
    "stripes": stripes,
    "mosaic": mosaic,
    "picture": picture,
}


def texture(name: str) -> U8 | None:
    """Return a texture (256, 256, 4) by name, or None for `plain`, which means a uniform colour."""
    return None if name == "plain" else TEXTURES[name]()
