"""Pages: self-contained, escaped, and really there when a browser opens them."""

from __future__ import annotations

import re
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.report import frontier_page, sweep_page
from runtime.report.frontier import MethodResult
from runtime.report.horizon import Horizon, horizon_section, psnr_at
from runtime.report.latency import Run, latency_section
from runtime.report.machine import describe
from runtime.report.moving import Moving, Strip
from runtime.report.moving_page import moving_section
from runtime.report.page import Figure, Page, Section, Table, Tile
from runtime.report.plan_section import plan_section
from runtime.report.plots import drawing, label_points, png
from runtime.report.stability.page import stability_page
from runtime.report.stability.trial import Answer, Trial, settle
from runtime.report.sweeps import Curve, Size, Tolerance, Trade, Volume

BROWSER = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
)  # fmt: skip

COUNT_DECODED = """addEventListener("load", () => { document.documentElement.dataset.decoded =
  [...document.images].filter((image) => image.naturalWidth > 0).length; });"""


def method(name: str, kind: str, ms: float, psnr: float) -> MethodResult:
    off = {"2mm": psnr - 6, "4mm": psnr - 9, "6mm": psnr - 11}
    told = (960, 540, ms, ms * 1.3, 9, 200.0, 81, psnr, 0.97, psnr - 1, off, 2e9, {"1": psnr - 3, "2": psnr - 6})
    return MethodResult(name, kind, "fp32", *told)  # type: ignore[arg-type]


def moving_runs_made_up() -> tuple[list[Moving], Strip]:
    found = [
        Moving(motion, solver_ms, aligned, 27.0 if aligned else 27.0 - solver_ms / 20, 9, (3.0, 7.0), solver_ms / 4)
        for motion in ("still", "lean")
        for solver_ms in (33.0, 150.0)
        for aligned in (False, True)
    ]
    picture = np.random.default_rng(0).integers(0, 256, (3, 27, 48, 3), dtype=np.uint8)
    return found, Strip("lean", 150.0, [1.0, 1.2, 1.4], picture, picture, [18, 19, 20], picture, [26, 27, 28])


@cache
def report_page() -> Page:
    """The report's sections on made-up measurements: what is looked at here is the page."""
    methods = [
        method("fast", "network", 20, 36),
        method("balanced", "network", 40, 41),
        method("SART-10", "iterative", 900, 40),
    ]
    wave = np.add.outer(np.linspace(0, 5, 9), np.linspace(25, 30, 9))
    holed = wave.copy()
    holed[0, :3] = np.nan
    tolerance = Tolerance(tuple(range(-8, 9, 2)), wave)
    percentiles = np.linspace([2.0, 5.0], [9.0, 30.0], 7)
    runs = [
        Run(
            name,
            np.random.default_rng(1).normal(70, 8, 60),
            {"stage_ms": {"render": {"p50": 9.0}, "finish": {"p50": 7.0}}, "fps": 30.0, "inferences": 50, "dropped": 0,
             "psnr_db": 38.5, "plan": [{"what": "inference"}]},
        )
        for name in ("plan on", "plan off")
    ]  # fmt: skip
    sections = [
        frontier_page.frontier_section(methods, pairs="a pair", title="Frontier", name="test"),
        sweep_page.volume_section(Volume(range(9), range(9), holed, holed - 2), model="balanced", scene="demo"),
        sweep_page.tolerance_section(tolerance, model="balanced", distance_m=0.6),
        sweep_page.trade_section(
            [Trade("balanced", [0.0, 1.0, 2.0], {0.0: [42, 41, 40], 1.0: [35, 38, 37.0], 2.0: [30, 32, 36.0]})],
            where="a scene",
        ),
        moving_section(*moving_runs_made_up()),
        sweep_page.gap_section([Curve("balanced", [5, 30, 60], [30, 35, 36], [29, 33, 32])]),
        sweep_page.resolution_section(
            [Size("balanced", 480, 270, 9.0, 30.0, 29.0), Size("balanced", 960, 540, 30.0, 35.0, 31.0)]
        ),
        horizon_section([Horizon(name, percentiles, 2 * percentiles) for name in ("still", "walk")], tolerance),
        latency_section(runs),
    ]
    return Page("Error against run time", "A lead.", sections, describe(seed=0), "phasestack report", [Tile("1", "x")])


def small_stability_page() -> Page:
    cases = [
        settle(Trial("solve", f"CG-30, gap {n}", lambda n=n: Answer(n / 10, 1.0, 10.0**n), measure="of the difference"))
        for n in range(1, 6)
    ]
    return stability_page(cases, machine=describe(), seconds=1.0, command="phasestack stability")


def browse(tmp_path: Path, *arguments: str) -> str:
    assert BROWSER is not None
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    command = [BROWSER, *FLAGS, profile, "--virtual-time-budget=5000", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=120).stdout


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
@pytest.mark.parametrize("make", [report_page, small_stability_page])
def test_a_browser_decodes_every_plot_of_the_page(make: Any, tmp_path: Path) -> None:
    page = make()
    path = tmp_path / "index.html"
    path.write_text(page.html().replace("</body>", f"<script>{COUNT_DECODED}</script></body>"))
    dom = browse(tmp_path, "--dump-dom", path.as_uri())
    decoded = re.search(r'<html[^>]*data-decoded="(\d+)"', dom)
    assert decoded is not None, "the script did not run"
    assert int(decoded[1]) == len(page.figures()) > 0
    for section in page.sections:
        assert section.title in dom


@pytest.mark.skipif(BROWSER is None, reason="no chromium on this machine")
def test_the_plots_can_be_seen_on_a_screenshot(tmp_path: Path) -> None:
    """One flat red picture on the page must show up as that much red."""
    red = np.zeros((200, 300, 3), np.uint8)
    red[..., 2] = 255
    figure = Figure("red", cv2.imencode(".png", red)[1].tobytes(), "red")
    page = Page("title", "lead", [Section("section", figures=[figure])], {}, "command")
    (tmp_path / "index.html").write_text(page.html())
    shot = tmp_path / "shot.png"
    browse(tmp_path, "--window-size=1000,900", f"--screenshot={shot}", (tmp_path / "index.html").as_uri())
    image = cv2.imread(str(shot)).astype(int)
    reddish = (image[..., 2] > 200) & (image[..., 1] < 60) & (image[..., 0] < 60)
    assert reddish.sum() == pytest.approx(200 * 300, rel=0.02)


def test_the_page_needs_nothing_from_elsewhere() -> None:
    html = report_page().html()
    assert not re.search(r"""(src|href)=["'](?!data:image/png|#)""", html)
    assert "http:" not in html and "https:" not in html and "@import" not in html


def test_the_page_states_machine_versions_seed_date_and_command() -> None:
    html = report_page().html()
    for value in (*describe(seed=0).keys(), "phasestack report", describe()["processor"]):
        assert value in html


def test_texts_are_escaped() -> None:
    section = Section("<b>title</b>", ["a < b & c"], tables=[Table(["<i>"], [["<script>"]])])
    html = Page("<x>", "<y>", [section], {"<k>": "<v>"}, "a && b").html()
    for raw in ("<b>title", "<i>", "<x>", "<y>", "<k>", "<v>", "<script>\n</td>"):
        assert raw not in html
    assert "&lt;script&gt;" in html


def test_columns_of_numbers_are_set_flush_right() -> None:
    table = Table(["name", "value", "note"], [["a", "1.5", ""], ["b", "-2", ""], ["c", "∞", ""]])
    assert table.numeric() == [False, True, False]


def test_the_same_data_give_the_same_picture() -> None:
    first, second = (page.sections[3].figures[0].png for page in (report_page(), report_page.__wrapped__()))
    assert first == second


def test_a_times_table_shows_ratios_beside_milliseconds() -> None:
    table = report_page().sections[0].tables[0]
    column = list(table.headings).index("× fastest")
    assert [row[column] for row in table.rows] == ["1.0", "2.0", "45.0"]
    assert list(table.styles) == ["good", "good", ""]


def test_exact_and_expected_stand_side_by_side_in_the_frontiers_table() -> None:
    section = report_page().sections[0]
    table = section.tables[0]
    columns = [list(table.headings).index(name) for name in ("PSNR dB", "expected 1 mm dB", "expected 2 mm dB")]
    assert columns == list(range(columns[0], columns[0] + 3))
    assert [table.rows[0][column] for column in columns] == ["36.00", "33.00", "30.00"]
    assert [figure.name for figure in section.figures][:2] == ["frontier-test", "expected-test"]


def test_held_and_aligned_stand_side_by_side_over_the_solvers_time() -> None:
    (section,) = [section for section in report_page().sections if "moving" in section.title]
    (table,) = section.tables
    assert [list(row[:4]) for row in table.rows] == [
        ["still", "33", "25.4", "27.0"],
        ["still", "150", "19.5", "27.0"],
        ["lean", "33", "25.4", "27.0"],
        ["lean", "150", "19.5", "27.0"],
    ]


def test_an_untrained_network_has_a_time_and_no_error() -> None:
    untrained = replace(method("eyereal", "network", 10, 99), trained=False)
    results = [method("fast", "network", 20, 36), untrained, method("SART-10", "iterative", 900, 40)]
    section = frontier_page.frontier_section(results, pairs="a pair", title="Frontier", name="test")
    (table,) = section.tables
    rows = {row[0]: dict(zip(table.headings, row, strict=True)) for row in table.rows}
    assert rows["eyereal"]["p50 ms"] == "10.0" and rows["eyereal"]["10⁹ multiply-adds"] == "2.0"
    assert rows["eyereal"]["PSNR dB"] == rows["eyereal"]["2mm off dB"] == ""
    assert rows["fast"]["PSNR dB"] == "36.00"
    assert dict(zip(rows, table.styles, strict=True)) == {"eyereal": "", "fast": "good", "SART-10": "good"}
    assert any("untrained" in text for text in section.text)


def test_the_survey_of_the_plan_is_a_table_of_scenes_and_two_plots() -> None:
    row = {"kind": "sparse object on white", "ms_with": 12.3, "ms_without": 40.0, "faster": 3.3, "db_with": 38.0,
           "db_without": 38.01, "active_fraction": 0.08, "channels": 1, "left_out": ({"what": "pixels"},)}  # fmt: skip
    record = {"model": "balanced", "width_px": 1920, "height_px": 1080, "scenes": [row], "other_sparse": [row]}
    section = plan_section(record, {"plan-scenes": b"one", "plan-regions": b"two"})
    (table,) = section.tables
    assert [list(cells) for cells in table.rows] == [
        ["sparse object on white", "12.3", "40.0", "3.30", "38.00", "38.01", "8%", "1", "pixels"]
    ] * 2
    assert [figure.png for figure in section.figures] == [b"one", b"two"]


def test_names_of_dots_lie_neither_on_one_another_nor_beyond_the_axes() -> None:
    points = [(1.0, 1.0, "first"), (1.01, 1.0, "second"), (1.0, 1.02, "third"), (2.0, 2.0, "at the edge")]
    with drawing(5, 3) as figure:
        axes = figure.add_subplot()
        axes.scatter([x for x, _, _ in points], [y for _, y, _ in points])
        axes.set(xlim=(0.9, 2.0), ylim=(0.9, 2.1))
        label_points(figure, axes, points)
        png(figure)
        frame = axes.get_window_extent()
        boxes = [text.get_window_extent() for text in axes.texts if text.get_text()]
    assert len(boxes) == len(points)
    for index, box in enumerate(boxes):
        assert frame.x0 - 1 <= box.x0 and box.x1 <= frame.x1 + 1
        assert not any(box.overlaps(other) for other in boxes[:index])


def test_the_price_of_an_error_is_read_off_the_tolerance_map() -> None:
    offsets = tuple(range(-8, 9, 2))
    distance = np.hypot(*np.meshgrid(np.array(offsets), np.array(offsets)))
    tolerance = Tolerance(offsets, 40 - 2 * distance)
    assert psnr_at(tolerance, 0.0) == 40.0
    assert psnr_at(tolerance, 3.0) == pytest.approx(34.0, abs=0.5)
    assert psnr_at(tolerance, 100.0) == psnr_at(tolerance, 8.0)
