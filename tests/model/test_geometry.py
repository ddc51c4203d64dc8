"""Boxes, rays and homographies of a solution, in numbers that can be checked by hand.

The panels have pixels of 1 mm and gaps of 100 mm, and the eyes are 500 mm in front of the middle panel. So a ray that
crosses the middle panel at y crosses the front panel at 0.8·y + 0.2·e and the rear one at 1.2·y - 0.2·e.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike

from runtime.model.geometry import Geometry, RaySets, TargetView, geometry_of, inverse, taper, visible_boxes
from runtime.model.job import drawn_views
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F64

STACK = PanelStack(0.4, 0.2, (-0.1, 0.0, 0.1), 400, 200)
EYES = np.array([[0.5, -0.05, 0.0], [0.5, 0.05, 0.0]])
WHOLE = PixelRect(0, 0, 400, 200)
PICTURE = np.zeros((200, 400, 3), np.uint8)


def geometry(
    boxes: PixelRect = WHOLE, *, eyes_m: F64 = EYES, stack: PanelStack = STACK, picture: Any = PICTURE, **more: Any
) -> Geometry:
    views = drawn_views([picture] * len(eyes_m), stack)
    return geometry_of(stack, eyes_m, views, boxes=(boxes,) * stack.count, **more)


def mapped(matrix: F64, at: ArrayLike) -> list[float]:
    x, y, w = matrix @ (*np.asarray(at, float), 1.0)
    return [x / w, y / w]


@pytest.mark.parametrize(
    ("eyes_m", "boxes"),
    [
        # On the middle panel, y from -175.3 to 175.3 mm and z from -83.3 to 83.3 mm is visible. Two pixels are added,
        # and the result is widened to multiples of 8.
        (EYES * (1, 1.04, 1), [(0, 0, 400, 200), (16, 8, 384, 192), (40, 24, 360, 176)]),
        # From far above and far below, a single line is seen through all panels: boxes have at least 32 pixels.
        (EYES * (1, 1.04, 1) + (0, 0, 0.5), [(0, 168, 400, 200), (16, 84, 384, 116), (40, 0, 360, 32)]),
        (EYES * (1, 1.04, 1) - (0, 0, 0.5), [(0, 0, 400, 32), (16, 84, 384, 116), (40, 168, 360, 200)]),
    ],
)
def test_boxes_hold_what_an_eye_sees_through_all_panels(eyes_m: F64, boxes: list[tuple[int, ...]]) -> None:
    assert [box.corners for box in visible_boxes(eyes_m, STACK)] == boxes


def test_boxes_of_small_panels_are_whole() -> None:
    small = replace(STACK, width_px=20, height_px=10)
    assert [box.corners for box in visible_boxes(EYES + np.array([0, 0, 0.5]), small)] == [(0, 0, 20, 10)] * 3


@pytest.mark.parametrize(
    ("first", "last", "over_px", "weights"),
    [
        (10, 30, 4.0, [0.0, 0.0, 0.25, 0.5, 1.0, 1.0, 0.25, 0.0, 0.0]),
        (0, 30, 4.0, [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.25, 0.0, 0.0]),  # the panel's edge
        (10, 40, 4.0, [0.0, 0.0, 0.25, 0.5, 1.0, 1.0, 1.0, 1.0, 1.0]),
        (10, 30, 0.0, [1.0] * 9),
    ],
)
def test_weights_rise_from_a_window_s_edges(first: int, last: int, over_px: float, weights: list[float]) -> None:
    at_px = np.array([0.0, 10.0, 11.0, 12.0, 14.0, 26.0, 29.0, 30.0, 39.0])
    assert taper(at_px, first, last, 40, over_px) == pytest.approx(np.array(weights))


def test_rays_fade_over_a_sixth_of_the_window_s_taper() -> None:
    box, kept = PixelRect(40, 0, 200, 100), PixelRect(60, 0, 180, 96)
    across, down = geometry(box, kept=kept, taper_px=(60.0, 24.0)).tapers()
    assert across[[0, 4, 9, 10, -11, -1]] == pytest.approx([0.05, 0.45, 0.95, 1.0, 1.0, 0.05])
    assert down[[0, 91, 92, -1]] == pytest.approx([1.0, 1.0, 0.875, 0.125])
    assert [(weights == 1.0).all() for weights in geometry(box, kept=kept).tapers()] == [True, True]
    _, down = geometry(PixelRect(40, 20, 200, 120), kept=PixelRect(60, 30, 180, 110), taper_px=(60.0, 24.0)).tapers()
    assert down[[0, 3, 4, -5, -1]] == pytest.approx([0.125, 0.875, 1.0, 1.0, 0.125])
    # Pixel (u, v) of a leaning picture is at (u, v) / (1 + (u + v) / 1000).
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.001, 0.001, 1.0]])
    leaning = TargetView(PICTURE, STACK.panel(1).plane_from_raster() @ lean)
    found = geometry_of(STACK, EYES, [leaning] * 2, boxes=(box,) * 3, kept=kept, taper_px=(60.0, 24.0))
    assert found.rays.corners == (63, 0, 249, 133)
    # At the middle of the rays, the weight is 1, for the range of the compiled loops' numbers.
    assert found.closing_sets().panels_from_rays[..., 2, :] @ (93.0, 66.5, 1.0) == pytest.approx(np.ones((2, 3)))
    across, down = found.tapers()  # of the middle row and column of the rays
    assert across[4:8] == pytest.approx([0.0, 0.035242, 0.117958, 0.200528], abs=1e-6)
    assert down[115:119] == pytest.approx([1.0, 1.0, 0.933647, 0.75559], abs=1e-6)


def test_pixels_of_one_step_follow_their_eye_s_rays_through_every_panel() -> None:
    box = PixelRect(40, 30, 200, 130)
    sets = geometry(box, kept=PixelRect(60, 40, 200, 130)).closing_sets()
    assert (sets.views, sets.turn, sets.turns) == ((0, 1), (0, 0), 1)
    # The first ray is pixel (60, 40), whose centre is at y = -139.5 mm and z = 59.5 mm.
    for view, eye_mm in ((0, -50.0), (1, 50.0)):
        rear, middle, front = (mapped(matrix, (0.5, 0.5)) for matrix in sets.panels_from_rays[view])
        assert middle == pytest.approx([20.5, 10.5])
        assert rear == pytest.approx([-139.5 * 1.2 - 0.2 * eye_mm + 160, 70 - 59.5 * 1.2])
        assert front == pytest.approx([-139.5 * 0.8 + 0.2 * eye_mm + 160, 70 - 59.5 * 0.8])


AHEAD, ASIDE = EYES, np.array([[0.4, 0.3, 0.0], [0.4, 0.3, 0.0]])  # "right" is +y, and (-0.6, 0.8, 0)


@pytest.mark.parametrize(("places", "up"), [("rising", (1, -1)), ("falling", (-1, 1))])
@pytest.mark.parametrize(("eyes_m", "right"), [(AHEAD, (0.0, 1.0, 0.0)), (ASIDE, (-0.6, 0.8, 0.0))])
def test_uncertain_steps_see_alternate_rows_from_moved_heads(
    places: Any, up: tuple[int, int], eyes_m: F64, right: tuple[float, float, float]
) -> None:
    sets = geometry(eyes_m=eyes_m).ray_sets(places, 0.01)
    assert (sets.views, sets.turn, sets.turns) == ((0, 1, 0, 1), (0, 0, 1, 1), 2)
    for number, (view, turn) in enumerate(zip(sets.views, sets.turn, strict=True)):
        eye_m = eyes_m[view] + 0.01 * (1, -1)[turn] * np.array(right) + (0, 0, 0.01 * up[turn])
        y_m, z_m = -0.0995, 0.0395 - 0.001 * turn  # column 100, row 60 or 61
        step_m = np.array([0.0, y_m, z_m]) - eye_m
        hit_m = eye_m + step_m * (0.1 - eye_m[0]) / step_m[0]
        front = mapped(sets.panels_from_rays[number, 2], (100.5, 30.5))
        assert front == pytest.approx([hit_m[1] * 1000 + 200, 100 - hit_m[2] * 1000])
        assert mapped(sets.panels_from_rays[number, 1], (100.5, 30.5)) == pytest.approx([100.5, 60.5 + turn])


@pytest.mark.parametrize("x_m", [(-0.1, 0.0, 0.1), (-0.1, 0.0, 0.05), (-0.05, 0.05, 0.1)])
def test_an_error_below_an_eighth_of_a_pixel_is_ignored(x_m: tuple[float, ...]) -> None:
    """At the rear panel, a fifth of the error is seen."""
    stack, eyes_m = replace(STACK, x_m=x_m), EYES + np.array([x_m[1], 0.0, 0.0])
    for sigma_m, turns in ((0.62e-3, 1), (0.63e-3, 2)):
        assert geometry(stack=stack, eyes_m=eyes_m).ray_sets("rising", sigma_m).turns == turns
    assert (geometry().ray_sets("middle", 0.01).panels_from_rays == geometry().closing_sets().panels_from_rays).all()
    assert geometry(PixelRect(0, 100, 400, 101)).ray_sets("rising", 0.01).turns == 1  # no rows to alternate
    assert geometry(PixelRect(0, 100, 400, 102)).ray_sets("rising", 0.01).turns == 2


@pytest.mark.parametrize(("x_m", "most_m"), [(0.5, 0.1), (0.25, 0.075)])  # 15 cm in front of the front panel
def test_a_head_is_known_to_a_decimetre_and_half_its_distance(x_m: float, most_m: float) -> None:
    def sets(sigma_m: float) -> RaySets:
        return geometry(eyes_m=EYES * (0, 1, 1) + np.array([[x_m, 0, 0], [0.6, 0, 0]])).ray_sets("rising", sigma_m)

    assert sets(most_m + 0.01).panels_from_rays == pytest.approx(sets(most_m).panels_from_rays)
    assert sets(most_m - 0.001).panels_from_rays != pytest.approx(sets(most_m).panels_from_rays)


@pytest.mark.parametrize(
    ("points", "rising", "others"),
    [
        (2, (0, 1), (0, 1, 2, 3)),
        (3, (0, 1, 2, 3), (0, 1, 4, 5)),
        (5, (0, 1, 2, 3, 4, 5), (0, 1, 6, 7, 8, 9)),
    ],
)
def test_points_of_the_pupils_take_turns_beside_the_first(
    points: int, rising: tuple[int, ...], others: tuple[int, ...]
) -> None:
    asked = geometry(eyes_m=np.concatenate([EYES] * points), points=points)
    for places, views in (("rising", rising), ("middle", others), ("falling", others)):
        sets = asked.ray_sets(places, 0.05)  # type: ignore[arg-type]
        assert (sets.views, sets.turn, sets.turns) == (views, (0,) * len(views), 1)
        assert (sets.panels_from_rays[0] == asked.closing_sets().panels_from_rays[0]).all()


def view(scale: float = 1.0, first: tuple[float, float] = (0.0, 0.0), size: tuple[int, int] = (400, 200)) -> TargetView:
    """A picture of pixels `scale` times as large as a panel's, from a panel pixel on."""
    matrix = np.array([[scale, 0.0, first[0]], [0.0, scale, first[1]], [0.0, 0.0, 1.0]])
    return TargetView(np.zeros((*size[::-1], 3), np.uint8), STACK.panel(1).plane_from_raster() @ matrix)


@pytest.mark.parametrize(
    ("views", "kept", "rays"),
    [
        ([view(), view()], (40, 30, 200, 130), (40, 30, 200, 130)),
        ([view(2.0), view(2.0)], (41, 31, 199, 129), (20, 15, 100, 65)),
        ([view(), view(first=(10, -5))], (40, 30, 200, 130), (30, 30, 200, 135)),  # of both eyes
        ([view(first=(10, 20))] * 2, (0, 0, 200, 130), (0, 0, 190, 110)),
        ([view(first=(-300, -150))] * 2, (200, 100, 400, 200), (399, 199, 400, 200)),  # at least one ray
        ([view(first=(300, 150))] * 2, (0, 0, 200, 100), (0, 0, 1, 1)),
        ([view(1 + 1e-9, (1e-8, 0))] * 2, (40, 30, 200, 130), (40, 30, 200, 130)),
    ],
)
def test_rays_are_the_pixels_seen_in_the_kept_part(
    views: list[TargetView], kept: tuple[int, ...], rays: tuple[int, ...]
) -> None:
    found = geometry_of(STACK, EYES, views, boxes=(PixelRect(20, 10, 400, 200),) * 3, kept=PixelRect(*kept))  # type: ignore[arg-type]
    assert found.rays.corners == rays
    for n, one in enumerate(views):
        y_m, z_m = mapped(one.plane_from_picture, (found.rays.u0 + 0.5, found.rays.v0 + 0.5))
        at = mapped(found.middle_from_rays[n], (0.5, 0.5))
        assert at == pytest.approx([y_m * 1000 + 180, 90 - z_m * 1000], abs=1e-3)


@pytest.mark.parametrize(("slope", "rays"), [(0.0047, (0, 0, 200, 100)), (0.0048, (0, 0, 400, 200))])
def test_a_picture_seen_from_almost_along_it_is_used_whole(slope: float, rays: tuple[int, ...]) -> None:
    """The panel's corner has 5 % of the weight of its middle, or less."""
    from_middle = 7 * np.array([[0.03, 0.0, 0.0], [0.0, 0.03, 0.0], [-slope, 0.0, slope * 200 + 1]])
    leaning = TargetView(PICTURE, STACK.panel(1).plane_from_raster() @ np.linalg.inv(from_middle))
    found = geometry_of(STACK, EYES, (leaning, leaning), boxes=(WHOLE,) * 3)
    assert found.rays.corners == rays


def test_pictures_that_lie_on_the_pixels_are_copied() -> None:
    found = geometry_of(STACK, EYES, [view(1 + 1e-9, (5e-7, 0)), view(first=(2e-6, 0))], boxes=(WHOLE,) * 3)
    assert (found.middle_from_rays[0] == np.eye(3)).all()
    assert (found.middle_from_rays[1] != np.eye(3)).any()


def test_pictures_of_two_sizes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"must have one size, but have \[\(200, 390\), \(200, 400\)\]"):
        geometry_of(STACK, EYES, [view(), view(size=(390, 200))], boxes=(WHOLE,) * 3)


@pytest.mark.parametrize(
    "change",
    [
        {"stack": replace(STACK, width_m=0.41)},
        {"eyes_m": EYES + 1e-9},
        {"boxes": (WHOLE, WHOLE, PixelRect(0, 0, 8, 8))},
        {"kept": PixelRect(0, 0, 8, 8)},
        {"rays": PixelRect(0, 0, 8, 8)},
        {"middle_from_rays": geometry().middle_from_rays * 2},
        {"taper_px": (1.0, 0.0)},
        {"points": 2},
    ],
)
def test_any_other_ray_or_box_makes_another_solution(change: dict[str, Any]) -> None:
    assert geometry().is_like(replace(geometry(), eyes_m=EYES.copy()))
    assert not geometry().is_like(replace(geometry(), **change))


def test_rays_that_miss_a_panel_count_an_eighth_without_a_taper() -> None:
    found = [geometry(taper_px=taper_px).missing_weight for taper_px in ((0.0, 0.0), (0.0, 2.0), (2.0, 0.0))]
    assert found == [0.125, 1.0, 1.0]


def test_inverse_homographies_keep_their_sign() -> None:
    matrices = np.array([np.diag([2.0, 4.0, 0.5]), np.diag([2.0, 4.0, -0.5])])
    assert inverse(matrices) == pytest.approx(np.array([np.diag([0.25, 0.125, 1.0]), np.diag([0.25, 0.125, -1.0])]))
