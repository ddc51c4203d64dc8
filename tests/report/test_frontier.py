"""Displayed quality beside the eyes, and methods measured in processes of their own."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import FatalError, InputError
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.report.eyesight import as_intensity, judged, seen_rays
from runtime.report.frontier import MethodResult, check_models, measure, pareto
from runtime.report.methods import Method, shipped_and_references
from runtime.report.pairs import Painter, StillPair, eyes_at
from runtime.report.worker import apart

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)


@pytest.fixture(scope="module")
def pair() -> StillPair:
    with Painter("demo", STACK) as painter:
        return painter.pair("demo", eyes_at(distance_m=0.6), STACK, off_mm=(2, 6))


@pytest.mark.parametrize("eye", [[0.6, 0.03, 0.1], [0.2, 0.5, 0.0], [0.1, -0.4, 0.3]])
def test_some_rays_see_what_all_rays_see(eye: list[float]) -> None:
    layers = np.random.default_rng(0).integers(0, 256, (3, 108, 192, 4), dtype=np.uint8)
    whole = seen_by(eye, layers, STACK, fov_deg=70.0)
    image, mask = seen_rays(eye, layers, STACK, width_px=192, height_px=108, fov_deg=70.0, step=3)
    np.testing.assert_array_equal(mask, whole.mask[::3, ::3])
    np.testing.assert_allclose(image[mask], whole.image[::3, ::3][mask], atol=2e-4)


def test_the_judgement_is_that_of_the_optics(pair: StillPair) -> None:
    layers = np.random.default_rng(1).integers(0, 256, (3, 108, 192, 3), dtype=np.uint8)
    retinas = [seen_by(eye, layers, STACK, fov_deg=pair.fov_deg) for eye in pair.eyes_m]
    expected = quality([r.image for r in retinas], [as_intensity(i) for i in pair.images], [r.mask for r in retinas])
    seen = judged(pair, layers)
    assert seen.quality == expected
    assert seen.off_db.keys() == {"2mm", "6mm"}


def test_methods_are_measured_whole(pair: StillPair) -> None:
    methods = [Method("CG-10", "iterative", "cg", 10), Method("balanced", "network", "balanced")]
    methods.append(Method("mean of targets", "closed form", "mean"))
    told = []
    results = measure(methods, [pair], threads=1, progress=lambda done, of: told.append((done, of)))
    assert [r.name for r in results] == ["CG-10", "balanced", "mean of targets"]
    assert told == [(1, 3), (2, 3), (3, 3)]
    for result in results:
        record = result.record()
        assert record.keys() >= {
            "name", "kind", "precision", "width_px", "height_px", "ms_p50", "ms_p99", "memory_mib", "parameters",
            "psnr_db", "ssim", "worst_eye_psnr_db", "psnr_db_off_eye",
        }  # fmt: skip
        assert 0 < result.ms_p50 <= result.ms_p99
        assert 30 < result.memory_mib < 4096
        assert result.worst_eye_psnr_db <= result.psnr_db
    by_name = {r.name: r for r in results}
    assert by_name["CG-10"].psnr_db > by_name["mean of targets"].psnr_db
    assert by_name["balanced"].parameters >= 0 and by_name["mean of targets"].parameters == 0
    # What is exact at the eyes is less so beside them.
    assert by_name["CG-10"].psnr_db_off_eye["6mm"] < by_name["CG-10"].psnr_db


def result(name: str, ms: float, psnr_db: float) -> MethodResult:
    return MethodResult(name, "iterative", "fp32", 1, 1, ms, ms, 1, 1.0, 0, psnr_db, 1.0, psnr_db, {}, 1e9)


@given(st.lists(st.tuples(st.integers(1, 9), st.integers(1, 9)), min_size=1, max_size=12))
def test_the_pareto_front_is_what_nothing_beats(points: list[tuple[int, int]]) -> None:
    results = [result(str(i), ms, db) for i, (ms, db) in enumerate(points)]
    front = pareto(results)
    for other in results:
        assert any(f.ms_p50 <= other.ms_p50 and f.psnr_db >= other.psnr_db for f in front)
    for member in front:
        assert not any(
            o.ms_p50 <= member.ms_p50
            and o.psnr_db >= member.psnr_db
            and (o.ms_p50, o.psnr_db) != (member.ms_p50, member.psnr_db)
            for o in results
        )


def test_the_comparison_has_our_sizes_and_the_references() -> None:
    names = [m.name for m in shipped_and_references(models=["elsewhere/eyereal.onnx"])]
    assert names[:3] == ["fast", "balanced", "best"] and {"eyereal", "best ×½"} <= set(names)
    assert {"SART-1", "SART-3", "SART-10", "SART-30", "CG-10", "mean of targets"} <= set(names)
    assert len(set(names)) == len(names)


def test_a_model_that_is_not_there_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not a file"):
        check_models([str(tmp_path / "none.onnx")])
    (tmp_path / "bad.onnx").write_bytes(b"no onnx")
    with pytest.raises(InputError, match=r"bad\.onnx"):
        check_models([str(tmp_path / "bad.onnx")])


def test_off_eye_means_are_finite(pair: StillPair) -> None:
    seen = judged(pair, np.zeros((3, 108, 192, 3), np.uint8))
    assert all(math.isfinite(value) for value in seen.off_db.values())


def echo(value: int) -> int:
    print("noise on stdout")
    return value


def refuse() -> None:
    raise InputError("file", "field", "is wrong")


def die() -> None:
    raise SystemExit(3)


def test_a_measurement_in_a_process_of_its_own_answers_refuses_or_is_told_to_have_died() -> None:
    assert apart(echo, 7) == 7
    with pytest.raises(FatalError, match="file: field: is wrong"):
        apart(refuse)
    with pytest.raises(FatalError, match="die: the measuring process ended with 3"):
        apart(die)
