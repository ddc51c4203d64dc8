"""Charts: at its viewpoint an eye sees straight lines at the thirds, elsewhere it does not."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from calib.chart_files import Chart, captioned, steps
from calib.charts import alone, chart_fov_deg, eye_chart, line_picture
from calib.commands import app
from calib.keys import Key
from calib.viewpoints import Viewpoint, grid
from runtime.errors import InputError
from runtime.optics.quality import psnr_db
from runtime.optics.retina import panel_positions, seen_by
from runtime.optics.stack import PanelStack
from runtime.support.artifacts import read_image

run = CliRunner()


def test_the_picture_has_ten_pixel_lines_at_the_thirds() -> None:
    picture = line_picture(width_px=1920, height_px=1080)
    assert picture.shape == (1080, 1920, 3)
    row, column = picture[10, :, 0], picture[:, 10, 0]
    assert np.flatnonzero(row == 0).tolist() == [*range(635, 645), *range(1275, 1285)]
    assert np.flatnonzero(column == 0).tolist() == [*range(355, 365), *range(715, 725)]
    assert set(np.unique(picture)) == {0, 255}


def seen_error_db(stack: PanelStack, viewpoint: Viewpoint, *, side: int, index: int, moved_m: float) -> float:
    layers = alone(eye_chart(viewpoint, stack, side=side, index=index, ipd_m=0.06), stack, index=index)
    eye = viewpoint.eyes_m(0.06)[side] + [0.0, moved_m, 0.0]
    seen = seen_by(eye, layers, stack, fov_deg=chart_fov_deg(viewpoint, stack))
    wanted = line_picture(width_px=stack.width_px, height_px=stack.height_px).astype(np.float32) / 255
    return psnr_db(float(((seen.image - wanted)[seen.mask] ** 2).mean()))


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("side", range(2))
def test_the_seeds_chart_shows_the_picture_from_its_viewpoint_alone(
    small_stack: PanelStack, index: int, side: int
) -> None:
    viewpoint = grid()[4]
    here = seen_error_db(small_stack, viewpoint, side=side, index=index, moved_m=0.0)
    assert here > 25
    assert here > 8 + seen_error_db(small_stack, viewpoint, side=side, index=index, moved_m=0.03)


def test_the_lines_are_in_the_middle_of_their_pixels(small_stack: PanelStack) -> None:
    """Half a pixel of misplacement would be seen: the centre of the ink against the thirds, in the eye's image."""
    viewpoint = grid()[0]
    layers = alone(eye_chart(viewpoint, small_stack, side=1, index=2, ipd_m=0.06), small_stack, index=2)
    seen = seen_by(viewpoint.eyes_m(0.06)[1], layers, small_stack, fov_deg=chart_fov_deg(viewpoint, small_stack))
    u = np.arange(small_stack.width_px) + 0.5
    for row in range(20, small_stack.height_px - 20, 37):
        ink = 1 - seen.image[row, :, 0]
        near = np.abs(u - small_stack.width_px / 3) < 15
        if ink[~near].min() > 0.5 or not seen.mask[row][near].all():
            continue
        if abs(row - small_stack.height_px / 3) < 10 or abs(row - 2 * small_stack.height_px / 3) < 10:
            continue
        assert (u * ink)[near].sum() / ink[near].sum() == pytest.approx(small_stack.width_px / 3, abs=0.12)


def panels_file(folder: Path) -> Path:
    path = folder / "panels.toml"
    path.write_text("width_m = 0.5184\nheight_m = 0.2916\nx_m = [-0.06, 0.0, 0.06]\nwidth_px = 480\nheight_px = 270\n")
    return path


def test_the_command_writes_the_seeds_charts_of_every_panel_and_eye(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "charts"
    names = ["R40-phi70-theta80", "R60-phi90-theta100"]
    options = [part for name in names for part in ("--viewpoint", name)]
    result = run.invoke(
        app, ["charts", "--kind", "seed", "--out", str(out), "--panels", str(panels_file(tmp_path)), *options, "--json"]
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["files"] == 12
    for name in names:
        for index in range(3):
            for eye in ("left", "right"):
                picture = read_image(out / f"chart-{name}-layer-{index}-{eye}.png")
                assert picture.shape == (270, 480, 3)
                assert picture.max() == 255 and picture.min() == 0
    listed = json.loads((out / "charts.json").read_text())["charts"]
    assert [entry["viewpoint"] for entry in listed] == names
    assert (out / "contact-sheet.png").exists()


def test_a_solved_chart_shows_both_eyes_the_picture_from_its_viewpoint_alone(tmp_path: Path) -> None:
    """Seen through the written files: the vertical lines stay clean at the viewpoint and grow ghosts 3 cm aside."""
    viewpoint = grid()[13]
    result = run.invoke(
        app,
        ["charts", "--out", str(tmp_path / "c"), "--panels", str(panels_file(tmp_path)), "--viewpoint", viewpoint.name,
         "--check", "--json"],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    layers = np.stack([read_image(tmp_path / "c" / f"chart-{viewpoint.name}-layer-{n}.png") for n in range(3)])
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
    wanted = line_picture(width_px=480, height_px=270).astype(np.float32) / 255

    def seen_db(moved_m: float) -> float:
        errors = []
        for eye in viewpoint.eyes_m():
            seen = seen_by(eye + np.array([0.0, moved_m, 0.0]), layers, stack, fov_deg=chart_fov_deg(viewpoint, stack))
            errors.append(((seen.image - wanted)[seen.mask] ** 2).ravel())
        return psnr_db(float(np.concatenate(errors).mean()))

    assert told["psnr_db"] == pytest.approx([seen_db(0.0)], abs=0.01)
    assert seen_db(0.0) > 16
    assert seen_db(0.0) > 1.5 + max(seen_db(0.03), seen_db(-0.03))


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--out", "x", "--kind", "magic"],
        ["--out", "x", "--viewpoint", "R1-phi2-theta3"],
        ["--out", "x", "--ipd-mm", "0"],
        ["--out", "x", "--panels", "no-such-file.toml"],
    ],
)
def test_wrong_requests_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: list[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert isinstance(run.invoke(app, ["charts", *options]).exception, InputError)
    assert list(tmp_path.iterdir()) == []


class Panels:
    """What was shown, in place of panels: two charts for each viewpoint."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def charts(self, viewpoint: Viewpoint) -> list[Chart]:
        layers = np.zeros((1, 1, 1, 4), np.uint8)
        return [Chart(viewpoint, label, layers) for label in ("a", "b")]

    def present(self, chart: Chart) -> None:
        self.shown.append(f"{chart.viewpoint.name} {chart.label}")


@pytest.mark.parametrize(
    ("keys", "shown"),
    [
        ([Key.NEXT] * 4, ["0a", "0b", "1a", "1b"]),
        ([Key.ACCEPT, Key.PREVIOUS, Key.QUIT], ["0a", "0b", "0a"]),
        ([Key.NEXT, Key.NEXT, Key.PREVIOUS, Key.QUIT], ["0a", "0b", "1a", "0b"]),
        ([Key.PREVIOUS, Key.QUIT], ["0a", "0a"]),
        ([Key.UP, Key.QUIT], ["0a", "0a"]),
    ],
)
def test_keys_walk_through_the_charts(keys: list[Key], shown: list[str]) -> None:
    panels, pressed = Panels(), iter(keys)
    viewpoints = grid()[:2]
    seen = [
        f"{viewpoints.index(chart.viewpoint)}{chart.label}"
        for chart in steps(panels, viewpoints, lambda: next(pressed), wait=lambda: None)
    ]
    assert seen == shown


def test_a_chart_is_presented_again_while_nobody_presses_a_key() -> None:
    panels, pressed, waits = Panels(), iter([None, None, None, Key.QUIT]), []
    list(steps(panels, grid()[:1], lambda: next(pressed), wait=lambda: waits.append(1)))
    assert len(panels.shown) == 4
    assert len(waits) == 3


@pytest.mark.parametrize("name", ["R40-phi70-theta80", "R50-phi80-theta90", "R60-phi90-theta100"])
@pytest.mark.parametrize("aside_m", [0.0, 0.07])
def test_guidance_is_read_through_the_stack_from_about_the_viewpoint(name: str, aside_m: float) -> None:
    """Where a ray crosses the middle panel's words it is bright, beside them dark, whatever the chart was there."""
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 960, 540)
    viewpoint = next(v for v in grid() if v.name == name)
    chart = np.full((3, 540, 960, 4), 200, np.uint8)
    layers = captioned(chart, "7 cm to the right", stack=stack, eyes_m=viewpoint.eyes_m())
    words = (layers[1, ..., 0] > 200) & (chart[1, ..., 0] != layers[1, ..., 0])
    rows = np.flatnonzero(words.any(axis=1))
    paper = np.zeros_like(words)
    line = slice(rows.min(), rows.max() + 1)
    paper[line] = cv2.dilate(words.astype(np.uint8), np.ones((7, 7)))[line] == 0
    for eye_m in viewpoint.eyes_m() + np.array([0.0, aside_m, 0.0]):
        view = {"fov_deg": 60.0, "width_px": 960, "height_px": 540}
        seen = seen_by(eye_m, layers, stack, **view)
        u, v = panel_positions(eye_m, stack, index=1, **view)
        inside = seen.mask & (u > 1) & (v > 1) & (u < 959) & (v < 539)
        place = v[inside].astype(int), u[inside].astype(int)
        light = seen.image[inside].mean(axis=-1)
        assert words[place].sum() > 100
        assert np.median(light[words[place]]) > 0.6
        assert np.percentile(light[paper[place]], 90) < 0.1


def test_what_check_finds_is_printed() -> None:
    from calib.commands import _fused

    assert _fused({"psnr_db": []}) == ""
    told = _fused({"psnr_db": [20.0, 18.5, 21.25], "viewpoints": ["near", "middle", "far"]})
    assert "fused: 20.00 dB at the median viewpoint, 18.50 dB at the worst (middle)" in told
    assert "far" in told and "21.25 dB" in told
    one = _fused({"psnr_db": [19.0], "viewpoints": ["near"]})
    assert one == "\nfused: 19.00 dB at the median viewpoint, 19.00 dB at the worst (near)"


def test_check_without_solved_charts_that_are_written_is_refused(tmp_path: Path) -> None:
    done = run.invoke(app, ["charts", "--out", str(tmp_path / "c"), "--kind", "seed", "--check"])
    assert done.exit_code != 0 and "--check" in str(done.exception)
