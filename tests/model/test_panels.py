"""The panels of a solution: what is taken over from the network, spreads, corrections, closing."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.model.compiled.panels import Panels
from runtime.model.reprojection import CENTRE, FRONT, LEAST_SPREAD_PX, MAX_SPREAD_PX, OUTER, REAR, START
from runtime.model.targets import FULL, SLOPE_FLOOR, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

STACK = PanelStack(0.48, 0.24, (-0.06, 0.0, 0.06), 96, 48)
WHOLE = (PixelRect(0, 0, 96, 48),) * 3
PAIR = eyes(0.6, 0.02, 0.01)
INNER = (slice(8, 40), slice(16, 80))  # far from every edge


def panels_of(*, channels: int = 3, sigma_mm: float = 0.0) -> Panels:
    """Whole panels with even outer panels, seen by both eyes."""
    panels = Panels(STACK, threads=1, channels=channels)
    panels.crop(tuple(STACK.panel(n) for n in range(STACK.count)), STACK)
    panels.set_eyes(PAIR, eye_sigma_mm=sigma_mm)
    for n in OUTER:
        panels.outer[n][...] = START
    panels.project(OUTER)
    return panels


def ask(panels: Panels, left: int, right: int) -> None:
    """Both eyes' pictures, each of one phase sum."""
    for image, value in zip(panels.target, (left, right), strict=True):
        image[...] = value


def centre_of(panels: Panels) -> np.ndarray:
    layers = np.zeros((3, 48, 96, 4), np.uint8)
    panels.show(layers, WHOLE)
    return layers[CENTRE][..., :3]


def crossing_px(eye_m: np.ndarray, x_m: float) -> np.ndarray:
    """(u, v) pixel of a panel at `x_m` that the eye sees through the middle of the centre panel."""
    t = (x_m - eye_m[0]) / -eye_m[0]
    y_m, z_m = eye_m[1:] + t * (0.0 - eye_m[1:])
    return np.array([(y_m + 0.24) / 0.005, (0.12 - z_m) / 0.005])


@pytest.mark.parametrize("sigma_mm", [30.0, 45.0])
def test_a_spread_is_how_many_pixels_a_panel_moves_for_an_eye_that_is_off_by_one_sigma(sigma_mm: float) -> None:
    """In pixels, from millimetres: a thousandth or a thousandfold of it would be none, or the most there is."""
    panels = panels_of(sigma_mm=sigma_mm)
    middle = PAIR.mean(axis=0)
    for n in OUTER:
        here, axes = crossing_px(middle, STACK.x_m[n]), np.eye(3) * sigma_mm / 1000
        beside, above = (crossing_px(middle + axes[axis], STACK.x_m[n]) - here for axis in (1, 2))
        assert panels.spread[n] == pytest.approx((abs(beside[0]), abs(above[1])), rel=1e-9)


def test_spreads_too_small_to_be_felt_are_none_and_there_is_a_largest() -> None:
    metres = LEAST_SPREAD_PX * 0.005 * 0.6 / 0.06
    assert panels_of(sigma_mm=metres * 1e3 * 0.99).spread == {}
    assert set(panels_of(sigma_mm=metres * 1e3 * 1.01).spread) == set(OUTER)
    assert panels_of(sigma_mm=1e6).spread[FRONT] == (MAX_SPREAD_PX, MAX_SPREAD_PX)


def slope(wanted: float) -> float:
    """Of sin² at a phase sum, 1 where it is steepest: the weight of a ray."""
    part = wanted / FULL % 1
    return SLOPE_FLOOR + (1 - SLOPE_FLOOR) * 4 * part * (1 - part)


def test_the_centre_panel_is_the_mean_of_what_both_eyes_lack_weighed_by_the_slope_there() -> None:
    panels = panels_of()
    for asked in ((FULL, 5400), (5400, 2 * FULL), (5000, 6100), (FULL + 300, 2 * FULL - 900), (0, FULL), (0, 0)):
        ask(panels, *asked)
        lacks, weights = np.array(asked) - 2 * START, np.array([slope(one) for one in asked])
        best = np.clip((weights * lacks).sum() / weights.sum(), 0, FULL)
        assert np.abs(centre_of(panels)[INNER] - best / SUBCODE).max() <= 0.51, asked


def test_the_centre_closes_half_codes_upwards() -> None:
    panels = panels_of()
    ask(panels, 2 * START + 10 * SUBCODE + SUBCODE // 2, 2 * START + 10 * SUBCODE + SUBCODE // 2)
    assert (centre_of(panels)[INNER] == 11).all()


@pytest.mark.parametrize("panel", OUTER)
@pytest.mark.parametrize("size", [0.5, 1.0])
def test_a_correction_adds_what_the_centre_panel_can_not_give_both_eyes(panel: int, size: float) -> None:
    """Both lack 800 more than the centre's whole range."""
    panels = panels_of()
    ask(panels, 2 * START + FULL + 800, 2 * START + FULL + 800)
    panels.step(panel, size=size, shown=False)
    assert np.abs(panels.outer[panel][INNER] - (START + 1600 * size)).max() <= 8
    other = REAR if panel == FRONT else FRONT
    assert (panels.outer[other] == START).all()


@pytest.mark.parametrize(("lack", "end"), [(FULL + 3000, FULL), (-3000, 0)])
def test_a_panel_stays_within_its_range(lack: int, end: int) -> None:
    panels = panels_of()
    ask(panels, 2 * START + lack, 2 * START + lack)
    for shown in (False, True):
        panels.step(FRONT, size=1.0, shown=shown)
        assert (panels.outer[FRONT][INNER] == end).all()


@pytest.mark.parametrize("sigma_mm", [0.0, 60.0])
def test_even_panels_that_lack_nothing_are_left_as_they_are_however_unsure_the_eyes(sigma_mm: float) -> None:
    panels = panels_of(sigma_mm=sigma_mm)
    ask(panels, 2 * START + 1000, 2 * START + 1000)
    for n in OUTER:
        panels.step(n, size=1.0, shown=False)
        panels.project((n,))
        assert (panels.outer[n][INNER] == START).all()


def test_a_panel_is_taken_over_from_a_coarser_raster_within_its_range() -> None:
    panels, coarse = panels_of(), np.full((24, 48, 3), 1003, np.int16)
    panels.set_panel(REAR, coarse, shown=False)
    assert (panels.outer[REAR] == 1003).all() and (panels.outer[FRONT] == START).all()
    panels.set_panel(REAR, coarse, shown=True)
    assert (panels.outer[REAR] == 1008).all()
    panels.set_panel(REAR, np.full((24, 48, 3), FULL + 500, np.int16), shown=True)
    assert (panels.outer[REAR] == FULL).all()


def test_a_drawn_panel_keeps_its_edges_it_is_sampled_by_cubics() -> None:
    panels = panels_of()
    codes = np.full((24, 48, 3), 1000, np.int16)
    codes[:, 24:] = 3000
    panels.set_panel(REAR, codes, shown=False)
    assert panels.outer[REAR][INNER].max() > 3050 and panels.outer[REAR][INNER].min() < 950


def test_unsure_eyes_have_the_front_panel_follow_what_moves_of_the_rear_one() -> None:
    """An edge on the rear panel is noise to unsure eyes, which the front panel lessens."""
    changed = []
    for sigma_mm in (0.0, 60.0):
        panels = panels_of(sigma_mm=sigma_mm)
        panels.outer[REAR][:, 48:] += 800
        panels.project(OUTER)
        ask(panels, 2 * START + 1000, 2 * START + 1000)
        panels.step(FRONT, size=0.5, shown=False)
        changed.append(panels.outer[FRONT][24, 16:80, 0].astype(float) - START)
    sure, unsure = changed
    assert np.abs(unsure - sure)[20:44].max() > 30
    assert unsure.max() < sure.max() and unsure.min() > sure.min()
