"""Real panels against closed forms: Malus, Gooch and Tarry, Snell, moiré, slits, first-order response."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from runtime.optics.carried import expected_psnrs_db
from runtime.optics.light import Sampling as Rays
from runtime.optics.real.cells import (
    BANDS_NM,
    C128,
    DESIGN_NM,
    FIRST_MINIMUM,
    Cell,
    Kind,
    retarder,
    retarder_between_quarter_waves,
    rotator,
    twisted_nematic,
)
from runtime.optics.real.light import RealSampling, Sight, real_light
from runtime.optics.real.panels import Lighting, Optics, Placement, RealPanels, Timing
from runtime.optics.real.trace import Tables, black_level, crossings, diffraction_orders, moments
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8

STACK = PanelStack(0.12, 0.09, (-0.03, 0.0, 0.03), 160, 120)
EYES = np.array([[0.6, -0.0315, 0.02], [0.6, 0.0315, 0.02]])
MIDDLE = np.array([[0.6, 0.0, 0.0]])
CENTRE = np.zeros((1, 3))
BARELY = (Cell(retardance_nm=1e-6),)  # computed with Jones matrices


def crossed_intensity(matrix: C128) -> F64:
    """Share of light polarized along x that leaves a cell polarized along y."""
    return np.asarray(np.abs(matrix[..., 1, 0]) ** 2)


def random() -> np.random.Generator:
    return np.random.default_rng(7)


def smooth_layers(stack: PanelStack = STACK) -> U8:
    noise = np.random.default_rng(3).random((stack.count, stack.height_px // 8, stack.width_px // 8, 3))
    return np.asarray(np.rint(255 * noise.repeat(8, 1).repeat(8, 2)), np.uint8)


def sight(sigma_mm: float = 1.0) -> Sight:
    pictures = np.random.default_rng(5).random((2, 44, 68, 3)).astype(np.float32)
    return Sight(EYES, (pictures[0], pictures[1]), 4.0, sigma_mm)


def intensity(values: tuple[float, float, float], real: RealPanels) -> F64:
    """(3,) light of a ray through panels that show these values everywhere."""
    stack = replace(STACK, width_px=16, height_px=16)
    layers = np.stack([np.full((16, 16, 3), round(255 * value), np.uint8) for value in values])
    crossed = crossings(MIDDLE, CENTRE, stack, real, random())
    return Tables(layers, stack, real).light(crossed, 0.6)[0][0].astype(np.float64)


@pytest.mark.parametrize(("fov_deg", "sigma_mm"), [(4.0, 1.0), (4.0, 0.0), (16.0, 3.0)])  # at last beyond the panels
@pytest.mark.parametrize(("pictures", "most_db"), [("noise", 0.01), ("seen", 0.1)])
def test_ideal_panels_give_the_solvers_own_figure(
    fov_deg: float, sigma_mm: float, pictures: str, most_db: float
) -> None:
    """Of noise, to a hundredth; of what pinhole eyes see, where every shift shows."""
    layers, targets = smooth_layers(), sight().targets
    if pictures == "seen":
        size = {"fov_deg": fov_deg, "width_px": 68, "height_px": 44}
        targets = tuple(seen_by(eye, layers, STACK, **size).image for eye in EYES)
    seen, rays = Sight(EYES, targets, fov_deg, sigma_mm, EYES + 0.002), RealSampling(rays=4, pupil_mm=12.0)
    at = {"eyes_m": EYES, "fov_deg": fov_deg, "sigmas_mm": (sigma_mm,), "seen_from_m": EYES + 0.002}
    theirs = expected_psnrs_db(layers, targets, STACK, sampling=Rays(rays=8, pupil_mm=12.0), **at)[sigma_mm]
    assert real_light(layers, STACK, RealPanels(), seen, rays).light_db == pytest.approx(theirs, abs=most_db)
    some = real_light(layers, STACK, RealPanels(), seen, rays._replace(step=2, thinned=True)).light_db
    assert some == pytest.approx(theirs, abs=0.3)


def test_the_usual_pupil_and_eyes_are_the_solver_s_as_well() -> None:
    layers, seen = smooth_layers(), sight()
    ours = real_light(layers, STACK, RealPanels(), seen, RealSampling(rays=4)).light_db
    at = {"eyes_m": EYES, "fov_deg": 4.0, "sigmas_mm": (1.0,)}
    theirs = expected_psnrs_db(layers, seen.targets, STACK, sampling=Rays(rays=8), **at)[1.0]
    assert ours == pytest.approx(theirs, abs=0.01)


def test_jones_calculus_and_summed_angles_agree() -> None:
    turned = real_light(smooth_layers(), STACK, RealPanels(), sight(), RealSampling(step=2))
    barely = real_light(smooth_layers(), STACK, RealPanels(cells=BARELY), sight(), RealSampling(step=2))
    assert barely.error == pytest.approx(turned.error)


@pytest.mark.parametrize("angle_deg", [0.0, 20.0, 45.0, 77.0, 90.0, 130.0])
def test_a_rotator_between_crossed_polarizers_follows_malus(angle_deg: float) -> None:
    assert crossed_intensity(rotator(math.radians(angle_deg))) == pytest.approx(math.sin(math.radians(angle_deg)) ** 2)


@pytest.mark.parametrize("u", [0.5, 1.0, FIRST_MINIMUM, 3.0, math.sqrt(15), 5.0])
def test_a_twisted_cell_between_parallel_polarizers_follows_gooch_and_tarry(u: float) -> None:
    cell = twisted_nematic(math.pi / 2, math.pi / 2 * u)
    expected = math.sin(math.pi / 2 * math.sqrt(1 + u * u)) ** 2 / (1 + u * u)
    assert abs(cell[0, 0]) ** 2 == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("u", [math.sqrt(3), math.sqrt(15), math.sqrt(35)])
def test_gooch_tarry_minima_are_pure_rotators(u: float) -> None:
    cell = twisted_nematic(math.pi / 2, math.pi / 2 * u)
    turned = cell @ rotator(-math.pi / 2)
    assert np.abs(turned / turned[0, 0] - np.eye(2)).max() < 1e-12


def test_mauguins_limit_guides_light_along_the_twist() -> None:
    assert crossed_intensity(twisted_nematic(math.pi / 2, math.pi / 2 * 400)) > 0.99999


@pytest.mark.parametrize("kind", ["rotator", "twisted-nematic", "half-wave", "variable-retarder"])
def test_one_cell_alone_has_the_ideal_grey_curve_up_to_its_white(kind: Kind) -> None:
    ideal = np.sin(np.linspace(0, math.pi / 2, 1021)) ** 2
    bands = crossed_intensity(Cell(kind).jones()).T
    assert np.abs(bands[1] - ideal).max() < 1e-4
    if kind != "half-wave":  # the grey curve is calibrated in each band
        assert np.abs(bands - ideal * bands[:, -1:]).max() < 1e-4


def test_a_twisted_cell_s_white_is_tinted() -> None:
    red, green, blue = crossed_intensity(Cell("twisted-nematic").jones()[-1])
    leak = math.sin(math.pi / 2 * math.sqrt(1 + 3 * (540 / 610) ** 2)) ** 2 / (1 + 3 * (540 / 610) ** 2)
    assert [red, green, blue] == pytest.approx([1 - leak, 1.0, 1.0])
    u = 2.5
    thick = crossed_intensity(Cell("twisted-nematic", mauguin=u).jones()[-1, 1])
    assert thick == pytest.approx(1 - math.sin(math.pi / 2 * math.sqrt(1 + u * u)) ** 2 / (1 + u * u))


def test_cells_absorb_nothing() -> None:
    matrices = Cell("twisted-nematic", retardance_nm=20, white_deg=80, mauguin=1.5).jones()
    assert np.abs(matrices @ matrices.conj().swapaxes(-1, -2) - np.eye(2)).max() < 1e-12


def test_half_wave_plates_turn_in_alternate_directions() -> None:
    values = (0.2, 0.7, 0.4)
    seen = intensity(values, RealPanels(cells=(Cell("half-wave"),)))[1]
    shown = [round(255 * value) / 255 for value in values]
    assert seen == pytest.approx(math.sin(math.pi / 2 * (shown[2] - shown[1] + shown[0])) ** 2, abs=1e-5)


def test_inverting_the_middle_half_wave_plate_and_the_analyser_mends_the_sum() -> None:
    plates = tuple(Cell("half-wave", inverted=n == 1) for n in range(3))
    values = (0.2, 0.6, 0.4)
    mended = intensity(values, RealPanels(cells=plates, analyser_deg=0.0))[1]
    assert mended == pytest.approx(intensity(values, RealPanels())[1], abs=1e-5)


@pytest.mark.parametrize("kind", ["half-wave", "variable-retarder"])
def test_plates_err_by_their_dispersion(kind: Kind) -> None:
    for band, wavelength_nm in enumerate(BANDS_NM):
        expected = math.sin(math.pi / 2 * DESIGN_NM / wavelength_nm) ** 2  # at 45 degrees between crossed polarizers
        assert crossed_intensity(Cell(kind).jones()[-1, band]) == pytest.approx(expected)


def test_residual_retardance_leaks_as_a_wave_plate_does() -> None:
    plate = RealPanels(cells=(Cell(), Cell(), Cell(retardance_nm=30.0, retardance_axis_deg=45.0)))
    seen = intensity((0.0, 0.0, 0.0), plate)
    assert seen == pytest.approx([math.tan(math.pi * 30.0 / nm) ** 2 for nm in BANDS_NM], abs=1e-5)  # of white


def test_retarders_with_parallel_axes_need_no_films() -> None:
    """At 45 degrees to the polarizers they add up as rotators do; films between two panels cancel."""
    angles = np.random.default_rng(4).uniform(0, math.pi / 2, (3, 100))
    first, second, third = (retarder(2 * angle, math.pi / 4) for angle in angles)
    seen = np.abs((third @ second @ first)[..., 1, 0]) ** 2
    assert np.abs(seen - np.sin(angles.sum(axis=0)) ** 2).max() < 1e-12
    for wavelength_nm in BANDS_NM:
        cells = [retarder_between_quarter_waves(angle, DESIGN_NM / wavelength_nm) for angle in angles]
        summed = retarder_between_quarter_waves(angles.sum(axis=0), DESIGN_NM / wavelength_nm)
        assert np.abs(cells[2] @ cells[1] @ cells[0] - summed).max() < 1e-12


def test_a_quarter_wave_plate_makes_circular_light() -> None:
    assert crossed_intensity(retarder(math.pi / 2, math.pi / 4)) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("values", "panels", "expected"),
    [
        ((1.0, 0.0, 0.0), {"cells": (Cell(white_deg=80.0, black_deg=4.0), Cell(), Cell())}, 0.9698463),
        ((0.0, 0.0, 0.0), {"cells": (Cell(white_deg=80.0, black_deg=4.0), Cell(), Cell())}, 0.0048660),
        ((0.2, 0.0, 0.2), {"analyser_deg": 60.0}, 0.8345653),  # cos²(36° - 60°)
        ((0.2, 0.0, 0.2), {"analyser_deg": 60.0, "cells": BARELY}, 1.1127541),  # white itself is cos²(90° - 60°) = 3/4
        ((0.2, 0.0, 0.2), {"analyser_deg": 20.0, "cells": BARELY}, 0.9240242),  # white is darker than half
        ((0.0, 0.0, 0.0), {"cells": (Cell(contrast=500.0), Cell(), Cell())}, 0.002),
        ((1.0, 0.0, 0.0), {"lighting": Lighting(polarizer_contrast=1000.0)}, 1.0),
        ((0.4, 0.0, 0.0), {"lighting": Lighting(polarizer_contrast=4.0)}, 0.25 + 0.75 * 0.3454915),
    ],
)
def test_a_ray_s_light_follows_from_angles_analyser_and_contrast(
    values: tuple[float, float, float], panels: dict[str, Any], expected: float
) -> None:
    assert intensity(values, RealPanels(**panels)) == pytest.approx([expected] * 3, abs=1e-6)


def test_a_gamma_error_bends_the_grey_curve() -> None:
    seen = intensity((0.6, 0.0, 0.0), RealPanels(cells=(Cell(gamma_ratio=1.1), Cell(), Cell())))[0]
    assert seen == pytest.approx(math.sin(math.pi / 2 * 0.6**1.1) ** 2, abs=1e-6)


def test_six_bits_round_to_64_levels() -> None:
    angles = Cell(bits=6).angles_rad()
    assert len(np.unique(angles)) == 64


@pytest.mark.parametrize(
    ("cell", "angles_deg"),
    [
        (Cell(bits=1), [0.0, 0.0, 90.0, 90.0]),
        (Cell(bits=2), [0.0, 30.0, 60.0, 90.0]),
        (Cell(bits=7), [0.0, 90 * 51 / 127, 90 * 76 / 127, 90.0]),
        (Cell(inverted=True), [90.0, 54.0, 36.0, 0.0]),
        (Cell(black_deg=-10.0, white_deg=80.0), [-10.0, 26.0, 44.0, 80.0]),
        (Cell(black_deg=40.0, white_deg=50.0, curve="angle"), [40.0, 40.0, 50.0, 50.0]),
        (Cell(black_deg=10.0, white_deg=80.0, curve="angle"), [10.0, 36.0, 54.0, 80.0]),
        (Cell(black_deg=30.0, white_deg=60.0, curve="intensity"), [30.0, 40.5559, 49.4441, 60.0]),
        (Cell(white_deg=45.0, curve="intensity", gamma_ratio=2.0), [0.0, 10.1281, 22.2647, 45.0]),
    ],
)
def test_values_become_angles_by_the_cells_levels_range_and_curve(cell: Cell, angles_deg: list[float]) -> None:
    """At values of 0, 0.4, 0.6 and 1."""
    angles = np.degrees(cell.angles_rad())
    assert len(angles) == 1021
    assert angles[[0, 408, 612, 1020]] == pytest.approx(angles_deg, abs=1e-3)


def test_contrast_is_the_ratio_of_white_to_black_and_cells_add_up() -> None:
    assert black_level([Cell(contrast=500.0)], math.inf) == pytest.approx(1 / 500)
    assert black_level([Cell()], 2000.0) == pytest.approx(1 / 2000)
    assert black_level([Cell(contrast=1000.0)] * 3, math.inf) == pytest.approx(3 / 1000, rel=0.01)


def test_glass_shortens_the_gap_by_snells_law() -> None:
    glass = RealPanels(optics=Optics(glass_mm=2.0, index=1.5))
    slope = 0.6
    start = np.array([[0.5, 0.0, 0.0]])
    ideal = crossings(start, np.array([[0.0, 0.5 * slope, 0.0]]), STACK, RealPanels(), random())
    real = crossings(start, np.array([[0.0, 0.5 * slope, 0.0]]), STACK, glass, random())
    sine = math.sin(math.atan(slope)) / 1.5
    gap_m = 0.026 * slope + 0.004 * math.tan(math.asin(sine))
    pitch_m = STACK.width_m / STACK.width_px
    assert (real.u[1] - real.u[2]) * pitch_m == pytest.approx(gap_m)
    assert (ideal.u[1] - ideal.u[2]) * pitch_m == pytest.approx(0.03 * slope)


def test_a_shifted_panel_shows_other_pixels() -> None:
    moved = RealPanels(placement=(Placement(), Placement(), Placement(right_mm=1.5, up_mm=0.75)))
    ideal, real = (crossings(MIDDLE, CENTRE, STACK, panels, random()) for panels in (RealPanels(), moved))
    assert (real.u - ideal.u)[:, 0] == pytest.approx([0, 0, -2])
    assert (real.v - ideal.v)[:, 0] == pytest.approx([0, 0, 1])


def test_roll_scale_and_depth_move_pixels_as_geometry_says() -> None:
    through = np.array([[0.0, 0.03, 0.01]])
    real = RealPanels(placement=(Placement(rotation_mrad=10, scale=1.01), Placement(), Placement(depth_mm=1.0)))
    crossed = crossings(MIDDLE, through, STACK, real, random())
    rear = np.array([0.03, 0.01]) * 0.63 / 0.6
    turn = np.array([[math.cos(0.01), math.sin(0.01)], [-math.sin(0.01), math.cos(0.01)]])
    local = turn @ rear / 1.01
    assert crossed.u[0, 0] == pytest.approx((local[0] / 0.12 + 0.5) * 160)
    assert crossed.v[0, 0] == pytest.approx((0.5 - local[1] / 0.09) * 120)
    assert crossed.u[2, 0] == pytest.approx((0.03 * (0.6 - 0.031) / 0.6 / 0.12 + 0.5) * 160)


def test_a_sloping_panel_is_met_where_its_plane_is() -> None:
    through = np.array([[0.0, 0.03, 0.01]])
    real = RealPanels(placement=(Placement(), Placement(tilt_right_mrad=50.0, tilt_up_mrad=-20.0), Placement()))
    crossed = crossings(MIDDLE, through, STACK, real, random())
    y, z = (crossed.u[1, 0] / 160 - 0.5) * 0.12, (0.5 - crossed.v[1, 0] / 120) * 0.09
    x = 0.05 * y - 0.02 * z
    assert (0.6 - x) / 0.6 == pytest.approx(y / 0.03) == pytest.approx(z / 0.01)


def test_moire_has_the_period_of_two_pitches_seen_from_the_eye() -> None:
    stack = PanelStack(0.12, 0.09, (-0.03, 0.0), 400, 300)
    real = RealPanels(optics=Optics(filters=(False, False), aperture=0.25))
    across = np.linspace(-0.04, 0.04, 40_000)
    through = np.stack([np.zeros_like(across), across, np.full_like(across, 1.5e-4)], -1)
    white = Tables(smooth_layers(stack), stack, real)._white(
        crossings(MIDDLE.repeat(len(across), 0), through, stack, real, random())
    )
    spectrum = np.abs(np.fft.rfft((white[:, 0] - white.mean()) * np.hanning(len(across)), 1 << 20))
    frequencies = np.fft.rfftfreq(1 << 20, across[1] - across[0])
    low = (frequencies > 100) & (frequencies < 1000)  # below the subpixels' own frequency
    found = frequencies[low][np.argmax(spectrum[low])]
    stripe_m = 0.12 / 400 / 3
    assert 1 / found == pytest.approx(stripe_m * 0.6 / 0.03, rel=0.02)  # pitch·distance/gap


def test_colour_filters_pass_a_third_of_the_open_area_each() -> None:
    real = RealPanels(optics=Optics(filters=(True, False, False), aperture=0.6))
    seen = real_light(smooth_layers(), STACK, real, sight(0.0), RealSampling(rays=8))
    assert seen.brightness == pytest.approx(0.6**3 / 3, rel=0.05)


@pytest.mark.parametrize("filters", [(False, False, False), (True, False, True)])
def test_black_lines_block_rays_and_leave_the_others_as_they_are(filters: tuple[bool, ...]) -> None:
    layers, across = smooth_layers(), np.linspace(-0.04, 0.04, 500)
    through = np.stack([np.zeros_like(across), across, np.full_like(across, 1.5e-4)], -1)
    crossed = crossings(MIDDLE.repeat(len(across), 0), through, STACK, RealPanels(), random())
    light, white = Tables(layers, STACK, RealPanels(optics=Optics(filters=filters, aperture=0.5))).light(crossed, 0.6)
    ideal = Tables(layers, STACK, RealPanels()).light(crossed, 0.6)[0]
    assert 0 < white.mean() < 0.5
    assert light == pytest.approx(white * ideal)


def test_light_behind_a_slit_spreads_as_sinc_squared() -> None:
    orders = diffraction_orders(random().random(400_000))
    assert np.mean(np.abs(orders) < 1) == pytest.approx(0.9028 / 0.9833, abs=0.003)  # main lobe, of that within 6
    assert orders.min() < -5.5 and orders.max() > 5.5 and np.mean(orders) == pytest.approx(0.0, abs=0.01)


def scattered_m(optics: Optics, rays: int = 20_000) -> F64:
    """(3, 2, rays) places to the right and down where scattered rays through the middle cross the panels."""
    crossed = crossings(np.repeat(MIDDLE, rays, 0), np.zeros((rays, 3)), STACK, RealPanels(optics=optics), random())
    return np.stack([(crossed.u - 80) * 0.12 / 160, (crossed.v - 60) * 0.09 / 120], axis=1)


def test_haze_spreads_its_share_of_rays_by_its_angle_over_the_gap() -> None:
    places = scattered_m(Optics(haze=1.0, haze_deg=1.0))
    assert np.abs(places[2]).max() < 7e-13  # a billionth of a pixel
    assert places[1].std(axis=1) == pytest.approx(0.03 * math.radians(1.0), rel=0.02)
    assert places[0].std(axis=1) == pytest.approx(math.hypot(0.03, 0.06) * math.radians(1.0), rel=0.02)
    assert (np.abs(scattered_m(Optics(haze=0.3))[1]) > 1e-9).mean() == pytest.approx(0.3, abs=0.02)


def test_rays_are_diffracted_by_the_open_part_of_a_subpixel() -> None:
    across, down = np.abs(scattered_m(Optics(diffracts=True, aperture=0.25))[1])
    # Wavelength over half a subpixel's width or height, times the gap: the first dark line.
    assert np.mean(across < 0.03 * 540e-9 / 125e-6) == pytest.approx(0.918, abs=0.01)
    assert np.mean(down < 0.03 * 540e-9 / 375e-6) == pytest.approx(0.918, abs=0.01)


def test_reflections_shift_what_lies_behind_the_gap_by_twice_the_gap() -> None:
    real = RealPanels(optics=Optics(reflectance=1.0))
    through = np.array([[0.0, 0.02, 0.0]])
    crossed = crossings(MIDDLE, through, STACK, real, random())
    slope = -0.02 / 0.6
    y = (crossed.u[:, 0] / 160 - 0.5) * 0.12
    assert y[1] == pytest.approx(0.02 - slope * 0.06)
    assert y[0] == pytest.approx(0.02 - slope * (0.03 + 0.12))


def test_room_light_and_dark_corners_change_what_is_seen() -> None:
    dark = real_light(smooth_layers(), STACK, RealPanels(), sight(0.0), RealSampling(step=2)).error
    lit = RealPanels(lighting=Lighting(room_lux=200))
    assert lit.lighting.veil == pytest.approx(200 * 0.05 / math.pi / 9)
    assert real_light(smooth_layers(), STACK, lit, sight(0.0), RealSampling(step=2)).error != pytest.approx(
        dark, rel=1e-3
    )


@pytest.mark.parametrize(
    ("panels", "error", "brightness", "noise"),
    [
        (RealPanels(), 0.0211678, 1.0, 1e-5),
        (RealPanels(lighting=Lighting(room_lux=200, white_cd_m2=10.0)), 0.0038541, 1.0, 1e-5),  # veil of 1/pi
        (RealPanels(lighting=Lighting(polarizer_contrast=4.0)), 0.0034950, 1.0, 1e-5),
        (RealPanels(optics=Optics(filters=(False, False, False), aperture=0.8)), 0.0254, 0.8**3, 2e-3),  # and moiré
        (RealPanels(lighting=Lighting(falloff=0.5)), 0.0212, 0.98, 1e-3),
    ],
)
def test_light_is_relative_to_the_white_that_eyes_adapt_to(
    panels: RealPanels, error: float, brightness: float, noise: float
) -> None:
    """An area of an intensity of 0.6545, which should be 0.8."""
    layers = np.zeros((3, 120, 160, 3), np.uint8)
    layers[0] = 153
    seen = replace(sight(0.0), targets=(np.full((44, 68, 3), 0.8, np.float32),) * 2)
    found = real_light(layers, STACK, panels, seen, RealSampling(rays=3))
    assert found.error == pytest.approx(error, abs=noise)
    assert found.light_db == pytest.approx(-10 * math.log10(found.error))
    assert found.brightness == pytest.approx(brightness, rel=0.02) and found.tint == pytest.approx((1, 1, 1), abs=0.02)


def test_corners_are_darker_than_edges_and_the_middle() -> None:
    through = np.array([[0.0, 0.0, 0.0], [0.0, 0.06, 0.0], [0.0, 0.0, -0.045], [0.0, -0.06, 0.045]])
    start = through + np.array([0.6, 0.0, 0.0])
    for falloff, expected in ((0.4, [1.0, 0.8, 0.8, 0.6]), (0.0, [1.0])):
        real = RealPanels(lighting=Lighting(falloff=falloff))
        white = Tables(smooth_layers(), STACK, real).light(crossings(start, through, STACK, real, random()), 0.6)[1]
        assert white[:, 0] == pytest.approx(expected)


def test_a_slow_panel_shows_older_frames_as_an_exponential_does() -> None:
    timing = Timing(response_ms=10.0, rate_hz=100.0)
    for lags in moments(STACK, timing):
        weights, newest = lags.of(2, np.array([0.5]))
        assert newest[0] == 0
        assert weights.sum() == pytest.approx(1)
        assert weights[0, 0] == pytest.approx(1 - math.exp(-lags.moment))
        assert weights[2, 0] / weights[1, 0] == pytest.approx(math.exp(-1))


def test_a_late_panel_shows_the_previous_frame_for_its_delay() -> None:
    timing = Timing(late_ms=(0.0, 0.0, 5.0), rate_hz=100.0)
    ages = [lags.of(2, np.array([0.5]))[1][0] for lags in moments(STACK, timing)]
    assert ages == [1, 1, 0, 0]


@pytest.mark.parametrize(("late_ms", "response_ms"), [(5.0, 0.0), (25.0, 0.0), (0.0, 4.0), (7.5, 4.0)])
@pytest.mark.parametrize("allowed_ms", [0.0, 5.0])
def test_a_panel_lags_by_delay_and_response_less_what_is_allowed(
    late_ms: float, response_ms: float, allowed_ms: float
) -> None:
    timing = Timing(late_ms=(0, 0, late_ms), response_ms=response_ms, allowed_ms=(0, 0, allowed_ms), rate_hz=100.0)
    lags = []
    for state in moments(STACK, timing):
        weights, newest = state.of(2, np.array([0.5]))
        frames = np.arange(len(weights))
        lags.append(float(weights[:, 0] @ (state.behind(2, newest)[0] + frames)))
    assert np.mean(lags) * 10.0 == pytest.approx(late_ms + response_ms - allowed_ms, abs=0.1)


def test_a_late_panel_shows_its_picture_displaced_while_the_head_moves() -> None:
    """The front panel's picture of columns moves by 5 pixels per refresh; it is late by one."""
    stack = PanelStack(0.12, 0.09, (-0.02, 0.0, 0.02, 0.04), 160, 120)
    layers = np.zeros((4, 120, 160, 3), np.uint8)
    layers[3] = np.arange(160)[None, :, None]
    crossed = crossings(MIDDLE, np.array([[0.0, 0.0153, 0.0]]), stack, RealPanels(), random())
    assert crossed.u[3] == pytest.approx([99.04])
    for late_ms, columns in (((0, 0, 0, 10.0), (102, 103, 104, 105)), ((10.0, 0, 0, 0), (97, 98, 99, 100))):
        real = RealPanels(timing=Timing(rate_hz=100.0, head_m_s=7.375, late_ms=late_ms))
        light = Tables(layers, stack, real).light(crossed, 0.6)[0][0, 0]
        assert light == pytest.approx(np.mean([math.sin(math.pi / 2 * column / 255) ** 2 for column in columns]))


def test_a_panel_mounted_upside_down_is_out_of_step_at_edges() -> None:
    timing = Timing(scan=1.0, bottom_up=(False, False, True))
    rows = np.array([0.01, 0.5, 0.99])
    front = np.array([lags.of(2, rows)[1] for lags in moments(STACK, timing)]).mean(axis=0)
    rear = np.array([lags.of(0, rows)[1] for lags in moments(STACK, timing)]).mean(axis=0)
    assert front.tolist() == [1, 0, 0]
    assert rear.tolist() == [0, 0, 1]


def test_a_late_front_panel_costs_light_only_when_the_head_moves() -> None:
    late, seen = Timing(late_ms=(0.0, 0.0, 12.0)), sight(0.0)
    quality = [
        real_light(
            smooth_layers(), STACK, RealPanels(timing=replace(late, head_m_s=v)), seen, RealSampling(step=2)
        ).error
        for v in (0.0, 0.5)
    ]
    ideal = real_light(smooth_layers(), STACK, RealPanels(), seen, RealSampling(step=2)).error
    assert quality[0] == ideal != quality[1]


def test_entries_that_do_not_fit_the_stack_are_refused_before_measuring() -> None:
    with pytest.raises(ValueError, match=r"panels\.cells: must have 1 or 3 entries, but has 2"):
        real_light(smooth_layers(), STACK, RealPanels(cells=(Cell(), Cell())), sight(), RealSampling())


@pytest.mark.parametrize(
    ("panels", "problem"),
    [
        (RealPanels(cells=(Cell(kind="va"),)), "cells: kind: 'va' is unknown; use rotator, twisted-nematic,"),  # type: ignore[arg-type]
        (RealPanels(cells=(Cell(curve="s"),)), "cells: curve: 's' is unknown; use linear, intensity, angle"),  # type: ignore[arg-type]
        (RealPanels(cells=(Cell(), Cell(), Cell(contrast=0.9))), "cells: contrast: must be at least 1, but is 0.9"),
        (RealPanels(cells=(Cell(bits=0),)), "cells: bits: must be from 1 to 8, but is 0"),
        (RealPanels(cells=(Cell(bits=9),)), "cells: bits: must be from 1 to 8, but is 9"),
        (RealPanels(cells=(Cell(black_deg=91.0),)), "cells: black_deg: must be from -90 to 90, but is 91"),
        (RealPanels(cells=(Cell(black_deg=-91.0),)), "cells: black_deg: must be from -90 to 90, but is -91"),
        (RealPanels(cells=(Cell(white_deg=181.0),)), "cells: white_deg: must be from -180 to 180, but is 181"),
        (RealPanels(cells=(Cell(white_deg=-181.0),)), "cells: white_deg: must be from -180 to 180, but is -181"),
        (RealPanels(cells=(Cell(gamma_ratio=0.0),)), "cells: gamma_ratio: must be above 0, but is 0"),
        (RealPanels(cells=(Cell(mauguin=math.inf),)), "cells: mauguin: must be above 0, but is inf"),
        (RealPanels(optics=Optics(haze=1.1)), "optics.haze: must be a share from 0 to 1, but is 1.1"),
        (RealPanels(timing=Timing(scan=-0.1)), "timing.scan: must be a share from 0 to 1, but is -0.1"),
        (RealPanels(optics=Optics(aperture=0.0)), "optics.aperture: must be above 0, but is 0"),
        (RealPanels(timing=Timing(rate_hz=math.inf)), "timing.rate_hz: must be above 0, but is inf"),
        (RealPanels(timing=Timing(response_ms=-1.0)), "timing.response_ms: must be at least 0, but is -1"),
        (RealPanels(optics=Optics(glass_mm=math.inf)), "optics.glass_mm: must be at least 0, but is inf"),
        (RealPanels(placement=(Placement(),) * 2), "placement: must have 1 or 3 entries, but has 2"),
        (RealPanels(timing=Timing(late_ms=(1.0,))), "timing.late_ms: must have 3 entries, but has 1"),
        (RealPanels(optics=Optics(filters=(True,) * 4)), "optics.filters: must have 3 entries, but has 4"),
    ],
)
def test_values_that_are_not_possible_are_refused(panels: RealPanels, problem: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"panels.{problem}")):
        panels.check(3)


def test_values_at_their_limits_are_possible() -> None:
    least = Cell(black_deg=-90.0, white_deg=-180.0, bits=1, contrast=1.0, gamma_ratio=0.01, mauguin=0.01)
    most = Cell(black_deg=90.0, white_deg=180.0, bits=8)
    optics = Optics(haze=1.0, aperture=1.0, index=0.5)
    RealPanels(cells=(least, most), placement=(Placement(),) * 2, optics=optics, timing=Timing(scan=1.0)).check(2)


def test_a_variable_retarder_between_quarter_wave_plates_is_a_rotator() -> None:
    angles = np.linspace(0.0, math.pi / 2, 7)
    rest = retarder_between_quarter_waves(angles) @ rotator(-angles)
    assert np.abs(rest / rest[:, :1, :1] - np.eye(2)).max() < 1e-9
