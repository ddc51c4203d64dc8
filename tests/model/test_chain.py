"""The common raster of the chains, and the closed-form modes of their operator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runtime.model.chain import (
    BLOCK_ROWS,
    ROWS_SHARE,
    ROWS_STEP,
    WIDEST,
    ColumnLaw,
    cell_waves,
    chain_frame,
    chain_modes,
)
from runtime.optics.stack import PanelStack, Plane
from runtime.report.pairs import eyes_at
from tests.model.scenes import STACK, eyes


def chain_operator(cells: int) -> np.ndarray:
    """A written out: rows of [.. -2 2 ..]."""
    return 2 * (np.eye(cells, cells + 1, k=1) - np.eye(cells, cells + 1))


def column_of(law: ColumnLaw, t: np.ndarray) -> np.ndarray:
    """The columns of coordinates t, which lie far outside the raster beyond F."""
    if not law.bend:
        return t
    return law.middle - np.log(np.maximum(1 - law.bend * (t - law.middle), 1e-9)) / law.bend


@given(st.integers(1, 300))
def test_modes_are_the_singular_value_decomposition_of_the_chain_operator(cells: int) -> None:
    v, shifted, s, ut = (part.astype(np.float64) for part in chain_modes(cells))
    assert np.allclose(ut.T @ np.diag(s) @ v.T, chain_operator(cells), atol=1e-4)
    assert np.allclose(v.T @ v, np.eye(cells + 1), atol=1e-4)
    assert np.allclose(ut[1:] @ ut[1:].T, np.eye(cells), atol=1e-4)
    mean = (np.eye(cells, cells + 1, k=1) + np.eye(cells, cells + 1)) / 2
    assert np.allclose(ut.T @ np.diag(np.sqrt(1 - s**2 / 16)) @ shifted.T, mean, atol=1e-4)


def test_sigma_moves_the_outer_panels_as_a_displaced_eye_does() -> None:
    pair = eyes(0.6, 0.1, 0.05, roll_deg=10)
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=2)
    raster_from_plane = np.linalg.inv(frame.plane_from_raster)
    at = frame.plane_from_raster @ np.array([frame.width_px / 3, frame.rows / 2, 1.0])

    def on(eye: np.ndarray, x_m: float) -> np.ndarray:
        """Raster position of the point where the eye's ray through `at` meets a panel, seen from between the eyes."""
        here, shift = Plane(frame.x_m).scale_shift_to(Plane(x_m), eye)
        there, back = Plane(x_m).scale_shift_to(Plane(frame.x_m), frame.middle_m)
        return raster_from_plane @ np.append((at[:2] * here + shift) * there + back, 1.0)

    columns, rows, own = frame.eye_sigma_px(STACK, eye_sigma_m=2e-3, cell_px=4)
    aside = on(frame.middle_m + np.array([0, 2e-3, 0]), STACK.x_m[2]) - on(frame.middle_m, STACK.x_m[2])
    above = on(frame.middle_m + np.array([0, 0, 2e-3]), STACK.x_m[2]) - on(frame.middle_m, STACK.x_m[2])
    quarters = 4 / frame.cell_px  # of a parallax, per column
    assert abs(aside[0]) * quarters == pytest.approx(columns, rel=1e-4) and abs(above[0]) < 1e-6
    assert np.hypot(aside[1], above[1]) == pytest.approx(rows, rel=1e-4)
    beside = on(pair[1], STACK.x_m[1]) - on(frame.middle_m, STACK.x_m[1])
    assert abs(beside[0]) * quarters == pytest.approx(own, rel=1e-4)


@pytest.mark.parametrize("reduction", [1, 2, 4, 8])
def test_coarse_pictures_get_few_columns_per_parallax(reduction: int) -> None:
    frame = chain_frame(eyes(0.7), STACK, most_cell_px=4, reduction=reduction)
    column_px = abs(frame.plane_from_raster[0, 0]) / (reduction * STACK.width_m / STACK.width_px)
    assert 2 <= frame.cell_px <= 4
    assert frame.cell_px == 4 or column_px <= WIDEST
    assert frame.cell_px == 2 or column_px * frame.cell_px / (frame.cell_px - 1) > WIDEST


def test_waves_of_a_cell_are_orthonormal_and_have_their_frequencies() -> None:
    for cell_px in (1, 2, 3, 4):
        waves, frequencies = cell_waves(cell_px)
        assert waves @ waves.T == pytest.approx(np.eye(2 * cell_px), abs=1e-6)
        second_difference = 2 * waves - np.roll(waves, 1, axis=1) - np.roll(waves, -1, axis=1)
        expected = 2 - 2 * np.cos(frequencies / cell_px)
        assert second_difference == pytest.approx(expected[:, None] * waves, abs=1e-5)


@given(
    distance_m=st.floats(0.25, 3.0),
    side_m=st.floats(-0.5, 0.5),
    up_m=st.floats(-0.3, 0.3),
    separation_m=st.floats(0.015, 0.07),
    roll_deg=st.floats(-30, 30),
)
def test_both_outer_panels_are_seen_one_cell_beside_the_middle_view(
    distance_m: float, side_m: float, up_m: float, separation_m: float, roll_deg: float
) -> None:
    pair = eyes(distance_m, side_m, up_m, separation_m=separation_m, roll_deg=roll_deg)
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=2)
    raster_from_plane = np.linalg.inv(frame.plane_from_raster)
    somewhere = frame.plane_from_raster @ np.array([frame.width_px / 3, frame.rows / 2, 1.0])
    for x_m, sign in ((STACK.x_m[0], 1), (STACK.x_m[2], -1)):
        on_panel = {}
        for name, eye in (("left", pair[0]), ("right", pair[1]), ("middle", frame.middle_m)):
            scale, shift = Plane(frame.x_m).scale_shift_to(Plane(x_m), eye)
            on_panel[name] = somewhere[:2] * scale + shift
        scale, shift = Plane(frame.x_m).scale_shift_to(Plane(x_m), frame.middle_m)
        for name, direction in (("left", -1), ("right", 1)):
            aligned = (on_panel[name] - shift) / scale
            moved = raster_from_plane @ np.append(aligned, 1.0) - raster_from_plane @ somewhere
            # Beyond the plane a ray from the right eye goes on to the left.
            assert moved[0] == pytest.approx(-direction * sign * frame.cell_px, rel=1e-6)
            assert moved[1] == pytest.approx(0.0, abs=1e-6)


@given(
    distance_m=st.floats(0.4, 3.0),
    angle_deg=st.floats(5, 60),
    mirrored=st.booleans(),
    height_m=st.floats(-0.2, 0.2),
    ipd_m=st.floats(0.02, 0.07),
)
def test_one_eye_may_be_nearer_than_the_other(
    distance_m: float, angle_deg: float, mirrored: bool, height_m: float, ipd_m: float
) -> None:
    angle_deg = -angle_deg if mirrored else angle_deg
    pair = eyes_at(distance_m=distance_m, angle_deg=angle_deg, height_m=height_m, ipd_m=ipd_m)
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=2)
    assume(frame.columns.bend)
    # One viewpoint stands for both eyes' parallaxes to the second order of how much nearer one is.
    within = 0.002 + 3.1 * ((pair[1, 0] - pair[0, 0]) / 2 / (frame.middle_m[0] - frame.x_m)) ** 2
    for u in (0.0, frame.width_px / 3, float(frame.width_px)):
        for v in (0.0, frame.rows * 0.7):
            t = float(frame.columns.homography_from_column(np.array(u)))
            for x_m in (STACK.x_m[0], STACK.x_m[2]):
                ways = [frame.plane_from_frame(eye, x_m=x_m) @ (t, v, 1.0) for eye in pair]
                back = [frame.frame_from_plane(x_m=x_m) @ (way / way[2]) for way in ways]
                columns = [float(column_of(frame.columns, np.array(b[0] / b[2]))) - u for b in back]
                rows = [b[1] / b[2] - v for b in back]
                assert abs(columns[0]) == pytest.approx(frame.cell_px, rel=within)  # over the whole of the raster
                assert columns[1] == pytest.approx(-columns[0], rel=2 * within)
                assert rows == pytest.approx([0.0, 0.0], abs=1e-6)


def test_a_column_law_inverts_and_without_bend_is_even() -> None:
    u = np.linspace(0.0, 400.0, 9)
    for bend in (-2e-3, 1e-9, 2e-3):
        law = ColumnLaw(bend, 200.0)
        assert column_of(law, law.homography_from_column(u)) == pytest.approx(u, abs=1e-6)
    assert ColumnLaw(1e-9, 200.0).homography_from_column(u) == pytest.approx(u, abs=1e-3)
    assert ColumnLaw().homography_from_column(u) is u


def test_the_raster_covers_all_panels_from_ahead_and_from_the_side() -> None:
    for angle_deg in (-50, -20, 0, 20, 50):
        frame = chain_frame(eyes_at(distance_m=0.7, angle_deg=angle_deg), STACK, most_cell_px=4, reduction=2)
        scale, shift = Plane(STACK.x_m[1]).scale_shift_to(Plane(frame.x_m), frame.middle_m)
        raster_from_plane = np.linalg.inv(frame.plane_from_raster)
        for y in (-0.5, 0.5):
            for z in (-0.5, 0.5):
                corner = np.array([y * STACK.width_m, z * STACK.height_m]) * scale + shift
                t, v, w = raster_from_plane @ (*corner, 1.0)
                assert -1 < v / w < frame.rows + 1
                # Beside it is only what no ray through all panels reaches.
                column = float(column_of(frame.columns, np.array(t / w)))
                assert -0.2 * frame.width_px < column < 1.2 * frame.width_px


def test_eyes_above_each_other_have_no_row_to_solve_along() -> None:
    upright = np.array([[0.6, 0.0, -0.03], [0.6, 0.0, 0.03]])
    with pytest.raises(ValueError, match="no horizontal separation"):
        chain_frame(upright, STACK, most_cell_px=4, reduction=2)


def test_a_far_viewer_of_a_thin_stack_is_limited_in_cells() -> None:
    thin = PanelStack(0.5184, 0.2916, (-0.0005, 0.0, 0.0005), 1920, 1080)
    frame = chain_frame(eyes(10.0), thin, most_cell_px=4, reduction=2)
    assert frame.cells <= 1024


TILTED, UPRIGHT = eyes(0.55, 0.12, 0.09, roll_deg=15), eyes(0.7, -0.1, 0.05)


@pytest.mark.parametrize("pair", [TILTED, UPRIGHT], ids=["tilted", "upright"])
@pytest.mark.parametrize("x_m", [-0.06, 0.0, 0.06])
def test_a_pixel_maps_to_where_the_eye_s_ray_crosses_a_panel_and_back(pair: np.ndarray, x_m: float) -> None:
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=2)
    for pixel in ([0.0, 0.0], [100.0, 30.0], [frame.width_px - 1.0, frame.rows / 2]):
        y_m, z_m, _ = frame.plane_from_raster @ [*pixel, 1.0]
        for eye_m in (*pair, frame.middle_m):
            step = np.array([frame.x_m, y_m, z_m]) - eye_m
            hit = eye_m + step * (x_m - eye_m[0]) / step[0]
            assert (frame.plane_from_frame(eye_m, x_m=x_m) @ [*pixel, 1.0])[:2] == pytest.approx(hit[1:], abs=1e-12)
    there_and_back = frame.frame_from_plane(x_m=x_m) @ frame.plane_from_frame(frame.middle_m, x_m=x_m)
    np.testing.assert_allclose(there_and_back / there_and_back[2, 2], np.eye(3), atol=1e-9)


@pytest.mark.parametrize("reduction", [1, 2, 4])
@pytest.mark.parametrize("pair", [TILTED, UPRIGHT], ids=["tilted", "upright"])
def test_rows_are_panel_rows_and_cover_the_centre_panel(pair: np.ndarray, reduction: int) -> None:
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=reduction)
    from_panel = frame.frame_from_plane(x_m=0.0)
    half_y, half_z, high = STACK.width_m / 2, STACK.height_m / 2, STACK.height_px / reduction
    # Straight above each other on the panel, both ends of any column are as many rows apart as it has.
    for y_m in (-half_y / 3, 0.0, half_y / 3):
        top, bottom = (from_panel @ [y_m, z_m, 1.0] for z_m in (half_z, -half_z))
        assert bottom[1] / bottom[2] - top[1] / top[2] == pytest.approx(high)
        assert top[1] / top[2] >= -1e-6 and bottom[1] / bottom[2] <= frame.rows + 1e-6
    middle = from_panel @ [0.0, 0.0, 1.0]
    if pair is UPRIGHT:
        assert middle[1] / middle[2] == pytest.approx(frame.rows / 2)
        assert frame.rows % BLOCK_ROWS == 0 and frame.rows - high < BLOCK_ROWS
    else:
        assert frame.rows % ROWS_STEP == 0 and frame.rows > high


def test_rows_of_oblique_eyes_grow_higher_instead_of_many() -> None:
    """With rows as high as those of level eyes, this pair would need many more than `ROWS_SHARE` allows."""
    level = chain_frame(UPRIGHT, STACK, most_cell_px=4, reduction=2)
    steep = np.array([[0.5, -0.031, -0.031], [0.5, 0.031, 0.031]])
    frame = chain_frame(steep, STACK, most_cell_px=4, reduction=2)
    assert level.rows * ROWS_SHARE <= frame.rows < level.rows * ROWS_SHARE + 2 * ROWS_STEP
    from_panel = frame.frame_from_plane(x_m=0.0)
    corners = [from_panel @ [y, z, 1.0] for y in (-STACK.width_m / 2, STACK.width_m / 2) for z in (-0.01, 0.01)]
    assert all(0 <= v / w <= frame.rows for _, v, w in corners)


def test_where_the_origin_lies_along_x_changes_nothing() -> None:
    aside = np.array([0.2, 0.0, 0.0])
    moved = replace(STACK, x_m=tuple(x_m + 0.2 for x_m in STACK.x_m))
    here, there = (
        chain_frame(p, s, most_cell_px=4, reduction=2) for p, s in ((TILTED, STACK), (TILTED + aside, moved))
    )
    assert there.x_m == pytest.approx(here.x_m + 0.2)
    assert (there.cells, there.rows) == (here.cells, here.rows)
    np.testing.assert_allclose(there.plane_from_raster, here.plane_from_raster, atol=1e-12)
    np.testing.assert_allclose(
        there.eye_sigma_px(moved, eye_sigma_m=2e-3, cell_px=4),
        here.eye_sigma_px(STACK, eye_sigma_m=2e-3, cell_px=4),
        rtol=1e-6,
    )


def test_eyes_whose_raster_would_be_far_higher_than_the_panels_are_refused() -> None:
    pair = np.array([[50.0, 50.0, 50.0], [0.07, -50.0, -50.0]])
    with pytest.raises(ValueError, match="times as high"):
        chain_frame(pair, STACK, most_cell_px=4, reduction=2)


def test_a_raster_is_at_least_a_tenth_as_wide_as_the_panels() -> None:
    """These eyes see nothing through all three panels, which are wide, so that columns are fine."""
    wide = PanelStack(5.184, 2.916, (-0.06, 0.0, 0.06), 3840, 2160)
    frame = chain_frame(eyes(0.3, 14.0), wide, most_cell_px=4, reduction=1)
    assert 0.1 <= abs(frame.plane_from_raster[0, 0]) * frame.width_px / wide.width_m < 0.13


@pytest.mark.parametrize(
    ("nearer_m", "bent"), [(0.0005, False), (0.03, True), (0.06, True), (0.07, False), (-0.1, False)]
)
def test_columns_are_even_if_the_eyes_line_meets_the_raster_or_hardly_its_plane(nearer_m: float, bent: bool) -> None:
    pair = np.array([[0.6 + nearer_m, -0.03, 0.0], [0.6 - nearer_m, 0.03, 0.0]])
    frame = chain_frame(pair, STACK, most_cell_px=4, reduction=2)
    assert bool(frame.columns.bend) == bent == (frame.rows != 136)
    # At one end, rows lie as much farther apart as columns do, which are spaced by a logarithm.
    assert frame.stretch == pytest.approx(np.exp(abs(frame.columns.bend) * frame.width_px / 2))
    at = np.array([frame.width_px / 2, frame.rows / 2, 1.0])
    for x_m, sign in ((STACK.x_m[0], 1), (STACK.x_m[2], -1)):
        there = [frame.frame_from_plane(x_m=x_m) @ frame.plane_from_frame(eye, x_m=x_m) @ at for eye in pair]
        assert [t[0] / t[2] - at[0] for t in there] == pytest.approx([sign * 2.0, -sign * 2.0], rel=0.02)
