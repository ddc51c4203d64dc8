"""What a solution reads and writes is counted from the passes that were really drawn."""

from __future__ import annotations

import pytest

from runtime.config import StackGeometry
from runtime.model.predictor import load_predictor
from runtime.model.unrolled import UnrolledPredictor
from runtime.report.passes import SPEEDS_GB_S, Solution, counted, table


@pytest.fixture(scope="module")
def solutions() -> list[Solution]:
    cases = ((0.0, False), (0.0, True), (20.0, False))  # pixels are large: less would not be felt
    return counted(["balanced"], width_px=240, height_px=136, cases=cases)


def test_pictures_do_not_cross_and_nothing_comes_down_but_the_raster_and_the_layers(solutions: list[Solution]) -> None:
    for one in solutions:
        assert {step.name for step in one.passes if step.crosses} == {"network down", "answer up", "layer down"}
        assert one.crossing_bytes("layer down") == 3 * 240 * 136 * 4


def test_one_pass_a_correction_moves_less_and_unsure_eyes_cost_more(solutions: list[Solution]) -> None:
    two, at_once, unsure = solutions
    assert at_once.moved_bytes < two.moved_bytes < unsure.moved_bytes
    predictor = load_predictor("balanced", StackGeometry().stack())
    assert isinstance(predictor, UnrolledPredictor)
    corrections = sum(step.kind != "chain" for step in predictor.session.contract.steps)
    assert len(two.drawn) - len(at_once.drawn) == corrections


def test_unsure_eyes_cost_less_than_four_milliseconds_of_a_small_gpu_s_memory() -> None:
    """200 GB/s. On the panels themselves: on smaller ones the network's raster reaches farther beyond them."""
    (unsure,) = counted(["balanced"], width_px=1920, height_px=1080, cases=((3.0, False),))
    assert unsure.moved_bytes < 800e6


def test_every_byte_of_an_image_counts_once_a_pass(solutions: list[Solution]) -> None:
    """The last pass reads both eyes' wanted phases and both outer panels, eight bytes a pixel; it writes layers."""
    last = solutions[0].drawn[-1]
    assert last.name == "close"
    assert last.written_bytes == 3 * 4 * 240 * 136
    assert last.read_bytes <= 4 * 8 * 240 * 136
    assert last.read_bytes % 8 == 0


def test_the_table_has_a_line_a_case_and_its_times_follow_the_memory(solutions: list[Solution]) -> None:
    assert len(table(solutions)) == 2 + len(solutions)
    times = [solutions[0].least_ms(speed) for speed in SPEEDS_GB_S]
    assert times[0] / times[-1] == pytest.approx(SPEEDS_GB_S[-1] / SPEEDS_GB_S[0])
