"""Corrections on one raster: what each does to constant pictures and ramps, computed beside it in doubles."""

from __future__ import annotations

from collections.abc import Iterator
from math import erf

import numpy as np
import pytest

from runtime.model.pyramid_level import CENTRE, FRONT, LEAST_SPREAD_PX, MOST_SPREAD, OUTER, REAR, START, PyramidLevel
from runtime.model.rows import RowPool
from runtime.model.transfer import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

STACK = PanelStack(0.48, 0.24, (-0.06, 0.0, 0.06), 96, 48)
WHOLE = (PixelRect(0, 0, 96, 48),) * 3
PAIR = eyes(0.6, 0.02, 0.01)
INNER = (slice(8, 40), slice(16, 80))  # far from every edge


@pytest.fixture
def rows() -> Iterator[RowPool]:
    pool = RowPool(1, width_px=96)
    yield pool
    pool.close()


def level_of(rows: RowPool, *, reduction: int = 1, channels: int = 3, outer: int = START) -> PyramidLevel:
    """A whole raster with even outer panels, seen by both eyes."""
    level = PyramidLevel(STACK, reduction=reduction, rows=rows, channels=channels)
    level.crop(WHOLE, STACK)
    for n in OUTER:
        level.outer[n][...] = outer
    level.project(OUTER, PAIR)
    return level


def want(level: PyramidLevel, left: int, right: int) -> None:
    """Both eyes' pictures, each of one phase sum."""
    width, height = level.size
    level.target = [np.full((height, width, 3), value, np.int16) for value in (left, right)]


def crossing_px(eye_m: np.ndarray, x_m: float) -> np.ndarray:
    """(u, v) pixel of a panel at `x_m` that the eye sees through the middle of the centre panel."""
    t = (x_m - eye_m[0]) / -eye_m[0]
    y_m, z_m = eye_m[1:] + t * (0.0 - eye_m[1:])
    return np.array([(y_m + 0.24) / 0.005, (0.12 - z_m) / 0.005])


@pytest.mark.parametrize("sigma_mm", [30.0, 45.0])
def test_a_spread_is_how_many_pixels_a_panel_moves_for_an_eye_that_is_off_by_one_sigma(
    rows: RowPool, sigma_mm: float
) -> None:
    """In pixels, from millimetres: a thousandth or a thousandfold of it would be none, or the most there is."""
    level = level_of(rows)
    level.set_eye_sigma(PAIR, eye_sigma_mm=sigma_mm)
    middle = PAIR.mean(axis=0)
    for n in OUTER:
        here, axes = crossing_px(middle, STACK.x_m[n]), np.eye(3) * sigma_mm / 1000
        beside, above = (crossing_px(middle + axes[axis], STACK.x_m[n]) - here for axis in (1, 2))
        assert level.spread[n] == pytest.approx((abs(beside[0]), abs(above[1])), rel=1e-9)


def test_spreads_too_small_to_be_felt_are_none_and_there_is_a_largest(rows: RowPool) -> None:
    level = level_of(rows)
    metres = LEAST_SPREAD_PX * 0.005 * 0.6 / 0.06
    level.set_eye_sigma(PAIR, eye_sigma_mm=metres * 1e3 * 0.99)
    assert level.spread == {}
    level.set_eye_sigma(PAIR, eye_sigma_mm=metres * 1e3 * 1.01)
    assert set(level.spread) == set(OUTER)
    level.set_eye_sigma(PAIR, eye_sigma_mm=1e6)
    assert level.spread[FRONT] == (MOST_SPREAD, MOST_SPREAD)


def test_a_coarser_raster_feels_less_of_the_same_doubt(rows: RowPool) -> None:
    fine, coarse = level_of(rows), level_of(rows, reduction=2)
    for level in (fine, coarse):
        level.set_eye_sigma(PAIR, eye_sigma_mm=60.0)
    assert np.array(fine.spread[REAR]) == pytest.approx(2 * np.array(coarse.spread[REAR]))


@pytest.mark.parametrize("panel", OUTER)
@pytest.mark.parametrize("side", [0, 1])
def test_an_outer_panel_is_seen_where_the_eye_s_rays_cross_it(rows: RowPool, panel: int, side: int) -> None:
    level = level_of(rows)
    u, v = np.meshgrid(np.arange(96) + 0.5, np.arange(48) + 0.5)
    level.outer[panel][...] = np.rint(16 * u + 8 * v)[..., None]
    level.project((panel,), PAIR)
    eye_m = PAIR[side]
    t = (STACK.x_m[panel] - eye_m[0]) / -eye_m[0]
    y_m, z_m = u * 0.005 - 0.24, 0.12 - v * 0.005
    there = (eye_m[1] + t * (y_m - eye_m[1]) + 0.24) / 0.005, (0.12 - (eye_m[2] + t * (z_m - eye_m[2]))) / 0.005
    expected = 16 * there[0] + 8 * there[1]
    # A result may begin at a twelfth of a pixel beside its true place.
    assert np.abs(level.seen[panel, side][INNER] - expected[INNER][..., None]).max() < 16 / 12 + 8 / 12 + 1


def test_residuals_are_what_is_left_after_the_best_centre_panel(rows: RowPool) -> None:
    level = level_of(rows)
    for left, right in ((5000, 5400), (5400, 5000), (2 * START - 300, 2 * START - 100), (FULL + 5000, FULL + 5200)):
        want(level, left, right)
        level.update_residuals()
        lacks = np.array([left, right]) - 2 * START
        best = np.clip(lacks.mean(), 0, FULL)
        for side in (0, 1):
            assert np.abs(level.residual[side][INNER] - (lacks[side] - best)).max() <= 1, (left, right)


def slope(wanted: float, floor: float) -> float:
    """Of sin² at a phase sum, 1 where it is steepest: the weight of a ray."""
    part = wanted / FULL % 1
    return floor + (1 - floor) * 4 * part * (1 - part)


@pytest.mark.parametrize("floor", [0.05, 0.25, 1.0])
def test_what_an_eye_lacks_weighs_by_the_slope_there(rows: RowPool, floor: float) -> None:
    level = level_of(rows)
    level.slope_floor = floor
    out = np.empty((48, 96, 3), np.uint8)
    for wanted in ((FULL, 5400), (5400, 2 * FULL), (5000, 6100), (FULL + 300, 2 * FULL - 900), (0, FULL), (0, 0)):
        want(level, *wanted)
        level.update_residuals()
        level.close_centre(out)
        lacks, weights = np.array(wanted) - 2 * START, np.array([slope(one, floor) for one in wanted])
        best = np.clip((weights * lacks).sum() / weights.sum(), 0, FULL)
        for side in (0, 1):
            expected = weights[side] * (lacks[side] - best)
            assert np.abs(level.residual[side][INNER] - expected).max() <= 1, wanted
        assert np.abs(out[INNER] - best / SUBCODE).max() <= 0.51, wanted


@pytest.mark.parametrize("panel", OUTER)
def test_a_correction_is_divided_by_the_mean_weight_of_rays_and_that_is_one_beside_the_centre(
    rows: RowPool, panel: int
) -> None:
    level, wanted, floor, lack = level_of(rows), (FULL + 200, 6100), 0.25, (400, 240)
    level.slope_floor = floor
    want(level, *wanted)
    for side in (0, 1):
        level.residual[side][...] = lack[side]
    level.correct(panel, PAIR, size=0.5, shown=False)
    total, weight = np.zeros(96), np.zeros(96)
    y_m = (np.arange(96) + 0.5) * 0.005 - 0.24
    near_edge = np.zeros(96, bool)
    for side, eye_m in enumerate(PAIR):
        t = -eye_m[0] / (STACK.x_m[panel] - eye_m[0])
        u = (eye_m[1] + t * (y_m - eye_m[1]) + 0.24) / 0.005
        within = (u >= 0) & (u <= 96)
        total += np.where(within, lack[side], 0)
        weight += np.where(within, slope(wanted[side], floor), 1)
        near_edge |= np.minimum(np.abs(u), np.abs(u - 96)) < 0.1
    expected = 0.5 * 2 * total / weight
    assert np.abs(level.outer[panel][24, :, 0] - START - expected)[~near_edge].max() <= 1
    if panel == FRONT:
        assert ((total > 0) & (total < sum(lack))).any(), "where one eye's ray alone crosses the centre"


@pytest.mark.parametrize("sigma_mm", [0.0, 60.0])
def test_rays_that_weigh_alike_are_corrected_for_as_if_none_were_weighed(rows: RowPool, sigma_mm: float) -> None:
    found = []
    for floor in (1.0, 0.25):
        level = level_of(rows)
        level.slope_floor = floor
        want(level, FULL + 500, 2 * FULL - 500)  # as far from white as from black
        level.outer[REAR][:, 48:] += 800
        level.set_eye_sigma(PAIR, eye_sigma_mm=sigma_mm)
        level.project(OUTER, PAIR)
        level.step(FRONT, PAIR, size=0.5, shown=False)
        found.append(level.outer[FRONT][INNER].astype(int))
    assert np.ptp(found[0]) > 100
    assert np.abs(found[0] - found[1]).max() <= 8


@pytest.mark.parametrize("panel", OUTER)
def test_a_correction_adds_what_both_eyes_lack_times_its_size(rows: RowPool, panel: int) -> None:
    for size in (0.5, 1.0):
        level = level_of(rows)
        for side, lack in enumerate((400, 240)):
            level.residual[side][...] = lack
        level.correct(panel, PAIR, size=size, shown=False)
        assert np.abs(level.outer[panel][INNER] - (START + 640 * size)).max() <= 8
        other = REAR if panel == FRONT else FRONT
        assert (level.outer[other] == START).all()


@pytest.mark.parametrize(("lack", "end"), [(3000, FULL), (-3000, 0)])
def test_a_panel_stays_within_its_range(rows: RowPool, lack: int, end: int) -> None:
    level = level_of(rows)
    for side in (0, 1):
        level.residual[side][...] = lack
    for shown in (False, True):
        level.correct(FRONT, PAIR, size=1.0, shown=shown)
        assert (level.outer[FRONT][INNER] == end).all()


def test_what_will_be_shown_is_rounded_to_whole_codes_and_nothing_before(rows: RowPool) -> None:
    for shown in (False, True):
        level = level_of(rows)
        for side in (0, 1):
            level.residual[side][...] = 82
        level.correct(FRONT, PAIR, size=1.0, shown=shown)
        codes = level.outer[FRONT][INNER]
        assert (codes % SUBCODE == 0).all() == shown
        assert np.abs(codes - (START + 160)).max() <= SUBCODE / 2


def test_the_centre_panel_is_the_mean_of_what_both_eyes_lack_in_whole_codes(rows: RowPool) -> None:
    level = level_of(rows)
    out = np.empty((48, 96, 3), np.uint8)
    for left, right in ((5000, 5400), (5000, 5016), (0, 0), (3 * FULL, 3 * FULL)):
        want(level, left, right)
        level.close_centre(out)
        exact = np.clip(((left + right) / 2 - 2 * START) / SUBCODE, 0, 255)
        assert np.abs(out[INNER] - exact).max() <= 0.5, (left, right)


def test_the_centre_closes_half_codes_upwards(rows: RowPool) -> None:
    level = level_of(rows)
    out = np.empty((48, 96, 3), np.uint8)
    want(level, 2 * START + 10 * SUBCODE + SUBCODE // 2, 2 * START + 10 * SUBCODE + SUBCODE // 2)
    level.close_centre(out)
    assert (out[INNER] == 11).all()


def test_a_drawn_panel_is_taken_as_it_is_and_even_beside_it(rows: RowPool) -> None:
    level = level_of(rows)
    codes = np.full((48, 96, 3), 3200, np.int16)
    level.set_panel(REAR, codes, np.array([[1.0, 0, 48.0], [0, 1.0, 0], [0, 0, 1.0]]), shown=False)
    assert (level.outer[REAR][8:40, 4:40] == 3200).all()
    assert (level.outer[REAR][8:40, 56:90] == START).all()
    level.set_panel(REAR, np.full((48, 96, 3), FULL + 500, np.int16), np.eye(3), shown=True)
    assert (level.outer[REAR][INNER] == FULL).all()


def test_a_finer_raster_takes_the_outer_panels_over(rows: RowPool) -> None:
    coarse, fine = level_of(rows, reduction=2), level_of(rows)
    assert coarse.size == (48, 24) and fine.size == (96, 48)
    coarse.outer[REAR][...] = 1003
    coarse.outer[FRONT][...] = 3005
    fine.upsample(coarse, shown=False)
    assert (fine.outer[REAR] == 1003).all() and (fine.outer[FRONT] == 3005).all()
    fine.upsample(coarse, shown=True)
    assert (fine.outer[REAR] == 1008).all() and (fine.outer[FRONT] == 3008).all()


def test_a_coarser_raster_covers_the_same_rectangle(rows: RowPool) -> None:
    boxes = (PixelRect(0, 0, 96, 48), PixelRect(8, 4, 88, 44), PixelRect(0, 0, 96, 48))
    level = PyramidLevel(STACK, reduction=4, rows=rows)
    level.crop(boxes, STACK)
    raster, whole = level.rasters[CENTRE], boxes[CENTRE].cut(STACK.panel(CENTRE))
    assert (raster.left_m, raster.top_m) == (whole.left_m, whole.top_m)
    assert raster.width_px * raster.pitch_u_m == pytest.approx(whole.width_px * whole.pitch_u_m)
    assert raster.height_px * raster.pitch_v_m == pytest.approx(whole.height_px * whole.pitch_v_m)
    assert level.size == (20, 10)


def test_one_channel_is_done_as_three_are(rows: RowPool) -> None:
    one, three = level_of(rows, channels=1), level_of(rows)
    u = np.arange(96, dtype=np.int16) * 20
    for level in (one, three):
        level.outer[REAR][...] = u if level is one else u[:, None]
        level.set_eye_sigma(PAIR, eye_sigma_mm=40.0)
        level.project((REAR,), PAIR)
    for side in (0, 1):
        assert np.array_equal(one.seen[REAR, side], three.seen[REAR, side][..., 1])


def test_unsure_eyes_see_a_blurred_panel_and_sure_ones_a_sharp_one(rows: RowPool) -> None:
    level = level_of(rows)
    level.outer[FRONT][:, 48:] = FULL
    level.project((FRONT,), PAIR)
    sharp = np.abs(np.diff(level.seen[FRONT, 0][24, :, 0].astype(int))).max()
    level.set_eye_sigma(PAIR, eye_sigma_mm=60.0)
    spread = level.spread[FRONT][0]
    level.project((FRONT,), PAIR)
    blurred = np.abs(np.diff(level.seen[FRONT, 0][24, :, 0].astype(int))).max()
    assert sharp > 0.6 * (FULL - START)
    # The steepest place of a step blurred by a normal distribution.
    slope = (FULL - START) / (spread * np.sqrt(2 * np.pi)) * 0.54 / 0.6
    assert blurred == pytest.approx(slope, rel=0.15)


def test_even_panels_that_lack_nothing_are_left_as_they_are_however_unsure_the_eyes(rows: RowPool) -> None:
    level = level_of(rows)
    level.set_eye_sigma(PAIR, eye_sigma_mm=60.0)
    level.project(OUTER, PAIR)
    for side in (0, 1):
        level.residual[side][...] = 0
    for n in OUTER:
        level.correct(n, PAIR, size=1.0, shown=False)
        assert (level.outer[n][INNER] == START).all()


def test_unsure_eyes_have_the_front_panel_follow_what_moves_of_the_rear_one(rows: RowPool) -> None:
    """An edge on the rear panel, blurred as it is seen, again by both panels' moving, again on the way back."""
    level = level_of(rows)
    level.outer[REAR][:, 48:] += 800
    level.set_eye_sigma(PAIR, eye_sigma_mm=60.0)
    sigma = level.spread[REAR][0]
    level.project(OUTER, PAIR)
    for side in (0, 1):
        level.residual[side][...] = 0
    level.correct(FRONT, PAIR, size=0.5, shown=False)
    change = level.outer[FRONT][24, 16:80, 0].astype(float) - START
    place = np.linspace(-40, 40, 2001)
    apart = (PAIR[1, 1] - PAIR[0, 1]) / 2 * 0.12 / 0.6 / 0.005  # an eye's ray from rear to front, columns
    expected = sum(
        400 * (normal((place + side * apart) / (sigma * np.sqrt(2))) - normal((place + side * apart) / (sigma * 2)))
        for side in (-1, 1)
    )
    assert change.max() == pytest.approx(expected.max(), rel=0.12)
    assert change.min() == pytest.approx(expected.min(), rel=0.12)


def normal(value: np.ndarray) -> np.ndarray:
    """The normal distribution function."""
    return np.array([0.5 * (1 + erf(one / np.sqrt(2))) for one in value])


def test_a_drawn_panel_keeps_its_edges_it_is_sampled_by_cubics(rows: RowPool) -> None:
    level = level_of(rows)
    codes = np.full((24, 48, 3), 1000, np.int16)
    codes[:, 24:] = 3000
    level.set_panel(REAR, codes, np.diag([0.5, 0.5, 1.0]), shown=False)
    assert level.outer[REAR][INNER].max() > 3050 and level.outer[REAR][INNER].min() < 950
