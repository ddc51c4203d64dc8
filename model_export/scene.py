"""Generate random scenes of textured cards, and draw them with exact geometry as seen by any eye."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from runtime.optics.stack import PanelStack, between_pixel_centres
from runtime.records import F32, F64, U8

FINER = 2  # supersampling factor for antialiasing
TEXELS = (24, 768)  # minimum and maximum side length of a texture, in pixels
Random = np.random.Generator


@dataclass(frozen=True, slots=True)
class Parallelogram:
    """Textured parallelogram: texture point (u, v) is at corner + u·across + v·down for 0 <= u, v <= 1."""

    texture: U8  # (h, w, 4) RGBA
    corner_m: F64  # (3,) top left corner, frame `stack`
    across_m: F64  # (3,) vector along the top edge
    down_m: F64  # (3,) vector along the left edge


Scene = tuple[Parallelogram, ...]


def draw(scene: Scene, projection: F64, *, width_px: int, height_px: int) -> U8:
    """Draw a picture (h, w, 3) of planes by a 3x4 projection from `stack`, the nearest at each pixel.
    Translucent edges are blended with the planes drawn earlier. Nothing behind the eye is drawn.
    """
    width, height = width_px * FINER, height_px * FINER
    picture = np.zeros((height, width, 3), np.float32)
    nearness = np.zeros((height, width), np.float32)  # reciprocal of the distance; negative behind the eye
    for plane in scene:
        on_raster = (
            np.diag([FINER, FINER, 1.0])
            @ projection
            @ np.vstack([np.column_stack([plane.across_m, plane.down_m, plane.corner_m]), [0.0, 0.0, 1.0]])
        )
        part = _part(on_raster, width, height)
        if part is not None:
            _draw_plane(plane.texture, on_raster, part, picture, nearness)
    smaller = cv2.resize(picture, (width_px, height_px), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(smaller), 0, 255).astype(np.uint8)


def _part(raster_from_plane: F64, width: int, height: int) -> tuple[slice, slice] | None:
    """Return the raster rows and columns that a plane, by its homography of (u, v, 1), can cover, or None."""
    corners = raster_from_plane @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1]], dtype=np.float64)
    area = np.linalg.det(raster_from_plane)
    if not np.isfinite(area) or abs(area) < 1e-12 or (corners[2] <= 0).all():
        return None
    if (corners[2] <= 0).any():  # the plane extends behind the eye, so it may cover any pixel
        return slice(0, height), slice(0, width)
    u, v = corners[:2] / corners[2]
    left, right = max(0, math.floor(u.min()) - 1), min(width, math.ceil(u.max()) + 1)
    top, bottom = max(0, math.floor(v.min()) - 1), min(height, math.ceil(v.max()) + 1)
    return (slice(top, bottom), slice(left, right)) if right > left and bottom > top else None


def _draw_plane(texture: U8, raster_from_plane: F64, part: tuple[slice, slice], picture: F32, nearness: F32) -> None:
    """Draw a texture (h, w, 4) in a part of `picture`, in place, where its plane is nearer than `nearness` (H, W)."""
    rows, columns = part
    left, top = columns.start, rows.start
    height, width = texture.shape[:2]
    texels = raster_from_plane @ np.diag([1 / width, 1 / height, 1.0])
    part_from_texels = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]]) @ texels
    size = columns.stop - left, rows.stop - top
    drawn = cv2.warpPerspective(texture, between_pixel_centres(part_from_texels), size, flags=cv2.INTER_LINEAR)
    inverse = np.linalg.inv(raster_from_plane)
    u, v = np.arange(left, columns.stop) + 0.5, np.arange(top, rows.stop)[:, None] + 0.5
    # When a pixel is mapped back to the plane, the third coordinate is the reciprocal of its distance along the gaze.
    near = (inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]).astype(np.float32)
    alpha = drawn[..., 3].astype(np.float32) * np.float32(1 / 255)
    alpha *= near >= nearness[part]
    picture[part] += alpha[..., None] * (drawn[..., :3].astype(np.float32) - picture[part])
    np.copyto(nearness[part], near, where=alpha > 0.5)


def random_scene(random: Random, stack: PanelStack, middle_m: F64) -> Scene:
    """Return a backdrop and cards at random depths, for a viewer whose head is near `middle_m` (3,)."""
    centre_m = stack.x_m[1]
    distance_m = middle_m[0] - centre_m
    deep_m = (stack.x_m[-1] - centre_m) * math.exp(random.uniform(math.log(0.3), math.log(6.0)))
    rear_m, front_m = -deep_m, min(deep_m, 0.35 * distance_m)
    panel_m, pixel_m = np.array([stack.width_m, stack.height_m]), stack.width_m / stack.width_px / FINER
    # Most colours are unsaturated, as in real pictures.
    contrast, level = (1.0, 0.0) if random.random() < 0.4 else (random.uniform(0.15, 0.8), random.uniform(-0.25, 0.25))
    tones = np.clip(np.rint((np.arange(256) - 127.5) * contrast + 127.5 + 255 * level), 0, 255).astype(np.uint8)

    def card(x_m: float, size_m: F64, aside: F64, *, slant: float, see_through: bool) -> Parallelogram:
        """Return a card with a random texture, rotated by at most `slant` rad, opaque only on lines if
        `see_through`. `aside` (2,) is where the viewer sees it on the middle panel, relative to the panel's size.
        """
        share = (x_m - centre_m) / distance_m
        middle = aside * panel_m * (1 - share) + middle_m[1:] * share
        turns = random.uniform(-slant, slant, 2)
        across = size_m[0] * np.array([math.sin(turns[0]), math.cos(turns[0]), 0.0])
        down = size_m[1] * np.array([math.sin(turns[1]), 0.0, -math.cos(turns[1])])
        corner = np.array([x_m, *middle]) - across / 2 - down / 2
        corner[0] -= max(0.0, corner[0] + max(across[0], 0) + max(down[0], 0) - max(front_m, x_m))
        width, height = np.clip(size_m / pixel_m * random.uniform(0.3, 1.0), *TEXELS).astype(int).tolist()
        return Parallelogram(_texture(random, width, height, tones, see_through=see_through), corner, across, down)

    backdrop_m = rear_m * random.uniform(1.0, 1.3)
    size_m = 1.5 * (1 - (backdrop_m - centre_m) / distance_m) * panel_m
    planes = [card(backdrop_m, size_m, np.zeros(2), slant=0.3, see_through=False)]
    for x_m in np.sort(random.uniform(rear_m, front_m, int(random.integers(3, 12)))).tolist():
        wide_m = stack.width_m * math.exp(random.uniform(math.log(0.06), math.log(0.6)))
        wide_m = min(wide_m, 0.8 * (distance_m - x_m))
        size_m = wide_m * np.array([1.0, random.uniform(0.4, 1.0)])
        slant, see_through = random.choice([0.2, 1.2]), random.random() < 0.3
        planes.append(card(x_m, size_m, random.uniform(-0.5, 0.5, 2), slant=slant, see_through=see_through))
    return tuple(planes)


def _texture(random: Random, width: int, height: int, tones: U8, *, see_through: bool) -> U8:
    """Return a random RGBA texture of noise whose power decreases with frequency, or of discs and boxes. `tones` (256,)
    is applied to all colours. If `see_through`, only random lines are opaque.
    """
    picture = np.full((height, width, 4), 255, np.uint8)
    if random.random() < 0.5:
        fu, fv = np.fft.rfftfreq(width), np.fft.fftfreq(height)[:, None]
        gain = 1 / np.maximum(np.hypot(fu, fv), 1 / max(width, height)) ** random.uniform(0.3, 2.0)
        phases = np.exp(2j * np.pi * random.random((3, height, width // 2 + 1)))
        waves = np.fft.irfft2(gain * phases, s=(height, width)).transpose(1, 2, 0)
        waves *= random.uniform(0.08, 0.35) / (waves.std() + 1e-9)
        grey = random.random()
        waves = random.random(3) * 0.5 + 0.25 + grey * waves.mean(axis=-1, keepdims=True) + (1 - grey) * waves
        picture[..., :3] = np.clip(np.rint(255 * waves), 0, 255)
    else:
        for _ in range(int(random.integers(10, 60))):
            colour = [int(c) for c in np.clip(random.integers(-60, 316, 3), 0, 255)] + [255]
            place, size = random.integers((width, height)), int(max(width, height) * 0.3 * random.random() ** 2) + 1
            if random.random() < 0.5:
                cv2.circle(picture, place.tolist(), size, colour, -1, cv2.LINE_AA)
            else:
                cv2.rectangle(picture, place.tolist(), (place + size).tolist(), colour, -1)
    if see_through:
        lines = np.zeros((height, width), np.uint8)
        for _ in range(int(random.integers(3, 25))):
            start, end = random.integers((width, height), size=(2, 2)).tolist()
            cv2.line(lines, start, end, 255, int(random.integers(1, 4)), cv2.LINE_AA)
        picture[..., 3] = lines
    picture[..., :3] = tones[picture[..., :3]]
    return picture
