"""Scenes of textured planes with exact geometry, drawn from any eye straight into a raster."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np

from model_export.textures import BACKDROPS, OBJECTS, Random, glint
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.views import image_from_stack, raster_from_stack
from runtime.records import F32, F64, U8

FINER = 2  # drawn so many times finer and averaged: edges and details are not jagged
TEXELS_MAX = 768


@dataclass(frozen=True, slots=True)
class Plane:
    """A textured parallelogram. Texture (u, v) in [0, 1]² lies at corner + u·across + v·down."""

    texture: U8  # (h, w, 4) RGBA
    corner_m: F64  # (3,) frame `stack`
    across_m: F64  # (3,)
    down_m: F64  # (3,)


Scene = tuple[Plane, ...]


def draw(scene: Scene, eye_m: F64, raster: PlaneRaster) -> U8:
    """(h, w, 3) what an eye sees of a scene through each pixel of a raster.

    The nearest plane wins, by its exact depth in every pixel; half-transparent edges let through what was drawn
    before. What lies behind the eye is not seen.
    """
    width, height = raster.width_px * FINER, raster.height_px * FINER
    finer = PlaneRaster(
        raster.x_m, raster.left_m, raster.top_m, raster.pitch_u_m / FINER, raster.pitch_v_m / FINER, width, height
    )
    return _drawn(scene, raster_from_stack(eye_m, finer), width, height)


def view(scene: Scene, eye_m: F64, *, width_px: int, height_px: int, fov_deg: float) -> U8:
    """(h, w, 3) the picture of an eye that looks at the stack's origin, of a horizontal field of view."""
    width, height = width_px * FINER, height_px * FINER
    projection = image_from_stack(eye_m, width_px=width, height_px=height, fov_deg=fov_deg)
    return _drawn(scene, projection, width, height)


def _drawn(scene: Scene, projection: F64, width: int, height: int) -> U8:
    """A scene through a 3x4 projection (frame `stack` to pixels FINER times as fine as the result's)."""
    picture = np.zeros((height, width, 3), np.float32)
    nearness = np.zeros((height, width), np.float32)  # 1 over the distance: what lies behind the eye has less
    for plane in scene:
        on_raster = projection @ np.vstack(
            [np.column_stack([plane.across_m, plane.down_m, plane.corner_m]), [0.0, 0.0, 1.0]]
        )
        part = _part(on_raster, width, height)
        if part is not None:
            _draw_plane(plane.texture, on_raster, part, picture, nearness)
    smaller = cv2.resize(picture, (width // FINER, height // FINER), interpolation=cv2.INTER_AREA)
    return np.clip(np.rint(smaller), 0, 255).astype(np.uint8)


def _part(raster_from_plane: F64, width: int, height: int) -> tuple[slice, slice] | None:
    """(rows, columns) of a raster that a plane's unit square can cover; None: none, or it is seen from its edge."""
    corners = raster_from_plane @ np.array([[0, 1, 1, 0], [0, 0, 1, 1], [1, 1, 1, 1]], dtype=np.float64)
    area = np.linalg.det(raster_from_plane)
    if not np.isfinite(area) or abs(area) < 1e-12 or (corners[2] <= 0).all():
        return None
    if (corners[2] <= 0).any():  # it reaches behind the eye: anywhere
        return slice(0, height), slice(0, width)
    u, v = corners[:2] / corners[2]
    left, right = max(0, math.floor(u.min()) - 1), min(width, math.ceil(u.max()) + 1)
    top, bottom = max(0, math.floor(v.min()) - 1), min(height, math.ceil(v.max()) + 1)
    return (slice(top, bottom), slice(left, right)) if right > left and bottom > top else None


def _draw_plane(texture: U8, raster_from_plane: F64, part: tuple[slice, slice], picture: F32, nearness: F32) -> None:
    """One plane over what is there, where it is nearer."""
    rows, columns = part
    left, top = columns.start, rows.start
    height, width = texture.shape[:2]
    texels = raster_from_plane @ np.diag([1 / width, 1 / height, 1.0])
    # OpenCV puts pixel centres at integers.
    shifted = shift(-0.5 - left, -0.5 - top) @ texels @ shift(0.5, 0.5)
    drawn = cv2.warpPerspective(texture, shifted, (columns.stop - left, rows.stop - top), flags=cv2.INTER_LINEAR)
    inverse = np.linalg.inv(raster_from_plane)
    u, v = np.arange(left, columns.stop) + 0.5, np.arange(top, rows.stop)[:, None] + 0.5
    # The third coordinate of a pixel taken back on to the plane is 1 over its distance along the projection's axis.
    near = (inverse[2, 0] * u + inverse[2, 1] * v + inverse[2, 2]).astype(np.float32)
    alpha = drawn[..., 3].astype(np.float32) * np.float32(1 / 255)
    alpha *= near >= nearness[part]
    picture[part] += alpha[..., None] * (drawn[..., :3].astype(np.float32) - picture[part])
    np.copyto(nearness[part], near, where=alpha > 0.5)


def random_scene(random: Random, stack: PanelStack, middle_m: F64) -> Scene:
    """A backdrop, objects at many depths around the panels, and highlights, for a viewer about `middle_m`."""
    gap_m = stack.x_m[-1] - stack.x_m[1]
    distance_m = middle_m[0] - stack.x_m[1]
    deep_m = gap_m * math.exp(random.uniform(math.log(0.3), math.log(6.0)))
    rear_m, front_m = -deep_m, min(deep_m, 0.35 * distance_m)
    pixel_m = stack.width_m / stack.width_px / FINER
    planes = [_backdrop(random, stack, middle_m, rear_m * random.uniform(1.0, 1.3), pixel_m)]
    for _ in range(int(random.integers(3, 12))):
        x_m = random.uniform(rear_m, front_m)
        size_m = stack.width_m * math.exp(random.uniform(math.log(0.06), math.log(0.6)))
        size_m = min(size_m, 0.8 * (distance_m - x_m))
        place = _behind(random, stack, middle_m, x_m)
        if random.random() < 0.2:
            planes += _box(random, place, size_m / 2, front_m, pixel_m)
        else:
            slant = random.uniform(0, 1.2) if random.random() < 0.5 else random.uniform(0, 0.2)
            planes.append(_card(random, place, size_m, slant, front_m, pixel_m))
        if random.random() < 0.25:
            # A mirrored lamp lies behind its surface, but is seen through it: drawn last, just before it.
            planes.append(_highlight(random, place + np.array([2e-3 * gap_m, 0, 0]), size_m / 4, pixel_m))
    contrast, level = (1.0, 0.0) if random.random() < 0.4 else (random.uniform(0.15, 0.8), random.uniform(-0.25, 0.25))
    softer = [replace(plane, texture=_softened(plane.texture, contrast, level)) for plane in planes]
    return tuple(sorted(softer, key=lambda plane: float(_centre(plane)[0])))


def _softened(texture: U8, contrast: float, level: float) -> U8:
    """Less contrast, and brighter or darker: most of the world is not saturated."""
    table = np.clip(np.rint((np.arange(256) - 127.5) * contrast + 127.5 + 255 * level), 0, 255).astype(np.uint8)
    result = texture.copy()
    result[..., :3] = table[texture[..., :3]]
    return result


def _centre(plane: Plane) -> F64:
    return np.asarray(plane.corner_m + (plane.across_m + plane.down_m) / 2)


def _behind(random: Random, stack: PanelStack, middle_m: F64, x_m: float) -> F64:
    """A place at depth x that is seen through somewhere on the centre panel."""
    on_panel = np.array([stack.x_m[1], *(random.uniform(-0.5, 0.5, 2) * (stack.width_m, stack.height_m))])
    t = (x_m - on_panel[0]) / (middle_m[0] - on_panel[0])
    return np.asarray(on_panel + t * (middle_m - on_panel))


def _texels(length_m: float, pixel_m: float, random: Random) -> int:
    """As many as the raster has pixels there, or fewer: more would only flicker."""
    return int(np.clip(length_m / pixel_m * random.uniform(0.3, 1.0), 24, TEXELS_MAX))


def _backdrop(random: Random, stack: PanelStack, middle_m: F64, x_m: float, pixel_m: float) -> Plane:
    t = (x_m - stack.x_m[1]) / (middle_m[0] - stack.x_m[1])
    half = 0.75 * (1 - t) * np.array([stack.width_m, stack.height_m])
    centre = middle_m[1:] * t
    texture = random.choice(BACKDROPS)(  # type: ignore[arg-type]
        random, _texels(2 * half[0], pixel_m, random), _texels(2 * half[1], pixel_m, random)
    )
    tilt = random.uniform(-0.3, 0.3, 2) * (random.random() < 0.4)
    across, down = np.array([tilt[0] * half[0], 2 * half[0], 0.0]), np.array([tilt[1] * half[1], 0.0, -2 * half[1]])
    corner = np.array([x_m, *centre]) - across / 2 - down / 2
    # A tilted backdrop must stay behind the panels' front.
    corner[0] = min(corner[0], x_m)
    return Plane(texture, corner, across, down)


def _card(random: Random, place_m: F64, size_m: float, slant: float, front_m: float, pixel_m: float) -> Plane:
    heading, turn, aspect = random.uniform(0, 2 * math.pi), random.uniform(0, 2 * math.pi), random.uniform(0.4, 1.0)
    normal = np.array([math.cos(slant), math.sin(slant) * math.cos(heading), math.sin(slant) * math.sin(heading)])
    side = np.cross([0.0, 0.0, 1.0], normal)
    side = side / np.linalg.norm(side)
    up = np.cross(normal, side)
    if random.random() < 0.5:  # as many things in the world stand upright
        turn = 0.0
    across = (math.cos(turn) * side + math.sin(turn) * up) * size_m
    down = (math.sin(turn) * side - math.cos(turn) * up) * size_m * aspect
    corner = place_m - across / 2 - down / 2
    corner[0] -= max(0.0, _front_of(corner, across, down) - max(front_m, place_m[0]))
    kind = random.choice(OBJECTS)  # type: ignore[arg-type]
    return Plane(
        kind(random, _texels(size_m, pixel_m, random), _texels(size_m * aspect, pixel_m, random)), corner, across, down
    )


def _front_of(corner: F64, across: F64, down: F64) -> float:
    return float(corner[0] + max(across[0], 0) + max(down[0], 0))


def _box(random: Random, place_m: F64, size_m: float, front_m: float, pixel_m: float) -> list[Plane]:
    """The six faces of a cube that stands upright."""
    turn = random.uniform(0, math.pi / 2)
    a = np.array([math.cos(turn), math.sin(turn), 0.0]) * size_m
    b = np.array([-math.sin(turn), math.cos(turn), 0.0]) * size_m
    c = np.array([0.0, 0.0, -size_m])
    start = place_m - (a + b + c) / 2
    start[0] -= max(0.0, start[0] + a[0] + max(b[0], 0) - max(front_m, place_m[0]))
    kind = random.choice(OBJECTS[:5])  # type: ignore[arg-type]
    texels = _texels(size_m, pixel_m, random)
    faces = ((start, a, c), (start + b, a, c), (start, b, c), (start + a, b, c), (start, a, b), (start + c, a, b))
    return [Plane(kind(random, texels, texels), *face) for face in faces]


def _highlight(random: Random, place_m: F64, size_m: float, pixel_m: float) -> Plane:
    texels = _texels(size_m, pixel_m, random)
    across, down = np.array([0.0, size_m, 0.0]), np.array([0.0, 0.0, -size_m])
    return Plane(glint(random, texels, texels), place_m - across / 2 - down / 2, across, down)


def shift(right: float, down: float) -> F64:
    """(3, 3) of pixels."""
    return np.array([[1.0, 0.0, right], [0.0, 1.0, down], [0.0, 0.0, 1.0]])
