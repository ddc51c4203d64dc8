"""Tests that the movement of a face is measured to a fraction of a pixel, on points that move with the head."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from runtime.eyes.face_flow import RIGID, FaceFlow
from runtime.eyes.pupils import Pupils, find_eyes
from runtime.records import F64, U8
from tests.eyes.scene import camera, eileen, grace, scene

MOUTH_CORNERS = [61, 291]


def found(picture: U8) -> Pupils:
    pupils = find_eyes(np.ascontiguousarray(picture))
    assert pupils is not None
    return pupils


def test_rigid_points_lie_on_both_halves_of_the_face_above_the_mouth() -> None:
    apart = np.zeros((len(RIGID), len(RIGID)))
    for picture in (eileen().picture, grace().picture):
        face, mirrored = found(picture), found(picture[:, ::-1])
        mesh, reflected = face.mesh_px[RIGID], mirrored.mesh_px[RIGID] * [-1, 1, 1] + [picture.shape[1], 0, 0]
        apart += np.linalg.norm(mesh[:, None] - reflected, axis=2) / face.eye_distance_px / 2
        assert (mesh[:, 1] < face.mesh_px[MOUTH_CORNERS, 1].min()).all()
    assert apart.min(axis=1).max() < 0.08 and len(set(RIGID.tolist())) == len(RIGID) > 50


def moved(before: U8, after: U8, mesh: F64, guess: F64, *, eye_distance: float) -> F64 | None:
    flow = FaceFlow()
    flow.remember(before, mesh, eye_distance)
    return flow.moved(after, guess)


@pytest.mark.parametrize("distance_m", [0.4, 1.0])
@pytest.mark.parametrize(("shift_px", "turn_deg", "scale"), [((3.3, -1.7), 0.0, 1.0), ((-2.0, 4.5), 4.0, 1.04)])
def test_a_face_s_movement_is_measured_precisely(
    distance_m: float, shift_px: tuple[float, float], turn_deg: float, scale: float
) -> None:
    """The guess of the face's new place is off by two pixels."""
    before, _, _ = scene(np.array([0.05, 0.02, distance_m]), intrinsics=camera(640, 480, 65.0))
    face = found(before)
    matrix = cv2.getRotationMatrix2D((320.0, 240.0), turn_deg, scale)
    matrix[:, 2] += shift_px
    centres = matrix.copy()
    centres[:, 2] += matrix[:, :2] @ [0.5, 0.5] - 0.5
    after = np.asarray(cv2.warpAffine(before, centres, (640, 480), borderMode=cv2.BORDER_REPLICATE), np.uint8)
    true_px = face.mesh_px[:, :2] @ matrix[:, :2].T + matrix[:, 2]
    guess = face.mesh_px * [0, 0, 1] + np.pad(true_px, ((0, 0), (0, 1))) + np.array([2.0, -1.0, 0.0])
    measured = moved(before, after, face.mesh_px, guess, eye_distance=face.eye_distance_px)
    assert measured is not None
    off_px = face.mesh_px[:, :2] @ measured[:, :2].T + measured[:, 2] - true_px
    assert np.abs(off_px[RIGID]).max() < 0.006 * face.eye_distance_px


def test_no_movement_is_measured_where_the_face_is_gone() -> None:
    before, _, _ = scene(np.array([0.05, 0.02, 0.6]), intrinsics=camera(640, 480, 65.0))
    face = found(before)
    noise = np.random.default_rng(1).integers(0, 255, before.shape, np.uint8)
    for after in (np.full_like(before, 120), noise):
        assert moved(before, after, face.mesh_px, face.mesh_px, eye_distance=face.eye_distance_px) is None
