"""Pages: self-contained, and escaped."""

from __future__ import annotations

import re

from runtime.evaluation.solved import PairQuality
from runtime.report.frontier import MethodResult, PairResult
from runtime.report.moving import Moving
from runtime.report.page import Page, Section, Table, describe
from runtime.report.sections import frontier_section, moving_section


def method(name: str, kind: str, ms: float, light: float) -> MethodResult:
    off = {"2mm": light - 6, "4mm": light - 9, "6mm": light - 11}
    dB = {"0": light + 2, "1": light, "2": light - 3}
    told = (960, 540, ms, ms * 1.3, 200.0, 81, dB, dB, light + 3, 0.97, light + 1, off)
    quality = PairQuality(dB, dB, light, 0.97, (light, light))
    pair = PairResult("a pair", (ms,), 200.0, quality, off)
    return MethodResult(name, kind, "fp32", *told, pairs=[pair])  # type: ignore[arg-type]


def report_page() -> Page:
    """The report's sections on made-up measurements: what is looked at here is the page."""
    methods = [
        method("fast", "network", 20, 36),
        method("balanced", "network", 40, 41),
        method("SART-10", "iterative", 900, 40),
    ]
    moving = [
        Moving(motion, solver_ms, 27.0 - solver_ms / 20, 9, (3.0, 7.0), solver_ms / 4)
        for motion in ("still", "lean")
        for solver_ms in (33.0, 150.0)
    ]
    sections = [
        frontier_section(methods, title="Frontier", name="test"),
        moving_section(moving),
    ]
    return Page("Error against run time", "A lead.", sections, describe(), "phasestack report")


def test_the_page_needs_nothing_from_elsewhere() -> None:
    page = report_page()
    html = page.html()
    assert html.count("data:image/png;base64,") == len(page.figures()) == 2
    assert all(figure.png.startswith(b"\x89PNG") for figure in page.figures())
    assert not re.search(r"""(src|href)=["'](?!data:image/png|#)""", html)
    assert "http:" not in html and "https:" not in html and "@import" not in html


def test_texts_are_escaped() -> None:
    section = Section("<b>title</b>", ["a < b & c"], tables=[Table(["<i>"], [["<script>"]])])
    html = Page("<x>", "<y>", [section], {"<k>": "<v>"}, "a && b").html()
    for raw in ("<b>title", "<i>", "<x>", "<y>", "<k>", "<v>", "<script>\n</td>"):
        assert raw not in html
    assert "&lt;script&gt;" in html
