"""Tests the golden table: every implementation shows each frame as the reference does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import moderngl
import numpy as np
import pytest

from runtime.config import PanelSettings
from runtime.optics.malus import rest_code
from runtime.optics.presentation import Interpolation, panel_draws, shown_layers
from runtime.panels import processor
from runtime.records import U8
from tests.panels import presentation_table as table
from tests.panels.drawn import drawn_panels

NAMES = pytest.mark.parametrize("name", table.ROWS)


def drawn(row: table.Row, context: moderngl.Context | None) -> U8:
    """(N, h, w, 3) what the shader shows, or without a context the processor."""
    sink = drawn_panels(context, (row.stack.width_px, row.stack.height_px), *row.panels)
    sink.present(row.frame())
    found = np.stack(sink.read_back())[..., :3]
    sink.close()
    return found


@NAMES
def test_the_shader_shows_what_the_reference_shows(gl: moderngl.Context, name: str) -> None:
    assert table.agrees(drawn(table.ROWS[name], gl), table.ROWS[name].reference(Interpolation.CUBIC))


@NAMES
def test_the_processor_shows_what_the_reference_shows(name: str) -> None:
    shown, expected = drawn(table.ROWS[name], None), table.ROWS[name].reference(processor.BETWEEN)
    if table.ROWS[name].coarser >= processor.COARSE and table.ROWS[name].move_m != table.STILL and "mixed" not in name:
        shown, expected = shown[:, ::2, ::2], expected[:, ::2, ::2]  # the pixels between are averages
    assert table.agrees(shown, expected)
    assert not shown[(expected == 0).all(axis=-1)].any()  # outside the panel


@pytest.mark.parametrize("name", ["aligned", "reprojected", "coarse, moved", "turned, mirrored", "homography"])
def test_the_processor_shows_parts_as_the_reference_shows_them(name: str) -> None:
    row = table.ROWS[name]
    frame = row.frame()
    sink = drawn_panels(None, (row.stack.width_px, row.stack.height_px), *row.panels)
    assert frame.solved is not None
    rows, columns = frame.solved.shape[1:3]
    parts: tuple[Any, ...] = (np.s_[:], np.s_[:, rows // 2 :, columns // 3 :], np.s_[:, -9:-4, 7:12])
    for version, part in enumerate(parts, start=1):
        solved = np.full_like(frame.solved, rest_code(3))
        solved[part] = frame.solved[part]
        sink.present(now := replace(frame, solved=solved, solved_version=version))
        shown, expected = np.stack(sink.read_back())[..., :3], row.reference(processor.BETWEEN, now)
        by = 1 + (row.coarser > 1)  # the pixels between are averages
        assert table.agrees(shown[:, ::by, ::by], expected[:, ::by, ::by])


@NAMES
def test_rows_differ_from_the_solution_as_it_is(name: str) -> None:
    """Guards the table: each row but the first needs the law."""
    row = table.ROWS[name]
    frame = row.frame()
    assert frame.solved is not None
    changes = panel_draws(frame, row.mounts())[0].interpolation is not Interpolation.COPY or frame.flatness > 0
    assert changes == (name != "still")
    if changes and row.coarser == 1 and row.screen_px == (row.stack.width_px, row.stack.height_px):
        assert np.abs(row.reference(Interpolation.CUBIC)[0].astype(int) - frame.solved[0, ..., :3]).mean() > 3


@pytest.mark.parametrize("by", ["shader", "processor"])
def test_each_panel_has_its_own_curve_for_each_channel(request: pytest.FixtureRequest, tmp_path: Path, by: str) -> None:
    codes = np.linspace(0, 1, 256)
    exponents = np.array([[0.6, 1.0, 1.8], [1.8, 0.6, 1.0], [1.4, 1.8, 0.7]])  # by panel and channel
    for n, powers in enumerate(exponents):
        rows = np.column_stack([codes, *(codes**power for power in powers)])
        np.savetxt(tmp_path / f"{n}.csv", rows, delimiter=",", header="phase,red,green,blue", comments="")
    panels = tuple(PanelSettings(lut=str(tmp_path / f"{n}.csv")) for n in range(3))
    row = table.Row(table.STILL, relief=False, each=panels)
    shown = drawn(row, request.getfixturevalue("gl") if by == "shader" else None)
    solved = row.frame().solved
    assert solved is not None
    expected = np.rint(255 * (solved[..., :3] / 255) ** exponents[:, None, None]).astype(np.uint8)
    assert table.agrees(shown, expected)
    assert table.agrees(row.reference(Interpolation.CUBIC), expected)


@pytest.mark.parametrize("flatness", [-0.5, 1.5])
def test_a_weight_outside_its_range_is_limited(flatness: float) -> None:
    frame = table.ROWS["aligned"].frame()
    limited = replace(frame, flatness=min(max(flatness, 0.0), 1.0))
    assert np.array_equal(shown_layers(replace(frame, flatness=flatness)), shown_layers(limited))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_horizon_across_a_panel_reads_nothing_outside_the_relief(sign: float) -> None:
    """Halfway down, the homography's third coordinate is zero."""
    height = table.STACK.height_px
    bent = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, sign / (height / 2 + 0.5), -sign))
    row = replace(table.ROWS["homography"], settings=PanelSettings(homography=bent))
    assert drawn(row, None).shape == (3, height, row.stack.width_px, 3)
