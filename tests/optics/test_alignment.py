"""Layers aligned to moved eyes: every ray of the middle meets the same panel values as before."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.optics.alignment import FARTHEST_M, MOST_SCALE, MOST_SHIFT, Alignment, align, reference_plane
from runtime.optics.malus import intensity_from_phase
from runtime.optics.presentation import shown_layers
from runtime.optics.stack import PanelStack
from runtime.records import PanelFrame
from tests.optics import reference
from tests.optics.strategies import eyes, floats, stacks

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 1920, 1080)
HEAD = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])
ANY_STACK = stacks(panels=(2, 8))


@st.composite
def heads(draw: st.DrawFn) -> np.ndarray:
    """Two eyes (2, 3) of a head before the panels, rolled and turned."""
    middle = draw(eyes(nearest_m=0.2, farthest_m=2.0, off_axis_deg=50.0))
    half = np.array([draw(floats(-0.02, 0.02)), draw(floats(-0.04, 0.04)), draw(floats(-0.04, 0.04))])
    return np.array([middle - half, middle + half])


def pixel_of(stack: PanelStack, point: tuple[float, float, float]) -> np.ndarray:
    size = {"width": stack.width_px, "height": stack.height_px}
    return np.array(reference.panel_pixel(point, width_m=stack.width_m, height_m=stack.height_m, **size))


def hit_px(stack: PanelStack, eye_m: np.ndarray, through: tuple[float, float, float], *, panel: int) -> np.ndarray:
    """Panel pixel where the ray from an eye through a point meets the panel; by plain geometry."""
    eye = tuple(map(float, eye_m))
    return pixel_of(stack, reference.hit_plane(eye, reference.subtract(through, eye), stack.x_m[panel]))


def moved_px(matrix: np.ndarray, px: np.ndarray) -> np.ndarray:
    return (matrix @ [*px, 1.0])[:2]


@given(stack=ANY_STACK, old=heads(), new=heads(), y=floats(-0.5, 0.5), z=floats(-0.5, 0.5))
def test_the_ray_from_the_new_midpoint_meets_what_the_old_one_met(
    stack: PanelStack, old: NDArray[np.float64], new: NDArray[np.float64], y: float, z: float
) -> None:
    aligned = align(stack, solved_for_m=old, eyes_m=new)
    assume(not aligned.limited)
    point = (reference_plane(stack).x_m, y * stack.width_m, z * stack.height_m)
    for panel, matrix in enumerate(aligned.solved_from_shown):
        shown = hit_px(stack, new.mean(axis=0), point, panel=panel)
        met = hit_px(stack, old.mean(axis=0), point, panel=panel)
        assert moved_px(matrix, shown) == pytest.approx(met, rel=1e-9, abs=1e-6)


@given(
    stack=ANY_STACK, middle=eyes(), half_m=floats(0.0, 0.04), step=st.tuples(floats(-0.05, 0.05), floats(-0.05, 0.05))
)
def test_a_head_moving_parallel_to_the_panels_is_aligned_exactly(
    stack: PanelStack, middle: NDArray[np.float64], half_m: float, step: tuple[float, float]
) -> None:
    old = middle + np.array([[0.0, -half_m, 0.0], [0.0, half_m, 0.0]])
    new = old + np.array([0.0, *step])
    aligned = align(stack, solved_for_m=old, eyes_m=new)
    assume(not aligned.limited)
    for panel, matrix in enumerate(aligned.solved_from_shown):
        for before, after in zip(old, new, strict=True):
            point = (reference_plane(stack).x_m, 0.1 * stack.width_m, -0.2 * stack.height_m)
            shown, met = (hit_px(stack, eye, point, panel=panel) for eye in (after, before))
            assert moved_px(matrix, shown) == pytest.approx(met, rel=1e-9, abs=1e-6)


@given(stack=ANY_STACK, head=heads())
def test_eyes_that_have_not_moved_change_no_bit(stack: PanelStack, head: NDArray[np.float64]) -> None:
    aligned = align(stack, solved_for_m=head, eyes_m=head.copy())
    assert aligned.limited == ""
    for matrix in aligned.solved_from_shown:
        assert matrix.tobytes() == np.eye(3).tobytes()


@given(stack=ANY_STACK, old=heads(), new=heads())
def test_a_panel_in_the_reference_plane_never_moves(
    stack: PanelStack, old: NDArray[np.float64], new: NDArray[np.float64]
) -> None:
    if stack.count % 2 == 0:
        stack = replace(stack, x_m=stack.x_m[1:])
    matrices = align(stack, solved_for_m=old, eyes_m=new).solved_from_shown
    assert matrices[stack.count // 2].tobytes() == np.eye(3).tobytes()


def test_an_even_number_of_panels_meets_between_the_middle_two() -> None:
    assert reference_plane(PanelStack(0.5, 0.3, (0.01, 0.02, 0.04, 0.09), 64, 36)).x_m == pytest.approx(0.03)
    assert reference_plane(PanelStack(0.5, 0.3, (0.01, 0.02, 0.09), 64, 36)).x_m == 0.02


@given(
    x_m=st.sampled_from([(-0.06, 0.0, 0.06), (-0.05, -0.02, 0.01, 0.05), (-0.03, 0.03)]),
    shift_m=floats(-0.5, 0.5),
    step=st.tuples(floats(-0.5, 1.0), floats(-0.6, 0.6), floats(-0.6, 0.6)),
)
def test_the_origin_along_x_is_anybodys_choice(
    x_m: tuple[float, ...], shift_m: float, step: tuple[float, float, float]
) -> None:
    """At and beyond the limits too: the same stack and the same eyes, counted from elsewhere."""
    stack = PanelStack(0.5184, 0.2916, x_m, 1920, 1080)
    moved = replace(stack, x_m=tuple(x + shift_m for x in x_m))
    aside = np.array([shift_m, 0.0, 0.0])
    here = align(stack, solved_for_m=HEAD, eyes_m=HEAD + step)
    there = align(moved, solved_for_m=HEAD + aside, eyes_m=HEAD + step + aside)
    assert bool(here.limited) == bool(there.limited)
    for a, b in zip(here.solved_from_shown, there.solved_from_shown, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


@pytest.mark.parametrize(
    ("first_m", "second_m", "common_m"),
    [
        ((0.01, 0.02, -0.02), (0.03, 0.01, -0.01), (0.01, 0.01, -0.01)),
        ((0.01, 0.02, -0.02), (0.0, -0.02, 0.03), (0.0, 0.0, 0.0)),
        ((-0.03, 0.0, 0.01), (-0.02, 0.01, 0.01), (-0.02, 0.0, 0.01)),
    ],
)
def test_people_are_followed_as_far_as_all_of_them_move(first_m: Any, second_m: Any, common_m: Any) -> None:
    """Each turns the head as well, which moves no midpoint."""
    people = np.concatenate([HEAD, HEAD + np.array([0.1, 0.4, 0.05])])
    turned = [[0.002, 0, 0.001], [-0.002, 0, -0.001]] * 2
    now = people + np.repeat([first_m, second_m], 2, axis=0) + turned
    aligned, expected = (align(STACK, solved_for_m=people, eyes_m=eyes) for eyes in (now, people + common_m))
    assert same(aligned, expected) and not aligned.limited
    single = HEAD + np.array([0.05, 0.2, 0.025])  # in the middle between them
    assert same(aligned, align(STACK, solved_for_m=single, eyes_m=single + common_m))


# Limits.


def same(a: Alignment, b: Alignment) -> bool:
    return bool(np.allclose(a.solved_from_shown, b.solved_from_shown, rtol=1e-9, atol=1e-6))


@given(stack=ANY_STACK, old=heads(), new=st.lists(st.floats(), min_size=6, max_size=6))
@example(stack=STACK, old=HEAD, new=[1e308] * 6)
@example(stack=STACK, old=HEAD, new=[FARTHEST_M, 0.0, 0.0] * 2)
@example(stack=STACK, old=HEAD, new=[0.06, 0.0, 0.0] * 2)
def test_no_eyes_whatever_give_more_than_the_limits(stack: Any, old: Any, new: Any) -> None:
    aligned = align(stack, solved_for_m=old, eyes_m=np.array(new).reshape(2, 3))
    centre = np.array([stack.width_px / 2, stack.height_px / 2])
    for matrix in aligned.solved_from_shown:
        assert np.isfinite(matrix).all()
        assert 1 / MOST_SCALE - 1e-9 <= matrix[0, 0] == matrix[1, 1] <= MOST_SCALE + 1e-9
        assert (np.abs(moved_px(matrix, centre) - centre) <= 2 * (MOST_SHIFT + 1e-9) * centre).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_eyes_that_are_nowhere_leave_the_layers_as_they_are(bad: float) -> None:
    new = HEAD.copy()
    new[1, 2] = bad
    aligned = align(STACK, solved_for_m=HEAD, eyes_m=new)
    assert all(np.array_equal(matrix, np.eye(3)) for matrix in aligned.solved_from_shown)
    assert "not finite" in aligned.limited
    assert "not finite" in align(STACK, solved_for_m=new, eyes_m=HEAD).limited
    behind = align(STACK, solved_for_m=HEAD - np.array([0.7, 0.0, 0.0]), eyes_m=HEAD)
    assert all(np.array_equal(matrix, np.eye(3)) for matrix in behind.solved_from_shown) and behind.limited


@pytest.mark.parametrize(
    ("side", "x_m", "told"),
    [
        (0, -1.0, "the left eye is -1.06 m from the front panel, but the minimum is 0.01 m"),
        (1, 0.0, "the right eye is -0.06 m from the front panel"),
        (0, 0.06, "the left eye is 0 m from"),
        (1, 0.069, "the right eye is 0.009 m from"),
    ],
)
def test_an_eye_at_the_front_panel_is_held_at_the_nearest_place(side: int, x_m: float, told: str) -> None:
    new = HEAD.copy()
    new[side, 0] = x_m
    aligned = align(STACK, solved_for_m=HEAD, eyes_m=new)
    assert told in aligned.limited
    share = (0.6 - 0.06 - 0.01) / (0.6 - x_m)  # a centimetre in front of the front panel
    nearest = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + share * (1 - 1e-12) * (new - HEAD))
    assert nearest.limited == ""
    assert same(aligned, nearest)


def test_eyes_too_far_off_are_held_where_an_outer_panel_would_leave() -> None:
    beyond = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([0.0, 4.0, 0.0]))
    assert "too far to align panel 0" in beyond.limited and "4 m from the position" in beyond.limited
    assert beyond.solved_from_shown[0][0, 2] == pytest.approx(MOST_SHIFT * 1920)
    assert same(beyond, align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([0.0, 8.0, 0.0])))


@given(stack=ANY_STACK, old=heads(), direction=st.tuples(*[floats(-1.0, 1.0)] * 3), turn=floats(-0.02, 0.02))
def test_at_a_limit_nothing_jumps(
    stack: PanelStack, old: NDArray[np.float64], direction: tuple[float, float, float], turn: float
) -> None:
    """Along a straight way, out to far beyond any limit: a small step of the eyes is a small step of the panels."""
    assume(np.linalg.norm(direction) > 0.1)

    def at(share: float) -> Alignment:
        return align(stack, solved_for_m=old, eyes_m=old + 20.0 * share * np.array([direction, direction]) + turn)

    low, high = 0.0, 1.0
    assume(not at(low).limited and at(high).limited)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (low, middle) if at(middle).limited else (middle, high)
    for inside, outside in zip(at(low).solved_from_shown, at(high).solved_from_shown, strict=True):
        assert inside == pytest.approx(outside, abs=1e-6 * stack.width_px)


# The shown panels.


@pytest.fixture(scope="module")
def layers() -> np.ndarray:
    return np.random.default_rng(5).integers(0, 256, (3, 90, 70, 4), dtype=np.uint8)


def matrix(scale_u: float = 1.0, scale_v: float = 1.0, shift_u: float = 0.0, shift_v: float = 0.0) -> np.ndarray:
    return np.array([[scale_u, 0.0, shift_u], [0.0, scale_v, shift_v], [0.0, 0.0, 1.0]])


def slow_sample(layer: np.ndarray, m: np.ndarray, row: int, column: int) -> np.ndarray:
    """One bilinear sample; texels outside the layer are at rest."""
    u, v = m[0, 0] * (column + 0.5) + m[0, 2] - 0.5, m[1, 1] * (row + 0.5) + m[1, 2] - 0.5
    total = np.zeros(3)
    for y in (int(np.floor(v)), int(np.floor(v)) + 1):
        for x in (int(np.floor(u)), int(np.floor(u)) + 1):
            inside = 0 <= y < layer.shape[0] and 0 <= x < layer.shape[1]
            value = layer[y, x, :3].astype(float) if inside else np.full(3, 128.0)
            total += max(0.0, 1 - abs(u - x)) * max(0.0, 1 - abs(v - y)) * value
    return total


@pytest.mark.parametrize(
    "m",
    [
        matrix(shift_u=3.3, shift_v=-0.7),
        matrix(shift_u=4.0, shift_v=-2.0),
        matrix(1.013, 1.013, -2.2, 0.4),
        matrix(0.9, 0.95, 5.1, 3.0),
        matrix(2.0, 2.0, -35.0, -45.0),
        matrix(0.5, 0.5, 10.0, 10.0),
        matrix(shift_u=-500.0),
        matrix(shift_v=500.0),
    ],
)
def test_a_shown_pixel_is_a_bilinear_sample_and_mid_grey_outside(layers: np.ndarray, m: NDArray[np.float64]) -> None:
    shown = shown_layers(PanelFrame(1, layers, 1, (np.eye(3), np.eye(3), m)))
    assert np.array_equal(shown[:2], layers[:2])
    expected = np.array([[slow_sample(layers[2], m, row, column) for column in range(70)] for row in range(90)])
    assert np.abs(shown[2, ..., :3] - expected).max() <= 0.501


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_all_panels_beside_the_solution_show_half_of_the_light(count: int) -> None:
    shown = shown_layers(PanelFrame(1, np.zeros((count, 8, 8, 4), np.uint8), 1, (matrix(shift_u=500.0),) * count))
    light = intensity_from_phase(shown[:, 4, 4, 0].sum() / 255)
    assert light == pytest.approx(0.5, abs=0.02)


def test_where_nothing_moves_nothing_is_resampled_or_copied(layers: np.ndarray) -> None:
    assert shown_layers(PanelFrame(1, layers, 1)) is layers
    assert shown_layers(PanelFrame(1, layers, 1, (np.eye(3),) * 3, layers[::-1], 1, 0.0)) is layers


def test_the_flat_picture_alone_or_without_a_solution_is_itself(layers: np.ndarray) -> None:
    assert shown_layers(PanelFrame(1, layers, 1, (matrix(shift_u=1.5),) * 3, layers[::-1], 1, 1.0)).base is layers
    flat = layers.copy()
    assert shown_layers(PanelFrame(1, None, 0, (), flat, 1, 0.0)) is flat


def test_the_aligned_solution_is_mixed_with_the_flat_picture_that_never_moves(layers: np.ndarray) -> None:
    flat = layers[::-1].copy()
    m = matrix(1.01, 1.01, 2.25, -1.5)
    aligned = shown_layers(PanelFrame(1, layers, 1, (m,) * 3)).astype(float)
    shown = shown_layers(PanelFrame(1, layers, 1, (m,) * 3, flat, 1, 0.25))
    assert np.abs(shown - (0.75 * aligned + 0.25 * flat))[..., :3].max() <= 0.5 + 0.75 * 0.5


def test_a_frame_without_pictures_or_with_a_general_matrix_is_refused(layers: np.ndarray) -> None:
    with pytest.raises(ValueError, match="flat"):
        shown_layers(PanelFrame(1, None, 0))
    with pytest.raises(ValueError, match="flat"):
        shown_layers(PanelFrame(1, layers, 0, flatness=0.5))
    sheared = np.eye(3)
    sheared[0, 1] = 0.1
    with pytest.raises(ValueError, match="scale and a shift"):
        shown_layers(PanelFrame(1, layers, 0, (sheared,) * 3))
