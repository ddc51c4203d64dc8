"""Tests maps between planes and between pixel grids."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runtime.optics.rect import PixelRect, union
from runtime.optics.stack import PanelStack, Plane, between_pixel_centres
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks

PLACES = floats(-0.1, 0.02)


def applied(matrix: np.ndarray, *point: float) -> np.ndarray:
    u, v, w = matrix @ [*point, 1.0]
    return np.array([u / w, v / w])


@given(eyes(), PLACES, PLACES, floats(-0.3, 0.3), floats(-0.3, 0.3))
def test_a_projected_point_is_where_the_eyes_ray_meets_the_plane(
    eye: np.ndarray, from_x: float, to_x: float, y: float, z: float
) -> None:
    direction = reference.subtract((from_x, y, z), tuple(eye))
    assume(direction[0] != 0.0)
    hit = reference.hit_plane(tuple(eye), direction, to_x)
    scale, shift = Plane(from_x).scale_shift_to(Plane(to_x), eye)
    np.testing.assert_allclose(np.array([y, z]) * scale + shift, hit[1:], atol=1e-12)
    np.testing.assert_allclose(applied(Plane(from_x).to(Plane(to_x), eye), y, z), hit[1:], atol=1e-12)


@given(eyes(), PLACES, PLACES, PLACES)
def test_a_way_over_a_third_plane_is_the_direct_one(eye: np.ndarray, a: float, b: float, c: float) -> None:
    over = Plane(b).to(Plane(c), eye) @ Plane(a).to(Plane(b), eye)
    np.testing.assert_allclose(over, Plane(a).to(Plane(c), eye), atol=1e-10)
    np.testing.assert_allclose(Plane(b).to(Plane(a), eye) @ Plane(a).to(Plane(b), eye), np.eye(3), atol=1e-10)


def test_an_eye_in_the_plane_has_no_way_through_it() -> None:
    with pytest.raises(ValueError, match="cannot see through"):
        Plane(0.03).scale_shift_to(Plane(0.0), [0.03, 0.0, 0.0])
    with pytest.raises(ValueError, match="cannot see through"):
        Plane(0.03).to(Plane(0.0), [[0.6, 0.0, 0.0], [0.03, 0.1, 0.0]])


@given(eyes(), eyes(), stacks())
def test_several_eyes_are_projected_as_each_of_them(one: np.ndarray, other: np.ndarray, stack: PanelStack) -> None:
    rear, front = stack.panel(0), stack.panel(stack.count - 1)
    assert np.array_equal(rear.to(front, [one, other]), [rear.to(front, one), rear.to(front, other)])


@given(eyes(), stacks(), floats(0, 1), floats(0, 1))
def test_a_pixel_is_projected_as_its_point(eye: np.ndarray, stack: PanelStack, a: float, b: float) -> None:
    rear, front = stack.panel(0), stack.panel(stack.count - 1)
    u, v = a * stack.width_px, b * stack.height_px
    point = rear.plane.to(front.plane, eye) @ rear.plane_from_raster() @ [u, v, 1.0]
    np.testing.assert_allclose(front.plane_from_raster() @ [*applied(rear.to(front, eye), u, v), 1.0], point, atol=1e-9)


@given(eyes(), stacks(), st.integers(1, 7), st.integers(1, 7))
def test_a_cropped_raster_is_projected_from_its_own_corner(
    eye: np.ndarray, stack: PanelStack, left: int, top: int
) -> None:
    rear, front = stack.panel(0), stack.panel(stack.count - 1)
    cropped = PixelRect(left, top, left + 8, top + 8).cut(rear)
    np.testing.assert_allclose(
        applied(cropped.to(front, eye), 2.5, 3.5), applied(rear.to(front, eye), left + 2.5, top + 3.5), atol=1e-8
    )
    for one, other in ((cropped, front), (front, cropped)):  # in plain floats
        np.testing.assert_allclose(one.to_from(other, eye.tolist()), one.to(other, eye), rtol=1e-9, atol=1e-9)


@given(eyes(), eyes(), stacks())
def test_there_and_back_are_two_projections(old: np.ndarray, new: np.ndarray, stack: PanelStack) -> None:
    rear, via = stack.panel(0), stack.panel(stack.count - 1)
    there_and_back = rear.to_and_back(via.plane, old_m=old.tolist(), step_m=(new - old).tolist())
    np.testing.assert_allclose(there_and_back, via.to(rear, old) @ rear.to(via, new), rtol=1e-7, atol=1e-7)


@given(eyes(), eyes(), stacks())
def test_there_and_back_without_a_step_or_a_way_moves_no_bit(
    old: np.ndarray, new: np.ndarray, stack: PanelStack
) -> None:
    rear, front, still = stack.panel(0), stack.panel(stack.count - 1), [0.0, 0.0, 0.0]
    assert np.array_equal(rear.to_and_back(front.plane, old_m=old.tolist(), step_m=still), np.eye(3))
    step = (new - old).tolist()
    assert np.array_equal(rear.to_and_back(rear.plane, old_m=old.tolist(), step_m=step), np.eye(3))


@given(floats(0.5, 2.0), floats(-4.0, 4.0), floats(-4.0, 4.0), st.integers(0, 7), st.integers(0, 7))
def test_opencv_finds_the_pixel_centre_that_a_homography_names(
    scale: float, right: float, down: float, column: int, row: int
) -> None:
    source_from_target = np.array([[scale, 0.0, right], [0.0, scale, down], [0.0, 0.0, 1.0]])
    rows, columns = np.mgrid[:8, :8].astype(np.float32)
    found = [
        cv2.warpPerspective(
            ramp,
            between_pixel_centres(source_from_target),
            (8, 8),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        )[row, column]
        for ramp in (columns, rows)
    ]
    expected = np.clip(applied(source_from_target, column + 0.5, row + 0.5) - 0.5, 0, 7)
    np.testing.assert_allclose(found, expected, atol=1 / 32 + 1e-6)  # OpenCV's positions are multiples of 1/32


@pytest.mark.parametrize(
    ("size_px", "by", "expected"),
    [((1920, 1080), 3, (640, 360)), ((10, 7), 4, (2, 2)), ((3, 2), 8, (1, 1)), ((11, 5), 1, (11, 5))],
)
def test_a_reduced_stack_has_at_least_one_pixel(size_px: tuple[int, int], by: int, expected: tuple[int, int]) -> None:
    whole = PanelStack(0.5, 0.3, (-0.06, 0.06), *size_px, colour=(True, False))
    assert whole.reduced(by) == PanelStack(0.5, 0.3, (-0.06, 0.06), *expected, colour=(True, False))
    assert [whole.is_grey(n) for n in (0, 1)] == [False, True] and not PanelStack(1, 1, (0.0,), 1, 1).is_grey(0)


@pytest.mark.parametrize(
    ("x_m", "is_even"),
    [
        ((0.0,), True),
        ((0.0, 0.1), True),
        ((0.0, 0.1, 0.216), True),
        ((0.0, 0.1, 0.217), False),
        ((0.0, 0.117, 0.217), False),
    ],
)
def test_gaps_that_differ_by_up_to_15_percent_are_even(x_m: tuple[float, ...], is_even: bool) -> None:
    assert PanelStack(0.5, 0.3, x_m, 64, 36).is_evenly_spaced == is_even


@given(st.integers(-2, 6), st.integers(-2, 6), st.integers(-2, 8), st.integers(-2, 8), st.integers(1, 4))
def test_a_rectangle_and_those_beside_it_cover_a_raster_once(u0: int, v0: int, u1: int, v1: int, rows: int) -> None:
    box = PixelRect(*np.clip([u0, v0, u1, v1], 0, 6).tolist())
    covered = np.zeros((6, 6), int)
    beside = box.beside(width_px=6, height_px=6)
    for part in [*box.in_rows(rows), *beside]:
        covered[part.slices] += 1
    assert all(part.width_px and part.height_px for part in beside)
    filled = box.u1 > box.u0 and box.v1 > box.v0
    assert (covered == 1).all()
    assert all(part.height_px <= rows for part in box.in_rows(rows))
    assert (box.width_px, box.height_px) == (max(box.u1 - box.u0, 0), max(box.v1 - box.v0, 0))
    around = union([PixelRect(1, 5, 3, 6), box, PixelRect(4, 9, 4, 12)])
    both = (min(1, box.u0), min(5, box.v0), max(3, box.u1), max(6, box.v1))
    assert around.corners == (both if filled else (1, 5, 3, 6)) and union([]).corners == (0, 0, 0, 0)
