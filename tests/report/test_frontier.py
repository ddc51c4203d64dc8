"""Tests displayed quality next to the eyes, and methods measured in separate processes."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.errors import FatalError, InputError
from runtime.evaluation.displayed import displayed
from runtime.model.predictor import Predictor
from runtime.model.still import solve_still
from runtime.optics.carried import expected_psnrs_db, intensities
from runtime.optics.light import ONE_RAY
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.report.frontier import SHIPPED, Method, MethodResult, MethodRun, apart, measure, pair_result, run_method
from runtime.report.pairs import PairPainter, StillPair, eyes_at
from tests.model.test_session import saved, shipped
from tests.model_export.stills import random_still

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)


@pytest.fixture(scope="module")
def pair() -> StillPair:
    with PairPainter("demo", STACK) as painter:
        return painter.pair("demo", eyes_at(distance_m=0.6), off_mm=(2, 6))


def test_the_judgement_is_that_of_the_optics(pair: StillPair) -> None:
    layers = np.random.default_rng(1).integers(0, 256, (3, 108, 192, 3), dtype=np.uint8)
    found = pair_result(pair, MethodRun(layers, (1.0,), 1.0, 0, "fp32"))
    where: Any = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg, "sigmas_mm": (0.0, 1.0, 2.0)}
    light, rays = (expected_psnrs_db(layers, pair.images, STACK, sampling=s, **where) for s in (None, ONE_RAY))
    assert list(found.quality.light_db.values()) == pytest.approx(list(light.values()))
    assert list(found.quality.expected_db.values()) == pytest.approx(list(rays.values()))
    for distance in ("2mm", "6mm"):
        own = [view for view in pair.off if f"{view.mm:g}mm" == distance]
        alone = [seen_by(view.eye_m, layers, STACK, fov_deg=pair.fov_deg) for view in own]
        part = (slice(None, None, 3),) * 2
        values = [
            quality([r.image[part]], [intensities(v.image)[part]], [r.mask[part]], similarity=False).psnr_db
            for r, v in zip(alone, own, strict=True)
        ]
        assert found.psnr_db_off_eye[distance] == pytest.approx(np.mean(values), abs=2e-3)


def test_methods_are_measured_whole_pair_by_pair(
    pair: StillPair, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("runtime.report.frontier.apart", lambda call, *given: call(*given))
    methods = [Method("SART-3", "iterative", "sart", 3), Method("fast", "network", "fast")]
    done = list(measure(methods, [pair, replace(pair, name="again")], threads=cv2.getNumThreads(), viewers=tmp_path))
    assert "window.phasestack" in (tmp_path / "viewer-again.html").read_text()
    assert [one.viewer for one in done[-2][1].pairs] == ["viewer-demo.html", "viewer-again.html"]
    assert [what for what, _ in done] == ["SART-3, demo", "fast, demo", "SART-3, again", "fast, again"]
    newest = {result.name: result for _, result in done}
    for result in newest.values():
        assert [one.pair for one in result.pairs] == ["demo", "again"]
        assert 0 < result.ms_p50 <= result.ms_p99
        assert 30 < result.memory_mib < 4096
        assert result.worst_eye_psnr_db <= result.psnr_db
        assert result.light_db.keys() == {"0", "1", "2"}
        assert result.quoted_db == result.light_db["1"]
        # Exact at the eyes, less so next to them.
        assert result.psnr_db_off_eye["6mm"] < result.psnr_db


def test_the_precision_is_the_model_s_own(pair: StillPair, tmp_path: Path) -> None:
    """It was always fp32."""
    half = saved(shipped(), tmp_path, precision="fp16")
    run = run_method(Method("half", "network", str(half)), replace(pair, off=()), 1)
    assert run.precision == "fp16"


def test_the_contracts_page_names_every_field_of_a_method() -> None:
    page = (Path(__file__).parents[2] / "docs/contracts.md").read_text(encoding="utf-8")
    table = page.partition("| field of a method in report.json |")[2].partition("\n\n")[0]
    assert [field.name for field in fields(MethodResult) if f"`{field.name}`" not in table] == []


def echo(value: int) -> int:
    print("noise on stdout")
    return value


def refuse() -> None:
    raise InputError("file", "field", "is wrong")


def die() -> None:
    os._exit(3)


def test_a_measurement_process_answers_refuses_or_is_reported_dead() -> None:
    assert apart(echo, 7) == 7
    with pytest.raises(FatalError, match="file: field: is wrong"):
        apart(refuse)
    with pytest.raises(FatalError, match="die: the measuring process died"):
        apart(die)


class Dying(Method):
    def opened(self, stack: PanelStack, *, threads: int) -> Predictor:
        die()
        return super().opened(stack, threads=threads)


def test_a_measurement_that_dies_ends_no_other_also_of_several_at_once(pair: StillPair) -> None:
    """It ended the report."""
    methods = [Dying("dies", "iterative", "sart", 1), Method("SART-1", "iterative", "sart", 1)]
    pairs = [pair, replace(pair, name="again")]
    (_, (_, one)), two = (list(measure(methods, pairs[:n], processes=n)) for n in (1, 2))
    assert [what for what, _ in two] == ["dies, demo", "SART-1, demo", "dies, again", "SART-1, again"]
    died, last = two[2][1], two[3][1]
    assert isinstance(died, FatalError) and "process died" in str(died)
    assert isinstance(one, MethodResult) and isinstance(last, MethodResult)
    assert [each.pair for each in last.pairs] == ["demo", "again"]
    assert last.pairs[0].quality == one.pairs[0].quality


@pytest.mark.slow
@pytest.mark.parametrize("model", SHIPPED)
def test_no_random_pair_is_far_worse_than_the_iterative_reference(model: str) -> None:
    """A pair that SART-30 shows with 32 dB has at least 28 with a model."""
    for number in range(40):
        pair = random_still(0, number, width_px=480, height_px=270)
        seen: Any = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg}
        shown = []
        for method in (Method(model, "network", model), Method("SART-30", "iterative", "sart", 30)):
            predictor = method.opened(pair.stack, threads=1)
            layers = solve_still(*pair.images, predictor=predictor, **seen).layers
            shown.append(displayed(layers, pair.images, pair.stack, similarity=False, **seen).quality)
        assert shown[0].psnr_db >= 28 or shown[1].psnr_db < 32, (number, shown)
