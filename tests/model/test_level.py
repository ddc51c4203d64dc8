"""A raster of the panels: what is taken over from the network and from coarser rasters, spreads, closing."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.model.compiled.level import Level
from runtime.model.contract import LEAST_SPREAD_PX
from runtime.model.reprojection import CENTRE, FRONT, MAX_SPREAD_PX, OUTER, REAR, START
from runtime.model.transfer import FULL, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

STACK = PanelStack(0.48, 0.24, (-0.06, 0.0, 0.06), 96, 48)
WHOLE = (PixelRect(0, 0, 96, 48),) * 3
PAIR = eyes(0.6, 0.02, 0.01)
INNER = (slice(8, 40), slice(16, 80))  # far from every edge


def level_of(*, reduction: int = 1, channels: int = 3, sigma_mm: float = 0.0) -> Level:
    """A whole raster with even outer panels, seen by both eyes."""
    level = Level(STACK, reduction=reduction, threads=1, channels=channels)
    level.crop(WHOLE, STACK)
    level.set_eyes(PAIR, eye_sigma_mm=sigma_mm)
    for n in OUTER:
        level.outer[n][...] = START
    level.project(OUTER)
    return level


def ask(level: Level, left: int, right: int) -> None:
    """Both eyes' pictures, each of one phase sum."""
    for image, value in zip(level.target, (left, right), strict=True):
        image[...] = value


def centre_of(level: Level) -> np.ndarray:
    layers = np.zeros((3, 48, 96, 4), np.uint8)
    level.show(layers, WHOLE)
    return layers[CENTRE][..., :3]


def crossing_px(eye_m: np.ndarray, x_m: float) -> np.ndarray:
    """(u, v) pixel of a panel at `x_m` that the eye sees through the middle of the centre panel."""
    t = (x_m - eye_m[0]) / -eye_m[0]
    y_m, z_m = eye_m[1:] + t * (0.0 - eye_m[1:])
    return np.array([(y_m + 0.24) / 0.005, (0.12 - z_m) / 0.005])


@pytest.mark.parametrize("sigma_mm", [30.0, 45.0])
def test_a_spread_is_how_many_pixels_a_panel_moves_for_an_eye_that_is_off_by_one_sigma(sigma_mm: float) -> None:
    """In pixels, from millimetres: a thousandth or a thousandfold of it would be none, or the most there is."""
    level = level_of(sigma_mm=sigma_mm)
    middle = PAIR.mean(axis=0)
    for n in OUTER:
        here, axes = crossing_px(middle, STACK.x_m[n]), np.eye(3) * sigma_mm / 1000
        beside, above = (crossing_px(middle + axes[axis], STACK.x_m[n]) - here for axis in (1, 2))
        assert level.spread[n] == pytest.approx((abs(beside[0]), abs(above[1])), rel=1e-9)


def test_spreads_too_small_to_be_felt_are_none_and_there_is_a_largest() -> None:
    metres = LEAST_SPREAD_PX * 0.005 * 0.6 / 0.06
    assert level_of(sigma_mm=metres * 1e3 * 0.99).spread == {}
    assert set(level_of(sigma_mm=metres * 1e3 * 1.01).spread) == set(OUTER)
    assert level_of(sigma_mm=1e6).spread[FRONT] == (MAX_SPREAD_PX, MAX_SPREAD_PX)


def test_a_coarser_raster_feels_less_of_the_same_doubt() -> None:
    fine, coarse = (level_of(reduction=reduction, sigma_mm=60.0) for reduction in (1, 2))
    assert np.array(fine.spread[REAR]) == pytest.approx(2 * np.array(coarse.spread[REAR]))


def slope(wanted: float, floor: float) -> float:
    """Of sin² at a phase sum, 1 where it is steepest: the weight of a ray."""
    part = wanted / FULL % 1
    return floor + (1 - floor) * 4 * part * (1 - part)


@pytest.mark.parametrize("floor", [0.05, 0.25, 1.0])
def test_the_centre_panel_is_the_mean_of_what_both_eyes_lack_weighed_by_the_slope_there(floor: float) -> None:
    level = level_of()
    level.slope_floor = floor
    for asked in ((FULL, 5400), (5400, 2 * FULL), (5000, 6100), (FULL + 300, 2 * FULL - 900), (0, FULL), (0, 0)):
        ask(level, *asked)
        lacks, weights = np.array(asked) - 2 * START, np.array([slope(one, floor) for one in asked])
        best = np.clip((weights * lacks).sum() / weights.sum(), 0, FULL)
        assert np.abs(centre_of(level)[INNER] - best / SUBCODE).max() <= 0.51, asked


def test_the_centre_closes_half_codes_upwards() -> None:
    level = level_of()
    ask(level, 2 * START + 10 * SUBCODE + SUBCODE // 2, 2 * START + 10 * SUBCODE + SUBCODE // 2)
    assert (centre_of(level)[INNER] == 11).all()


@pytest.mark.parametrize("panel", OUTER)
@pytest.mark.parametrize("size", [0.5, 1.0])
def test_a_correction_adds_what_the_centre_panel_can_not_give_both_eyes(panel: int, size: float) -> None:
    """Both lack 800 more than the centre's whole range."""
    level = level_of()
    ask(level, 2 * START + FULL + 800, 2 * START + FULL + 800)
    level.step(panel, size=size, shown=False)
    assert np.abs(level.outer[panel][INNER] - (START + 1600 * size)).max() <= 8
    other = REAR if panel == FRONT else FRONT
    assert (level.outer[other] == START).all()


@pytest.mark.parametrize(("lack", "end"), [(FULL + 3000, FULL), (-3000, 0)])
def test_a_panel_stays_within_its_range(lack: int, end: int) -> None:
    level = level_of()
    ask(level, 2 * START + lack, 2 * START + lack)
    for shown in (False, True):
        level.step(FRONT, size=1.0, shown=shown)
        assert (level.outer[FRONT][INNER] == end).all()


@pytest.mark.parametrize("sigma_mm", [0.0, 60.0])
def test_even_panels_that_lack_nothing_are_left_as_they_are_however_unsure_the_eyes(sigma_mm: float) -> None:
    level = level_of(sigma_mm=sigma_mm)
    ask(level, 2 * START + 1000, 2 * START + 1000)
    for n in OUTER:
        level.step(n, size=1.0, shown=False)
        level.project((n,))
        assert (level.outer[n][INNER] == START).all()


def test_a_drawn_panel_is_taken_as_it_is_and_even_beside_it() -> None:
    level = level_of()
    codes = np.full((48, 96, 3), 3200, np.int16)
    level.set_panel(REAR, codes, np.array([[1.0, 0, 48.0], [0, 1.0, 0], [0, 0, 1.0]]), shown=False)
    assert (level.outer[REAR][8:40, 4:40] == 3200).all()
    assert (level.outer[REAR][8:40, 56:90] == START).all()
    level.set_panel(REAR, np.full((48, 96, 3), FULL + 500, np.int16), np.eye(3), shown=True)
    assert (level.outer[REAR][INNER] == FULL).all()


def test_a_drawn_panel_keeps_its_edges_it_is_sampled_by_cubics() -> None:
    level = level_of()
    codes = np.full((24, 48, 3), 1000, np.int16)
    codes[:, 24:] = 3000
    level.set_panel(REAR, codes, np.diag([0.5, 0.5, 1.0]), shown=False)
    assert level.outer[REAR][INNER].max() > 3050 and level.outer[REAR][INNER].min() < 950


def test_a_finer_raster_takes_the_outer_panels_over() -> None:
    coarse, fine = level_of(reduction=2), level_of()
    assert coarse.size == (48, 24) and fine.size == (96, 48)
    coarse.outer[REAR][...] = 1003
    coarse.outer[FRONT][...] = 3005
    fine.upsample(coarse, shown=False)
    assert (fine.outer[REAR] == 1003).all() and (fine.outer[FRONT] == 3005).all()
    fine.upsample(coarse, shown=True)
    assert (fine.outer[REAR] == 1008).all() and (fine.outer[FRONT] == 3008).all()


def test_a_coarser_raster_covers_the_same_rectangle() -> None:
    boxes = (PixelRect(0, 0, 96, 48), PixelRect(8, 4, 88, 44), PixelRect(0, 0, 96, 48))
    level = Level(STACK, reduction=4, threads=1)
    level.crop(boxes, STACK)
    raster, whole = level.rasters[CENTRE], boxes[CENTRE].cut(STACK.panel(CENTRE))
    assert (raster.left_m, raster.top_m) == (whole.left_m, whole.top_m)
    assert raster.width_px * raster.pitch_u_m == pytest.approx(whole.width_px * whole.pitch_u_m)
    assert raster.height_px * raster.pitch_v_m == pytest.approx(whole.height_px * whole.pitch_v_m)
    assert level.size == (20, 10)


def test_unsure_eyes_have_the_front_panel_follow_what_moves_of_the_rear_one() -> None:
    """An edge on the rear panel is noise to unsure eyes, which the front panel lessens."""
    changed = []
    for sigma_mm in (0.0, 60.0):
        level = level_of(sigma_mm=sigma_mm)
        level.outer[REAR][:, 48:] += 800
        level.project(OUTER)
        ask(level, 2 * START + 1000, 2 * START + 1000)
        level.step(FRONT, size=0.5, shown=False)
        changed.append(level.outer[FRONT][24, 16:80, 0].astype(float) - START)
    sure, unsure = changed
    assert np.abs(unsure - sure)[20:44].max() > 30
    assert unsure.max() < sure.max() and unsure.min() > sure.min()
