"""Content moves with the eyes by its depth: against the projection of points, and in light."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from runtime.config import Settings, with_options
from runtime.content.registry import open_content
from runtime.evaluation.refresh_quality import live_error
from runtime.model.predictor import load_predictor
from runtime.optics.alignment import align
from runtime.optics.presentation import displacement, panel_draws, shown_layers
from runtime.optics.relief import RIM_PX, parallax, relief_of
from runtime.optics.stack import PanelStack
from runtime.plan.drawing import drawn_job, retina_pictures
from runtime.records import F64, PanelFrame
from runtime.support.gl import offscreen_context
from tests.content.test_splat import splat_table, written

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES_M = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])
FOV_DEG = 46.0


def metres(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


def on_panel(panel: int, eye_m: F64, point_m: F64) -> F64:
    """Pixel of a panel through which a point is seen: the ray's intersection, pixel by pixel."""
    raster = STACK.panel(panel)
    y_m, z_m = (eye_m + (point_m - eye_m) * (eye_m[0] - raster.x_m) / (eye_m[0] - point_m[0]))[1:]
    return np.array([(y_m - raster.left_m) / raster.pitch_u_m, (raster.top_m - z_m) / raster.pitch_v_m])


@given(
    st.tuples(metres(-0.1, 0.1), metres(-0.1, 0.1), metres(-0.1, 0.1)),
    st.tuples(metres(0.4, 1.5), metres(-0.2, 0.2), metres(-0.2, 0.2)),
    st.tuples(metres(0.4, 1.5), metres(-0.2, 0.2), metres(-0.2, 0.2)),
)
def test_a_point_is_found_where_the_old_middle_saw_it(
    point: tuple[float, ...], old: tuple[float, ...], new: tuple[float, ...]
) -> None:
    point_m, old_m, new_m = map(np.array, (point, old, new))
    moved = parallax(STACK, old_m=old_m, new_m=new_m)
    if moved is None:
        assert np.array_equal(old_m, new_m)
        return
    relief = np.full((2, 2), point_m[0] / (old_m[0] - point_m[0]), np.float32)
    aligned = align(STACK, solved_for_m=np.stack([old_m] * 2), eyes_m=np.stack([new_m] * 2))
    for panel in range(3):
        shown = on_panel(panel, new_m, point_m)
        right, down = displacement(moved, panel, relief, (480, 270), shown[None, :1], shown[None, 1:])
        matrix = aligned.solved_from_shown[panel]
        found = shown * np.diag(matrix)[:2] + matrix[:2, 2] + np.array([right.item(), down.item()])
        assume(not aligned.limited)
        np.testing.assert_allclose(found, on_panel(panel, old_m, point_m), atol=2e-3 * (1 + np.abs(shown).max()))


def test_the_relief_of_the_middle_panel_and_of_the_background_is_none() -> None:
    nearness = np.full((2, 40, 60), 1 / 0.6, np.float32)
    nearness[:, :20] = 0.0
    assert not relief_of(nearness, distance_m=(0.6, 0.6)).round(6).any()


def test_nearer_content_extends_by_a_rim() -> None:
    nearness = np.zeros((2, 40, 60), np.float32)
    nearness[:, 20, 30] = 1 / 0.5
    relief = relief_of(nearness, distance_m=(0.6, 0.6))
    expected = np.zeros((40, 60))
    expected[20 - RIM_PX : 21 + RIM_PX, 30 - RIM_PX : 31 + RIM_PX] = 0.2
    np.testing.assert_allclose(relief, expected, atol=1e-6)


def test_distances_that_are_not_numbers_have_no_relief() -> None:
    nearness = np.full((6, 30), 2.0, np.float32)
    nearness[:, 10:20], nearness[:, 20:] = np.inf, np.nan
    relief = relief_of((nearness, nearness), distance_m=(0.6, 0.6))
    assert np.isfinite(relief).all()
    assert relief[0, 0] == pytest.approx(0.2) and not relief[:, 12:].any()


def test_without_a_movement_or_a_middle_panel_nothing_is_displaced() -> None:
    middle = EYES_M.mean(axis=0)
    assert parallax(STACK, old_m=middle, new_m=middle) is None
    even = PanelStack(0.5184, 0.2916, (-0.03, 0.03), 480, 270)
    assert parallax(even, old_m=middle, new_m=middle + 0.01) is None
    moved = align(STACK, solved_for_m=EYES_M, eyes_m=EYES_M + 0.01)
    frame = PanelFrame(1, np.zeros((3, 9, 16, 4), np.uint8), 1, moved.solved_from_shown, parallax=moved.parallax)
    assert all(draw.relief is None for draw in panel_draws(frame))


def sheets(folder: Path) -> Path:
    """Splats that reach over three upright sheets, 8 cm apart, each with waves of its own colour."""
    random, each = np.random.default_rng(0), 7000
    table = splat_table(3 * each, degree=0)
    for number, half_m in enumerate((0.26, 0.11, 0.07)):
        rows = slice(number * each, (number + 1) * each)
        across, up = random.uniform(-1, 1, (2, each))
        table["x"][rows], table["y"][rows] = across * half_m + (0.0, -0.1, 0.12)[number], up * half_m * 0.56
        table["z"][rows] = 0.08 * (1 - number)  # -z is to the viewer
        for channel, colour in enumerate((0.6, -0.2, 0.2)):
            wave = np.sin(10 * across) * np.sin(6 * up)
            table[f"f_dc_{channel}"][rows] = 0.5 * wave + colour * (1 - number)
            table[f"scale_{channel}"][rows] = np.log(1.8 * half_m / np.sqrt(each))
    table["opacity"] = 0.8
    return written(folder, table)


@pytest.mark.parametrize(
    ("scene", "step_m"),
    [("demo", (0.0, 0.02, 0.0)), ("demo", (0.0, -0.02, 0.01)), ("demo", (0.05, 0.0, 0.0)), ("", (0.0, -0.02, 0.01))],
    ids=["right", "left and up", "back", "splats"],
)
def test_a_moved_eye_sees_its_own_view_in_light(tmp_path: Path, scene: str, step_m: tuple[float, float, float]) -> None:
    """Of the error that 2 cm of staleness add, at least half goes: against pictures drawn for where the eyes are."""
    now_m = EYES_M + np.array(step_m)
    with offscreen_context() as context:
        scene = scene or str(sheets(tmp_path))
        content = open_content(with_options(Settings(), scene=scene).content, STACK, context)
        predictor = load_predictor("balanced", STACK)
        targets = retina_pictures(content, now_m, STACK, fov_deg=FOV_DEG, time_ns=0)
        fresh = predictor.solve(drawn_job(predictor, content, now_m, time_ns=0)).layers
        job = drawn_job(predictor, content, EYES_M, time_ns=0, in_depth=True)
        layers = predictor.solve(job).layers
        content.close()
    moved = align(STACK, solved_for_m=EYES_M, eyes_m=now_m)
    frame = PanelFrame(1, layers, 1, moved.solved_from_shown, relief=job.relief, parallax=moved.parallax)
    best, displaced, carried = (
        live_error(shown, targets, STACK, eyes_m=now_m, fov_deg=FOV_DEG)
        for shown in (fresh, shown_layers(frame), shown_layers(replace(frame, relief=None)))
    )
    assert best < displaced < best + 0.5 * (carried - best)
