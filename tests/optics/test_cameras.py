"""Pictures of any cameras as eyes see them that look at the middle, against a plain tracer; likely mistakes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.optics.cameras import as_cameras, doubts, looking_at_origin
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 320, 180)
HEAD_ON = np.array([[0.7, 0.0, 0.0]])


def scene_at(points_m: np.ndarray) -> np.ndarray:
    """(h, w, 3) colours of a wavy picture that hangs 1 cm before the stack's middle, at points of that plane."""
    y, z = points_m[..., 1], points_m[..., 2]
    waves = [np.sin(60 * y + k) * np.cos(45 * z - k) for k in range(3)]
    return np.rint(127 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)


def taken(matrix: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """A pinhole camera's view of the scene: a plain tracer."""
    u, v = np.meshgrid(np.arange(width_px) + 0.5, np.arange(height_px) + 0.5)
    place = -np.linalg.solve(matrix[:, :3], matrix[:, 3])
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(matrix[:, :3]).T
    return scene_at(place + rays * ((0.01 - place[0]) / rays[..., :1]))


def parallel(eye_m: Any, focal_px: float = 330.0, *, centre_px: tuple[float, float] = (200, 150)) -> np.ndarray:
    """A camera whose axis is the stack's: it looks along -x, +u to the viewer's right."""
    axes = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
    k = np.array([[focal_px, 0, centre_px[0]], [0, focal_px, centre_px[1]], [0, 0, 1]])
    return k @ np.column_stack([axes, -axes @ np.asarray(eye_m)])


def seen_at(matrix: np.ndarray, points: Any) -> np.ndarray:
    """(n, 2) pixels of points (n, 3)."""
    weighted = np.column_stack([points, np.ones(len(points))]) @ matrix.T
    assert (weighted[:, 2] > 0).all()
    return weighted[:, :2] / weighted[:, 2:]


EYES_M = np.array([[0.7, -0.05, 0.02], [0.6, 0.06, 0.1]])
CORNERS_M = [(x, 0.2592 * y, 0.1458 * z) for x in STACK.x_m for y in (-1, 1) for z in (-1, 1)]


@pytest.mark.parametrize(
    ("focals_px", "size", "shows_panels"),
    [((250.0, 260.0), (268, 153), True), ((330.0, 330.0), (294, 168), False), ((900.0, 700.0), (140, 80), False)],
)
def test_resampled_pictures_are_what_aimed_cameras_take(
    focals_px: tuple[float, float], size: tuple[int, int], shows_panels: bool
) -> None:
    cameras = [parallel(eye, focal) for eye, focal in zip(EYES_M, focals_px, strict=True)]
    pictures = [taken(matrix, 400, 300) for matrix in cameras]
    turned, fov_deg = looking_at_origin(pictures, np.array(cameras), EYES_M, STACK)
    views = [image_from_stack(eye, width_px=size[0], height_px=size[1], fov_deg=fov_deg) for eye in EYES_M]
    for picture, matrix in zip(turned, views, strict=True):
        assert picture.shape[1::-1] == size
        assert np.abs(picture.astype(int) - taken(matrix, *size)).max() <= 3
    # They show the panels, or as much of these as all originals show, and nothing else.
    edges = np.array([(u, v, 1.0) for u in (0, size[0]) for v in (0, size[1])])
    kept = np.concatenate([
        seen_at(camera, eye_m + edges @ np.linalg.inv(matrix[:, :3]).T)
        for camera, matrix, eye_m in zip(cameras, views, EYES_M, strict=True)
    ])  # fmt: skip
    beyond_px = np.abs(kept - (200, 150)).max(axis=0) - (200, 150)
    panels = np.concatenate([seen_at(matrix, CORNERS_M) for matrix in views])
    hidden_px = np.abs(panels - np.array(size) / 2).max(axis=0) - np.array(size) / 2
    assert beyond_px.max() < 1
    if shows_panels:
        assert hidden_px == pytest.approx([0, 0], abs=0.6)
    else:
        assert beyond_px.max() > -0.3 and (hidden_px > 5).all()


def test_a_shifted_camera_keeps_its_scale_and_intensities_their_range() -> None:
    camera = parallel(HEAD_ON[0], centre_px=(220, 140))
    noise = np.random.default_rng(1).integers(0, 2, (300, 400, 3)).astype(np.float32)
    (turned,), fov_deg = looking_at_origin([noise], camera[None], HEAD_ON, STACK)
    assert turned.shape == (150, 267, 3)  # of the front panel, 64 cm away, by a focal length of 330 pixels
    assert fov_deg == pytest.approx(2 * math.degrees(math.atan(0.2592 / 0.64)))
    assert turned.dtype == np.float32 and turned.min() == 0.0 and turned.max() == 1.0
    turned = looking_at_origin([noise], parallel(HEAD_ON[0], 12.0, centre_px=(220, 140))[None], HEAD_ON, STACK)[0][0]
    assert turned.shape == (16, 16, 3)


def test_aimed_pictures_are_returned_as_they_are() -> None:
    for off_px, is_same in ((0.0, True), (1e-4, True), (0.01, False)):
        camera = parallel(HEAD_ON[0], 346.41016, centre_px=(200 + off_px, 150))
        pictures = [taken(camera, 400, 300)]
        (turned,), fov_deg = looking_at_origin(pictures, camera[None], HEAD_ON, STACK)
        assert (turned is pictures[0]) == is_same
        assert not is_same or fov_deg == pytest.approx(60.0, abs=1e-6) == round(fov_deg, 9)


@pytest.mark.parametrize(
    ("aims", "named"),
    [
        ((200, 500), "right"),
        ((-1, 200), "left"),
        ((200, 200, 401), r"3\."),
        ((200, 199, "away"), r"3\."),
    ],
)
def test_a_camera_that_does_not_show_the_centre_is_named(aims: tuple[Any, ...], named: str) -> None:
    """One of them looks away, and the centre is behind it."""
    cameras = [parallel(HEAD_ON[0], centre_px=(200 if aim == "away" else aim, 150)) for aim in aims]
    if "away" in aims:
        turned = cameras[-1][:, :3] @ np.diag([-1, -1, 1])
        cameras[-1] = np.column_stack([turned, -turned @ HEAD_ON[0]])
    matrices, eyes_m = as_cameras(cameras, count=len(aims))
    pictures = [np.zeros((300, 400, 3), np.uint8)] * len(aims)
    with pytest.raises(ValueError, match=f"the {named} picture does not show the centre"):
        looking_at_origin(pictures, matrices, eyes_m, STACK)


def test_matrices_of_any_sign_and_scale_are_cameras_in_a_place() -> None:
    given = [scale * parallel(eye) for scale, eye in zip((1.0, -2.5), EYES_M, strict=True)]
    cameras, places_m = as_cameras([matrix.tolist() for matrix in given])
    assert places_m.tolist() == EYES_M.tolist()
    np.testing.assert_allclose(cameras[1], 2.5 * parallel(EYES_M[1]))
    assert (cameras @ [0.0, 0.0, 0.0, 1.0])[:, 2] == pytest.approx([0.7, 1.5])


@pytest.mark.parametrize(
    ("matrices", "count", "told"),
    [
        (np.zeros((2, 4, 4)), 2, "must be two 3x4 matrices"),
        (np.zeros((2, 3, 4)), 3, "must be 3 3x4 matrices"),
        ("cameras", 2, "must be two 3x4 matrices"),
        ([parallel(HEAD_ON[0]), np.full((3, 4), np.nan)], 2, "must be two 3x4 matrices"),
        ([parallel(HEAD_ON[0]), np.eye(3, 4) * (1, 1, 0, 0)], 2, "3x3 block is invertible"),
    ],
)
def test_anything_but_cameras_is_refused(matrices: Any, count: int, told: str) -> None:
    with pytest.raises(ValueError, match=told):
        as_cameras(matrices, count=count)


def pair(*, right_m: float = 0.0315) -> F64:
    return np.array([[0.6, -right_m, 0.0], [0.6, right_m, 0.0]])


@pytest.mark.parametrize(
    ("eyes_m", "fov_deg", "size", "told"),
    [
        (pair(), 40.0, (320, 180), []),
        (pair(), 3.15, (320, 180), []),
        (pair(), 3.14, (320, 180), ["3.14 degrees looks like radians; did you mean 179.9 degrees?"]),
        (pair(right_m=-0.0315), 40.0, (320, 180), ["the left eye is to the right of the right eye"]),
        (np.concatenate([pair(), pair(right_m=-0.0315)]), 40.0, (320, 180), ["the left eye is to the right"]),
        (np.concatenate([pair(), pair()[:1]]), 40.0, (320, 180), []),
        (pair(right_m=0.0), 54.5, (320, 180), []),
        (pair(right_m=0.0), 57.0, (320, 180), ["39% of a picture that is 57 degrees wide"]),
        (pair(right_m=0.0), 46.0, (320, 240), []),
        (pair(right_m=0.0), 50.0, (320, 240), ["34% of a picture that is 50 degrees wide"]),
        (np.array([[0.6, 0.0, 0.0], [0.6, 0.4, 0.0], [0.6, 0.0, 0.0]]), 51.0, (320, 180), ["49% of a picture"]),
        (np.array([[0.05, 0.05, 0.0]]), 140.0, (320, 180), ["% of a picture"]),
    ],
)
def test_likely_mistakes_are_told(eyes_m: F64, fov_deg: float, size: tuple[int, int], told: list[str]) -> None:
    """Panels of 16:9 fill two thirds of a picture of 16:9 at 55.8 degrees, and of a picture of 4:3 at 48.6 degrees."""
    found = doubts(eyes_m, replace(STACK, x_m=(-0.03, 0.0, 0.01)), fov_deg=fov_deg, size=size)
    assert len(found) == len(told), found
    assert all(part in line for part, line in zip(told, found, strict=True)), found
