"""Tests that `phasestack tolerance` measures costs, crosstalk and freedom, and that its figures follow from its law."""

from __future__ import annotations

import json
import math
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

import phasestack
from runtime.commands.tolerance import told, tolerance
from runtime.config import StackGeometry
from runtime.errors import InputError
from runtime.optics.quality import psnr_db
from runtime.optics.real.light import RealSampling
from runtime.optics.real.panels import Optics, Placement, RealPanels
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.report.crosstalk import parallax_m, theory_percent, uniformity
from runtime.report.pairs import StillPair, eyes_at
from runtime.report.tolerance import (
    IMPERFECTIONS,
    PIXELS_FIRST,
    Bench,
    Cost,
    Subject,
    late_front,
    merged,
    monitor_share,
    solved,
    together,
)
from runtime.report.tolerance_page import LOOKS, assumption, cost_entry, geometry, seen_through
from tests.test_contracts import fields_of


def command(*arguments: str) -> Any:
    app = typer.Typer()
    app.command()(tolerance)
    return CliRunner().invoke(app, list(arguments))


@pytest.fixture(scope="module")
def subject() -> Subject:
    pair = phasestack.example_pair()
    return solved(StillPair("example", pair.stack, pair.eyes_m, (pair.left, pair.right), pair.fov_deg))


def test_all_imperfections_begin_with_ideal_panels() -> None:
    stack = PanelStack(0.5, 0.3, (-0.03, 0.0, 0.03), 64, 36)
    for one in IMPERFECTIONS:
        ideal = merged(RealPanels(), one.make(one.sizes[0], stack), stack.count)
        assert ideal.cells == (RealPanels().cells[0],) * 3, one.name
        assert ideal.placement == (Placement(),) * 3, one.name
        assert ideal.timing.is_still, one.name
        assert bool(one.unit) != bool(one.choices), one.name
        assert one.named(one.assumed), one.name


def test_half_a_pixel_of_misalignment_costs_more_than_an_eighth(subject: Subject) -> None:
    (shift,) = (one for one in IMPERFECTIONS if one.name == "shift of the front panel")
    bench = Bench([subject])
    eighth, half = (bench.light(lambda stack, size=size: shift.make(size, stack), 1500) for size in (0.125, 0.5))  # type: ignore[misc]
    assert bench.ideal_db > eighth > half + 1
    measured = phasestack.evaluate(
        subject.layers, *subject.pair.images, stack=subject.pair.stack, eyes_m=subject.pair.eyes_m,
        fov_deg=subject.pair.fov_deg, panels=shift.make(0.5, subject.pair.stack), every=8,
    )  # fmt: skip
    assert measured.light_db["1"] == pytest.approx(half, abs=1.0)
    assert math.isnan(measured.psnr_db)


def test_ideal_panels_cost_nothing(subject: Subject) -> None:
    bench = Bench([subject])
    assert bench.light(lambda _: RealPanels(), 1500) == pytest.approx(bench.ideal_db)


def test_a_remedy_gives_light_back(subject: Subject) -> None:
    bench = Bench([subject])
    for name in ("full white short of 90 degrees", "dark state that turns", "glass on each side of a panel"):
        (one,) = (one for one in IMPERFECTIONS if one.name == name)
        before = bench.light(lambda stack, one=one: one.make(one.assumed, stack), 1500)  # type: ignore[misc]
        assert bench.light(one.after, 1500) > before + 1, name


def test_a_late_panel_costs_little_if_the_alignment_allows_for_it(subject: Subject) -> None:
    bench = Bench([subject])
    before, after = (
        bench.light(partial(late_front, 1e3 / 60, allowed=allowed, head_m_s=0.3), 1500) for allowed in (False, True)
    )
    assert before < bench.ideal_db - 3
    assert after > bench.ideal_db - 0.5


def test_the_size_that_costs_a_decibel_is_interpolated() -> None:
    (shift,) = (one for one in IMPERFECTIONS if one.name == "shift of the front panel")
    assert Cost(shift, [37.0, 36.9, 36.5, 35.5, 33.0, 30.0]).costs_1_db_at(37.0) == pytest.approx(0.375)
    assert Cost(shift, [37.0, 36.9, 36.8, 36.8, 36.7, 36.7]).costs_1_db_at(37.0) is None


def test_imperfections_together_keep_each_one() -> None:
    stack = PanelStack(0.5, 0.3, (-0.03, 0.0, 0.03), 64, 36)
    everything = together(IMPERFECTIONS, stack, left=False)
    assert everything.placed(2).rotation_mrad == 1.0
    assert everything.placed(2).right_mm == pytest.approx(1.6 * 500 / 64)
    assert everything.cell(0).kind == "rotator"  # a stack of other cells is never ordered
    assert everything.cell(0).white_deg == 85.0
    assert everything.optics.filters == (True, True, True)
    assert everything.timing.response_ms == 2.5


@pytest.mark.parametrize(
    ("colour", "filters", "share"),
    [
        ((), (True, True, True), 0.36 * (0.85 / 3) ** 2),
        ((True, True, False), (True, True, False), 0.36 * 0.85 / 3),
        ((True, False, False), (True, False, False), 0.36),
    ],
)
def test_the_stacks_own_filters_are_assumed(colour: tuple[bool, ...], filters: tuple[bool, ...], share: float) -> None:
    stack = PanelStack(0.5, 0.3, (-0.03, 0.0, 0.03), 64, 36, colour=colour)
    for left in (False, True):
        panels = together(IMPERFECTIONS, stack, left=left)
        assert panels.optics.filters == filters
        assert panels.optics.diffracts
        assert panels.lighting.white_cd_m2 == pytest.approx(300 * share)
    assert monitor_share(stack) == pytest.approx(share)
    assert all(f"{n}" in assumption(stack) for n in range(3) if filters[n]) or all(filters)


def test_stacks_whose_pixels_pass_few_rays_are_measured_with_more(subject: Subject) -> None:
    used = []

    def counted(_: Subject, panels: RealPanels, sampling: RealSampling) -> float:
        if panels.optics.filters is not None:
            used.append(sampling.rays**2 * panels.optics.passed)
        return 0.01

    bench = Bench([subject])
    bench._error = counted  # type: ignore[method-assign]
    for filters in ((True,) * 3, (True, True, False), (False,) * 3):
        bench.light(lambda _, f=filters: RealPanels(optics=Optics(filters=f, aperture=0.6)), 1500)  # type: ignore[misc]
    assert len(used) == 3
    assert all(6 <= rays < 9 for rays in used)


def test_light_of_small_pictures_is_compared_at_the_panels_resolution(tmp_path: Path) -> None:
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 320, 180)
    rows, columns = np.mgrid[0:90, 0:160]
    left = np.repeat(((rows // 9 + columns // 9) % 2 * 200).astype(np.uint8)[..., None], 3, axis=2)
    images = (left, np.roll(left, 2, axis=1))
    eyes_m = eyes_at(distance_m=0.6)
    subject = solved(StillPair("", stack, eyes_m, images, 40.0))
    result = phasestack.solve(*images, eyes_m=eyes_m, stack=stack, fov_deg=40)
    assert psnr_db(subject.ideal_error) == pytest.approx(result.quality.light_db["1"], abs=0.1)
    real = phasestack.evaluate(
        subject.layers, *images, stack=stack, eyes_m=eyes_m, fov_deg=40, panels=RealPanels(), every=1
    )
    assert real.light_db["1"] == pytest.approx(result.quality.light_db["1"], abs=0.1)


def test_the_terminal_names_choices_and_signs_no_zero() -> None:
    ideal_db = 34.0
    costs = [Cost(one, [], ideal_db - 1, ideal_db + 0.01) for one in IMPERFECTIONS]
    record = {
        "costs": [cost_entry(cost, ideal_db) for cost in costs], "ideal_db": ideal_db, "distance_m": [0.6],
        "crosstalk": [{"patch_mm": mm, "percent": 5.0} for mm in (4.0, 500.0)], "full_field_crosstalk_percent": 90.0,
        "viewing_freedom": {"without_tracking": {"up": {"falls_3_db_at_mm": None, "mm": [0, 32]}}},
        "stack": geometry(StackGeometry().stack()),
    }  # fmt: skip
    lines = "\n".join(told(record))
    assert "twisted nematic" in lines
    assert "kind of cell 2" not in " ".join(lines.split())
    assert "-0.0 " not in lines
    assert "hard to distinguish" in lines
    assert "3 panels of 0.5184 x 0.2916 m and 1920 x 1080 pixels, at -0.06, 0, 0.06 m." in lines


def test_words_for_decibels_are_those_of_the_viewer() -> None:
    script = (files("runtime.browser") / "assets" / "look.js").read_text(encoding="utf-8")
    for least_db, words in LOOKS.items():
        assert words in script
        assert math.isinf(least_db) or f"light_db > {least_db}" in script


@pytest.mark.parametrize(
    ("table", "arguments", "complaint"),
    [
        ("x_m = [-0.06, 0.0, 0.7]", [], "stack.toml: stack.x_m: the front panel is at 0.7 m"),
        ("x_m = [-0.06, 0.0, 0.06]", ["--distance-m", "0.06"], "stack.toml: stack.x_m"),
        ("", ["--pairs", "."], "tolerance: --config: the case files"),
    ],
)
def test_what_cannot_be_measured_is_refused_at_once(
    tmp_path: Path, table: str, arguments: list[str], complaint: str
) -> None:
    config = tmp_path / "stack.toml"
    config.write_text(f"[stack]\n{table}\n")
    done = command("--config", str(config), "--out", str(tmp_path / "out"), *arguments)
    assert isinstance(done.exception, InputError)
    assert complaint in str(done.exception)
    assert not (tmp_path / "out").exists()


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.report.tolerance_page.ToleranceRun.run", lambda *_: pytest.fail("was started"))
    done = command("--out", "/proc/x")
    assert isinstance(done.exception, InputError)
    assert "cannot be written" in str(done.exception)


def test_the_picture_shows_ideal_panels_as_they_are_seen(subject: Subject) -> None:
    pair = subject.pair
    seen = seen_through(subject, RealPanels())
    middle, right = (seen_by(eye, subject.layers, pair.stack, fov_deg=pair.fov_deg).image for eye in pair.eyes_m)
    rows, columns = ((whole - part) // 2 for whole, part in zip(middle.shape[:2], seen.shape[:2], strict=True))
    crop = np.s_[rows : rows + seen.shape[0], columns : columns + seen.shape[1]]
    assert np.abs(seen - middle[crop]).mean() < 0.03 < np.abs(seen - right[crop]).mean()


def test_patches_up_to_four_parallaxes_have_no_crosstalk_in_theory() -> None:
    parallax = parallax_m(PanelStack(0.5, 0.3, (-0.03, 0.0, 0.03), 64, 36), eyes_at(distance_m=0.6))
    assert parallax == pytest.approx(0.0315 * 0.03 / 0.6)
    assert theory_percent(3.9 * parallax, parallax) == pytest.approx(0.0)
    assert theory_percent(8 * parallax, parallax) == pytest.approx(100 * (1 - math.sqrt(0.5)) / (1 + math.sqrt(0.5)))
    assert theory_percent(1000.0, parallax) > 95


def test_uniformity_is_that_of_the_ninth_point() -> None:
    assert uniformity(0.2) == pytest.approx(1 - 0.2 * 2 * 2 * 0.4**2)


def test_bad_pairs_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    done = command("--pairs", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"))
    assert isinstance(done.exception, InputError)
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_run_leaves_its_page_and_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("tolerance", "tolerance_page"):
        monkeypatch.setattr(f"runtime.report.{module}.PIXELS", PIXELS_FIRST)  # the curves' shape is not tested here
    phasestack.example_pair().save(tmp_path / "pairs")
    done = command("--pairs", str(tmp_path / "pairs"), "--out", str(tmp_path / "out"))
    assert done.exit_code == 0, done.output
    record = json.loads((tmp_path / "out" / "tolerance.json").read_text())
    assert record["complete"]
    assert fields_of("field of tolerance.json") <= record.keys()
    assert "%" in done.output
    for cost in record["costs"]:
        assert {"name", "unit", "assumed", "assumed_costs_db"} <= cost.keys()
        assert len(cost["sizes"]) == len(cost["light_db"])
        assert cost["light_db"][0] == pytest.approx(record["ideal_db"])
    percents = [found["percent"] for found in record["crosstalk"]]
    assert percents[-1] > 80 > 20 > min(percents)
    theory = [found["theory_percent"] for found in record["crosstalk"]]
    assert np.corrcoef(percents, theory)[0, 1] > 0.95
    assert "What real panels would show" in (tmp_path / "out" / "index.html").read_text()
    assert {"costs.png", "crosstalk.png", "seen-left.png"} <= {path.name for path in (tmp_path / "out").iterdir()}
