"""Tests what docs/contracts.md promises for `import phasestack`."""

from __future__ import annotations

import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import phasestack
from runtime.commands.app import app
from runtime.errors import InputError
from runtime.evaluation import solved
from runtime.optics.disparity import _compared, disparity_doubts
from runtime.optics.stack import PanelStack
from runtime.report.pairs import PairPainter, read_pairs
from runtime.support.artifacts import write_png
from tests.model.scenes import card_scene
from tests.optics.test_cameras import parallel, taken
from tests.test_cli import pair_in, solve_arguments
from tests.test_extras import of_extras

STACK = phasestack.Stack(width_m=0.5184, height_m=0.2916, x_m=(-0.06, 0.0, 0.06), width_px=320, height_px=180)
EYES = ((0.78, -0.03, 0.24), (0.78, 0.03, 0.24))


def picture(shift_px: int = 0) -> np.ndarray:
    coarse = np.random.default_rng(2).integers(0, 256, (12, 20, 3)).astype(np.uint8)
    return np.roll(cv2.resize(coarse, (320, 180), interpolation=cv2.INTER_CUBIC), shift_px, axis=1)


def solution(left: Any = None, right: Any = None, **how: Any) -> phasestack.Result:
    """What `fast` makes of the pictures, of a pair that it can show if there are none."""
    pair = (picture(), picture(3)) if left is None else (left, right)
    return phasestack.solve(*pair, **{"eyes_m": EYES, "stack": STACK, "model": "fast"} | how)


def test_a_pair_becomes_layers_eye_views_and_quality(tmp_path: Path) -> None:
    result = solution(fov_deg=40)
    assert result.layers.shape == (3, 180, 320, 3) and result.layers.dtype == np.uint8
    assert result.seen.shape == (2, 180, 320, 3) and result.seen.dtype == np.uint8
    light_db = result.quality.light_db
    assert all(value is not None and value > 20 for value in light_db.values()) and set(light_db) == {"0", "1", "2"}
    result.save(tmp_path / "new" / "out")
    assert cv2.imread(str(tmp_path / "new" / "out" / "contact-sheet.png")) is not None
    told = json.loads((tmp_path / "new" / "out" / "solve.json").read_text())
    assert told["light_db"]["1"] == pytest.approx(light_db["1"], abs=1e-3) and told["model"] == result.model


def test_a_process_forked_during_a_solution_solves() -> None:
    """The child waited for the thread of its parent to finish."""
    stack = replace(STACK, width_px=64, height_px=36)
    small = (picture()[:36, :64], picture(3)[:36, :64])
    ended = threading.Event()

    def keep_solving() -> None:
        while not ended.is_set():
            solution(*small, stack=stack)

    thread = threading.Thread(target=keep_solving)
    solution(*small, stack=stack)
    thread.start()
    try:
        for _ in range(3):
            child = os.fork()
            if child == 0:
                signal.signal(signal.SIGALRM, signal.SIG_DFL)
                signal.alarm(60)
                try:
                    solution(*small, stack=stack)
                    os._exit(0)
                finally:
                    os._exit(1)
            assert os.waitpid(child, 0)[1] == 0
    finally:
        ended.set()
        thread.join()


def test_light_of_a_large_picture_is_of_some_pixels_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = solution().quality
    monkeypatch.setattr(solved, "WHOLE_PX", 1000)
    some = solution().quality
    for sigma, error_db in some.standard_error_db.items():
        assert 0 < error_db < 1 and abs(some.light_db[sigma] - whole.light_db[sigma]) < 4 * error_db
    assert not whole.standard_error_db and (some.psnr_db, some.ssim) == (whole.psnr_db, whole.ssim)


@pytest.mark.filterwarnings("ignore:pictures")  # random ones have more disparity than any gap shows
def test_it_is_what_the_command_makes(tmp_path: Path) -> None:
    pair = pair_in(tmp_path)
    app(solve_arguments(pair), standalone_mode=False)
    left, right = (cv2.imread(str(pair / f"{side}.png"))[..., ::-1] for side in ("left", "right"))
    panels = json.loads((pair / "panels.json").read_text()) | {"height_px": left.shape[0], "width_px": left.shape[1]}
    stack = phasestack.Stack(**panels | {"x_m": tuple(panels["x_m"])})
    result = phasestack.solve(left, right, eyes_m=((0.6, -0.03, 0.0), (0.6, 0.03, 0.0)), stack=stack)
    told = json.loads((pair / "out" / "solve.json").read_text())
    assert result.quality.light_db["1"] == pytest.approx(told["light_db"]["1"], abs=0.01)


def test_pictures_are_codes_or_intensities_with_or_without_transparency() -> None:
    codes = solution().layers
    floats = [picture(shift) / 255 for shift in (0, 3)]
    assert np.array_equal(solution(*floats).layers, codes)
    opaque = [np.dstack([picture(shift), np.full((180, 320), 255, np.uint8)]) for shift in (0, 3)]
    assert np.array_equal(solution(*opaque).layers, codes)


@pytest.mark.parametrize(
    ("change", "argument"),
    [
        ({"left": np.zeros((180, 320))}, "left"),
        ({"right": picture()[:90]}, "right"),
        ({"right": picture().astype(np.int32)}, r"right: .*np\.asarray\(right, np\.uint8\)"),
        ({"left": picture().astype(np.float64)}, "left"),
        ({"eyes_m": (0.7, 0.0, 0.0)}, "eyes_m"),
        ({"eyes_m": ((0.05, -0.03, 0.0), (0.05, 0.03, 0.0))}, "eyes_m"),
        ({"eyes_m": ((0.7, 0.0, 0.0), (0.7, 0.001, 0.0))}, "eyes_m"),
        ({"eyes_m": ((780, -30, 240), (780, 30, 240))}, "eyes_m: .*millimetres"),
        ({"eyes_m": None}, "eyes_m: is required without cameras"),
        ({"stack": (0.5, 0.3)}, "stack: must be a phasestack.Stack, not tuple"),
        ({"left": np.moveaxis(picture(), 2, 0)}, "left: .*channels must come last, so pass np.moveaxis"),
        ({"left": "left.png"}, "left: must be a picture, not a file name"),
        ({"right": picture().astype(np.float32)}, "right: .*if white is 255"),
        ({"fov_deg": "40"}, "fov_deg: must be a number of degrees, not '40'"),
        ({"model": 3}, "model: must be fast, balanced, best, sart or an ONNX file, not 3"),
        ({"cameras": np.zeros((2, 4, 4))}, "cameras: must be two 3x4 matrices"),
        ({"cameras": np.zeros((2, 3, 4))}, "cameras: must be matrices"),
        ({"cameras": [phasestack.camera(eye, width_px=320, height_px=180) for eye in EYES[::-1]]}, "cameras: are at"),
        ({"fov_deg": 190.0}, "fov_deg"),
        ({"eye_sigma_mm": float("nan")}, "eye_sigma_mm"),
        ({"model": "fats"}, "^model: name: 'fats' is not a model"),  # `model` once
        ({"left": [picture()] * 3, "right": None}, "eyes_m: must be 3 points"),
        (
            {"left": [picture(), picture()[:90]], "right": None},
            r"pictures\[1\]: must have the same shape as pictures\[0\]",
        ),
        ({"left": [], "right": None}, "pictures: must be a sequence of 1 to 8"),
        ({"right": None}, "right: is required"),
        ({"left": [picture()] * 3, "right": None, "eyes_m": (*EYES, EYES[0])}, "eyes_m: the eyes are 0 mm apart"),
        *(({"steps": steps}, "steps: must be a whole number from 0 to 1000") for steps in (-1, 1.5, True, "2", 1001)),
        ({"floats": 1}, "^floats: must be True or False"),
    ],
)
def test_what_does_not_fit_is_a_value_error_that_names_the_argument(change: dict[str, Any], argument: str) -> None:
    given: dict[str, Any] = {"left": picture(), "right": picture(3), "eyes_m": EYES, "stack": STACK, **change}
    with pytest.raises(ValueError, match=argument):
        phasestack.solve(given.pop("left"), given.pop("right"), **given)


def test_the_eyes_of_a_picture_are_found_and_of_none_are_not() -> None:
    from skimage.data import astronaut

    found = phasestack.find_eyes(astronaut())
    assert found is not None and found.eyes_px[0, 0] > found.eyes_px[1, 0]
    floats = phasestack.find_eyes(astronaut() / 255)
    assert floats is not None and np.allclose(floats.eyes_px, found.eyes_px)
    assert phasestack.find_eyes(picture()) is None
    with pytest.raises(ValueError, match="picture"):
        phasestack.find_eyes(np.zeros((40, 40)))


SMALL_PAIR = """
import numpy as np, phasestack
stack = phasestack.Stack(0.5, 0.3, (-0.06, 0.0, 0.06), 64, 36)
grey = np.full((36, 64, 3), 99, np.uint8)
result = phasestack.solve(grey, grey, eyes_m=((0.7, -0.03, 0), (0.7, 0.03, 0)), stack=stack)
"""


def test_solving_judging_and_saving_need_no_extra(tmp_path: Path) -> None:
    """Simulates an installation with the base dependencies alone."""
    code = f"import sys\nsys.modules.update(dict.fromkeys({sorted(of_extras())}))\n" + SMALL_PAIR
    code += f"result.save({str(tmp_path / 'out')!r})\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "viewer.html").is_file()


def test_a_folder_with_modules_of_our_names_does_not_matter(tmp_path: Path) -> None:
    (tmp_path / "runtime.py").write_text("its = 'own'")
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / "__init__.py").touch()

    def done(code: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=240)

    assert done(SMALL_PAIR).returncode == 0
    taken = done("import runtime\nimport phasestack")
    assert f"rename yours at {tmp_path / 'runtime.py'}" in taken.stderr


GREY_LAYERS = np.full((3, 180, 320, 3), 99, np.uint8)
UNFILTERED = replace(STACK, colour=(True, True, False))


def judged(layers: np.ndarray = GREY_LAYERS, **how: Any) -> phasestack.Quality:
    return phasestack.evaluate(layers, picture(), picture(3), **{"eyes_m": EYES, "stack": STACK} | how)


def camera_of(**size: Any) -> np.ndarray:
    return phasestack.camera(EYES[0], **{"width_px": 320, "height_px": 180} | size)


def solve_pairs(pairs: Any, **how: Any) -> list[Any]:
    return list(phasestack.solve_each(pairs, stack=STACK, **how))


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: replace(STACK, x_m=(0.1, 0.0)), "x_m"),
        (lambda: replace(STACK, x_m=0.1), "x_m: must list"),
        (lambda: replace(STACK, x_m=(0.0,)), "x_m.*at least 2 items"),
        (lambda: replace(STACK, x_m=(-60, 0, 60)), r"(?s)\A(?!.*at least 2 items).*for -60 millimetres, write -0\.06"),
        (lambda: replace(STACK, width_m=518.4), "width_m: .*millimetres"),
        (lambda: replace(STACK, width_px=0), "width_px"),
        (lambda: replace(STACK, height_px=10.5), "height_px"),
        (lambda: camera_of(width_px=1.5), "width_px"),
        (lambda: camera_of(height_px=0), "height_px"),
        (lambda: camera_of(height_px=float("nan")), "height_px"),
        (lambda: judged(every=0), "every"),
        (lambda: judged(every=2.0), "every"),
        (lambda: judged(every=100), "every"),
        (lambda: judged(sigmas_mm=1), "sigmas_mm"),
        (lambda: judged(each=2), "^each: unknown argument"),
        (lambda: judged(each=2, panels=phasestack.RealPanels()), "^each: unknown argument"),
        (lambda: judged(panels=3), r"^panels: must be phasestack\.RealPanels"),
        (lambda: judged(sigmas_mm=(-1,)), "sigmas_mm"),
        (
            lambda: judged(np.moveaxis(GREY_LAYERS, 3, 1)),
            r"layers: .*channels must come last, so pass np.moveaxis\(layers, 1, -1\)",
        ),
        (lambda: judged(GREY_LAYERS[:2]), r"layers: must have shape .*, but has shape \(2, "),
        (lambda: judged(GREY_LAYERS[..., 0]), r"layers: must have shape .*for grey layers, pass np.stack"),
        (lambda: judged(GREY_LAYERS * 0.015), r"layers: values must be at most 1.*if they are angles in radians"),
        (
            lambda: judged(GREY_LAYERS + np.eye(3, dtype=np.uint8)[0], stack=UNFILTERED),
            r"^layers\[2\]: this panel has no colour filters",
        ),
        (lambda: solve_pairs(None), "^pairs: must be an iterable"),
        (lambda: solve_pairs("ab"), r"^pairs\[0\]: must be"),
        (lambda: solve_pairs([(picture(), picture(3), EYES), (picture(), picture(3), ())]), r"pairs\[1\]: eyes_m"),
        (lambda: solve_pairs([(picture(), picture(3), EYES)], executor=2), "^executor: must be"),
    ],
)
def test_a_wrong_argument_of_any_call_is_named(call: Callable[[], Any], told: str) -> None:
    with pytest.raises((TypeError, ValueError), match=told):
        call()


def test_a_result_is_saved_in_a_folder_only(tmp_path: Path) -> None:
    result = solution(picture()[:36, :64], picture()[:36, :64], stack=replace(STACK, width_px=64, height_px=36))
    (tmp_path / "a").write_text("x")
    for out, told in (
        (None, "out: must be a folder, not NoneType"),
        (io.BytesIO(), "out: must be a folder, not BytesIO"),
        (b"out", "out: must be a folder, not bytes"),
        ("a\0b", "out: .*NUL"),
        (tmp_path / "a", "^out: .*a"),
    ):
        with pytest.raises(ValueError, match=told):
            result.save(out)  # type: ignore[arg-type]
    assert (tmp_path / "a").read_text() == "x"


def test_a_result_prints_in_a_line_and_measures_quality_when_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    real = solved.displayed
    monkeypatch.setattr(solved, "displayed", lambda *given, **how: calls.append(1) or real(*given, **how))
    result = solution()
    assert repr(result) == "<phasestack.Result: 3 layers of 320x180 by fast>" and calls == []
    assert result.quality is result.quality and calls == [1]
    assert phasestack.__version__[0].isdigit()


def test_pictures_of_parallel_cameras_are_solved_for_what_they_are() -> None:
    """Once taken for pictures that look at the middle: 9 dB, reported as 24."""
    eyes_m = ((0.7, -0.05, 0.02), (0.7, 0.05, 0.02))
    cameras = [parallel(eye) for eye in eyes_m]
    pictures = [taken(matrix, 400, 300) for matrix in cameras]
    wanted = [taken(phasestack.camera(eye, width_px=320, height_px=180), 320, 180) for eye in eyes_m]

    def truth_db(**how: Any) -> float:
        layers = phasestack.solve(*pictures, stack=STACK, model="fast", **how).layers
        return phasestack.evaluate(layers, *wanted, eyes_m=eyes_m, stack=STACK).psnr_db

    solved = phasestack.solve(*pictures, cameras=cameras, stack=STACK, model="fast")
    assert solved.quality.psnr_db > 30 and truth_db(cameras=cameras) > 30
    assert abs(solved.quality.psnr_db - truth_db(cameras=cameras)) < 2.8  # of 53
    with pytest.warns(UserWarning, match="outside the panels"):
        assert truth_db(eyes_m=eyes_m, fov_deg=62) < 20


def test_cameras_that_look_at_the_middle_are_what_is_meant_without_them() -> None:
    cameras = [phasestack.camera(eye, width_px=320, height_px=180) for eye in EYES]
    without = solution()
    scaled = [-3 * matrix for matrix in cameras]
    for given in (cameras, scaled):
        assert np.array_equal(solution(cameras=given, eyes_m=None).layers, without.layers)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.1, 0.05], [2.0, 0.0, 0.0]])
    pixels = phasestack.project(points, eye_m=EYES[0], width_px=320, height_px=180)
    assert np.allclose(pixels[0], (160, 90)) and pixels[1, 0] > 160 > 0 and np.isnan(pixels[2]).all()


def test_anybody_s_layers_are_evaluated_as_ours_are() -> None:
    result = solution()
    assert judged(result.layers) == judged(result.layers / 255) == result.quality


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"fov_deg": 70}, "outside the panels"),
        ({"eyes_m": EYES[::-1]}, "swap the eyes"),
        ({"fov_deg": 0.7}, "looks like radians"),
    ],
)
def test_what_can_hardly_be_meant_is_warned_of_where_it_is_written(change: dict[str, Any], told: str) -> None:
    given: dict[str, Any] = {"eyes_m": EYES, "stack": STACK}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        phasestack.evaluate(GREY_LAYERS, picture(), picture(3), **given)
    with pytest.warns(UserWarning, match=told) as caught:
        phasestack.evaluate(GREY_LAYERS, picture(), picture(3), **given | change)
    assert caught[0].filename == __file__


def test_the_command_takes_the_cameras_that_pictures_were_taken_with(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    eyes_m = ((0.7, -0.05, 0.02), (0.7, 0.05, 0.02))
    cameras = {side: parallel(eye) for side, eye in zip(("left", "right"), eyes_m, strict=True)}
    for side, matrix in cameras.items():
        cv2.imwrite(str(tmp_path / f"{side}.png"), taken(matrix, 400, 300)[..., ::-1])
    (tmp_path / "cameras.json").write_text(json.dumps({side: matrix.tolist() for side, matrix in cameras.items()}))
    geometry = {"width_m": STACK.width_m, "height_m": STACK.height_m, "x_m": list(STACK.x_m)}
    (tmp_path / "panels.json").write_text(json.dumps(geometry | {"width_px": 320, "height_px": 180}))
    command = ["solve", "--model", "fast", "--panels", f"{tmp_path}/panels.json", "--out", f"{tmp_path}/out"]
    command += ["--left", f"{tmp_path}/left.png", "--right", f"{tmp_path}/right.png"]
    app([*command, "--camera", f"{tmp_path}/cameras.json"], standalone_mode=False)
    told = json.loads((tmp_path / "out" / "solve.json").read_text())
    pictures = [taken(matrix, 400, 300) for matrix in cameras.values()]
    result = phasestack.solve(*pictures, cameras=list(cameras.values()), stack=STACK, model="fast")
    assert told["psnr_db"] == pytest.approx(result.quality.psnr_db, abs=0.01) and told["psnr_db"] > 30
    assert capfd.readouterr().err == ""
    eyes = ["--left-eye", *map(str, eyes_m[0]), "--right-eye", *map(str, eyes_m[1])]
    app([*command, *eyes, "--fov", "62"], standalone_mode=False)
    assert "outside the panels" in capfd.readouterr().err
    for given, told in (
        (eyes[:4], "are required"),
        ([*eyes, "--camera", f"{tmp_path}/cameras.json"], "omit --left-eye"),
    ):
        with pytest.raises(InputError, match=told):
            app([*command, *given], standalone_mode=False)


def test_the_example_pair_shows_its_scene_and_is_a_case(tmp_path: Path) -> None:
    pair = phasestack.example_pair()
    with PairPainter("room", pair.stack) as painter:
        drawn = painter.pair("room", pair.eyes_m, fov_deg=pair.fov_deg, off_mm=())
    for given, image in zip((pair.left, pair.right), drawn.images, strict=True):
        assert np.abs(given.astype(int) - image).mean() < 0.05
    pair.save(tmp_path / "pair")
    (case,) = read_pairs(tmp_path / "pair")
    assert case.stack == PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 640, 360) and case.fov_deg == pair.fov_deg
    assert np.array_equal(case.images[1], pair.right) and np.array_equal(case.eyes_m, pair.eyes_m)


PAIR = phasestack.example_pair()
SHOWN: dict[str, Any] = {"eyes_m": PAIR.eyes_m, "stack": PAIR.stack, "fov_deg": PAIR.fov_deg}


def test_quality_at_a_chosen_price_says_how_exact_it_is() -> None:
    result = solution(PAIR.left, PAIR.right, **SHOWN)
    whole = phasestack.evaluate(result.layers, PAIR.left, PAIR.right, sigmas_mm=(1,), **SHOWN)
    exact_db: float = whole.light_db["1"]
    assert set(whole.light_db) == set(whole.expected_db) == {"1"} and whole.standard_error_db == {}
    assert exact_db == pytest.approx(result.quality.light_db["1"], abs=0.01)
    for every, most_db in ((2, 0.3), (5, 1.0)):
        part = result.measure(sigmas_mm=(1,), every=every)
        error_db = part.standard_error_db["1"]
        assert 0 < error_db < most_db and abs(part.light_db["1"] - exact_db) < 4 * error_db


def test_many_pairs_are_solved_in_turn() -> None:
    places = [np.add(EYES, (0.0, 0.02 * k, 0.0)) for k in range(3)]
    pairs = ((picture(), picture(3), eyes) for eyes in places)  # drawn as they are needed
    results = list(phasestack.solve_each(pairs, stack=STACK, model="fast"))
    assert len(results) == 3 and np.array_equal(results[2].layers, solution(eyes_m=places[2]).layers)


class Fatal:
    """A picture that ends the process that receives it."""

    def __reduce__(self) -> tuple[Any, tuple[int]]:
        return os._exit, (9,)


def test_an_executor_gives_the_same_and_a_failing_pair_ends_no_other(
    capfd: pytest.CaptureFixture[str],
) -> None:
    """One of the processes dies, which breaks the pool."""
    places = [np.add(EYES, (0.0, 0.02 * k, 0.0)) for k in range(3)]
    pairs: list[Any] = [(picture(), picture(3), eyes) for eyes in places]
    plain = [result.layers for result in phasestack.solve_each(pairs, stack=STACK, model="fast")]
    pairs[1:1] = [(picture(), picture(3), ()), (Fatal(), picture(3), EYES)]
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as pool:
        results = list(phasestack.solve_each(pairs, stack=STACK, model="fast", executor=pool))
    solved = [result.layers for result in results if isinstance(result, phasestack.Result)]
    assert np.array_equal(solved, plain)
    lines = [str(results[1]), str(results[2])]
    assert lines[0].startswith("pairs[1]: eyes_m: must be") and lines[1] == "pairs[2]: its process died"
    assert [line for line in capfd.readouterr().err.splitlines() if line.startswith("pairs[")] == lines


FOUR_EYES = ((0.6, -0.24, 0.0), (0.6, -0.18, 0.0), (0.6, 0.18, 0.0), (0.6, 0.24, 0.0))
FOUR_PANELS = phasestack.Stack(
    width_m=0.5184, height_m=0.2916, x_m=(-0.09, -0.03, 0.03, 0.09), width_px=320, height_px=180
)


def card_pictures() -> list[np.ndarray]:
    return [card_scene(np.array(eye), width_px=320, height_px=180) for eye in FOUR_EYES]


def test_four_eyes_see_four_pictures(tmp_path: Path) -> None:
    pictures = card_pictures()
    result = phasestack.solve(pictures, eyes_m=FOUR_EYES, stack=FOUR_PANELS)
    assert result.layers.shape == (4, 180, 320, 3) and result.seen.shape == (4, 180, 320, 3)
    measured = result.measure(sigmas_mm=(0,), every=2)
    assert min(measured.eye_psnr_db) > 18
    swapped = phasestack.evaluate(
        result.layers, pictures[2:] + pictures[:2], eyes_m=FOUR_EYES, stack=FOUR_PANELS, sigmas_mm=(0,), every=2
    )
    assert measured.light_db["0"] > swapped.light_db["0"] + 5
    result.save(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"seen-left.png", "seen-right.png", "seen-left-2.png", "seen-right-2.png", "wanted-right-2.png"} <= names


def test_a_case_file_with_four_eyes_is_what_python_solves(tmp_path: Path) -> None:
    for n, picture_ in enumerate(card_pictures()):
        write_png(tmp_path / f"{n}.png", picture_)
    panels = {"width_m": 0.5184, "height_m": 0.2916, "x_m": FOUR_PANELS.x_m}
    case = {"panels": panels, "eyes": FOUR_EYES, "images": [f"{n}.png" for n in range(4)], "fov": 40.0}
    (tmp_path / "case.json").write_text(json.dumps(case))
    app(["solve", "--case", str(tmp_path / "case.json"), "--out", str(tmp_path / "out")], standalone_mode=False)
    layers = phasestack.solve(card_pictures(), eyes_m=FOUR_EYES, stack=FOUR_PANELS).layers
    written = [cv2.imread(str(tmp_path / "out" / f"layer-{n}.png"))[..., ::-1] for n in range(4)]
    assert np.array_equal(np.stack(written), layers)
    told = json.loads((tmp_path / "out" / "solve.json").read_text())
    assert len(told["eye_psnr_db"]) == 4


def test_a_panel_without_filters_has_one_value_for_all_colours() -> None:
    pictures = [card_scene(np.array(eye), width_px=320, height_px=180) for eye in EYES]
    layers = phasestack.solve(*pictures, eyes_m=EYES, stack=UNFILTERED).layers
    judged(layers, stack=UNFILTERED, sigmas_mm=(0,), every=8)
    assert (np.ptp(layers[2], axis=-1) == 0).all() and np.ptp(layers[0], axis=-1).max() > 50


def rectified(shift_px: int, levels: Sequence[int] = (30, 90, 160, 230)) -> tuple[np.ndarray, ...]:
    """Blocks in front of the middle panel, seen by parallel cameras."""
    blocks = np.random.default_rng(4).choice(levels, (9, 24, 3)).astype(np.uint8)
    wide = cv2.resize(blocks, (480, 180), interpolation=cv2.INTER_NEAREST)
    return tuple(
        np.ascontiguousarray(wide[:, start : start + 320]) for start in (80 - shift_px // 2, 80 + shift_px // 2)
    )


def test_a_pair_with_too_much_disparity_is_explained_wherever_its_figure_is(tmp_path: Path) -> None:
    eyes = ((0.6, -0.0315, 0.0), (0.6, 0.0315, 0.0))
    good, bad = (phasestack.solve(*rectified(px), eyes_m=eyes, stack=STACK, model="fast") for px in (6, 60))
    assert good.notes == ()
    with pytest.warns(UserWarning, match=r"rectified pair .* shift the left picture 3\d pixels left"):
        assert bad.measure(sigmas_mm=(1,)).light_db["1"] < good.measure(sigmas_mm=(1,)).light_db["1"] - 6
    with pytest.warns(UserWarning, match="disparity is too large for the panels"):
        assert bad.quality.light_db["1"] < good.quality.light_db["1"] - 6
    bad.save(tmp_path)
    assert "rectified" in json.loads((tmp_path / "solve.json").read_text())["notes"][0]
    assert "rectified" in (tmp_path / "viewer.html").read_text()
    moved = [np.roll(picture, shift_px, axis=1) for picture, shift_px in zip(rectified(60), (-30, 30), strict=True)]
    assert phasestack.solve(*moved, eyes_m=eyes, stack=STACK, model="fast").notes == ()


def example_at(gap_m: float, toed_px: int = 0) -> tuple[Any, ...]:
    """The example pair, moved apart as a rectified one is, with its eyes and a stack of these gaps."""
    pair = phasestack.example_pair()
    moved = np.roll(pair.left, toed_px, axis=1), np.roll(pair.right, -toed_px, axis=1)
    return moved, pair.eyes_m, phasestack.Stack(0.5184, 0.2916, (-gap_m, 0.0, gap_m), 640, 360)


@pytest.mark.filterwarnings("ignore:pictures")
def test_contrast_and_gaps_decide_how_much_disparity_is_too_much() -> None:
    """The example pair has 37.1 dB of light with 3 and 6 cm (`balanced`), 33.3 with 1 cm, and 24 to 27 if rectified."""
    for gap_m, toed_px, ghosts in (
        (0.06, 0, False),
        (0.03, 0, False),
        (0.01, 0, True),
        (0.03, 40, True),
        (0.06, 40, True),
    ):
        pictures, eyes, stack = example_at(gap_m, toed_px)
        assert bool(disparity_doubts(pictures, eyes, stack, fov_deg=40, parallel=True)) == ghosts, (gap_m, toed_px)
    eyes = np.array([(0.6, -0.0315, 0.0), (0.6, 0.0315, 0.0)])
    gaps = phasestack.Stack(0.5184, 0.2916, (-0.03, 0.0, 0.03), 320, 180)
    for levels, ghosts, least_db, most_db in (((90, 115, 145, 170), False, 32, 40), ((30, 90, 160, 230), True, 10, 25)):
        pictures = rectified(24, levels)
        assert bool(disparity_doubts(pictures, eyes, gaps, fov_deg=40, parallel=True)) == ghosts
        light_db = phasestack.solve(*pictures, eyes_m=eyes, stack=gaps).measure(sigmas_mm=(1,), every=2).light_db["1"]
        assert least_db < light_db < most_db, levels


def test_the_size_of_ghosts_is_foretold() -> None:
    for gap_m, toed_px in ((0.03, 40), (0.06, 40), (0.005, 0)):
        pictures, eyes, stack = example_at(gap_m, toed_px)
        unit_m = 0.063 * 0.6 * gap_m / (0.6**2 - gap_m**2)  # of disparity, on the middle panel
        foretold_db = -20 * np.log10(_compared(pictures, eyes, stack, fov_deg=40).ghosts(unit_m))
        solved = phasestack.solve(*pictures, eyes_m=eyes, stack=stack)
        with pytest.warns(UserWarning, match="disparity is too large for the panels"):
            assert solved.measure(sigmas_mm=(1,), every=4).light_db["1"] == pytest.approx(foretold_db, abs=2.5)


def test_open_files_are_refused_by_name_and_left_open(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"x")
    with (tmp_path / "a.png").open("rb") as file:
        for given in (file, io.BytesIO(b"x")):
            with pytest.raises(ValueError, match="left: must be a picture, not an open file"):
                phasestack.solve(given, picture(), eyes_m=EYES, stack=STACK)  # type: ignore[arg-type]
            assert given.read() == b"x"


def test_tensors_that_need_gradients_are_taken_as_numbers() -> None:
    torch = pytest.importorskip("torch")
    eyes = torch.tensor(EYES, requires_grad=True)
    sizes = {"width_px": 320, "height_px": 180}
    expected = [phasestack.camera(eye, **sizes) for eye in EYES]
    assert np.allclose([phasestack.camera(eye, **sizes) for eye in eyes], expected, atol=1e-3)
    middle = phasestack.project(torch.zeros(3, requires_grad=True), eye_m=eyes[0], **sizes)
    assert middle == pytest.approx([160, 90])
    assert solution(eyes_m=list(eyes)).layers.shape[0] == 3
    for given in ("abc", np.full(3, 1j)):
        for name, call in (("eye_m", phasestack.camera), ("points_m", phasestack.project)):
            with pytest.raises(ValueError, match=f"^{name}: must be"):
                call(given, **sizes, **({} if name == "eye_m" else {"eye_m": EYES[0]}))  # type: ignore[operator]


def test_a_program_with_pytorch_ends_without_a_word() -> None:
    """PyTorch keeps modules to the end, and nanobind reported them as leaked."""
    pytest.importorskip("torch")
    code = "import torch, phasestack as p; e = p.example_pair(); "
    code += "r = p.solve(e.left, e.right, eyes_m=e.eyes_m, stack=e.stack, fov_deg=e.fov_deg, model='fast')"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_without_stderr_pairs_are_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs without a console have no stderr."""
    monkeypatch.setattr(sys, "stderr", None)
    (result,) = solve_pairs([(picture(), picture(3), EYES)], model="fast")
    assert isinstance(result, phasestack.Result)


@pytest.mark.parametrize(
    ("pictures", "how", "sigma_mm", "many", "gain_db"),
    [
        ((PAIR.left, PAIR.right), {"model": "fast"}, 1, 6, 0.5),
        ((PAIR.left, PAIR.right), {"model": "sart"}, 1, 6, 0.5),
        (([PAIR.left], None), {"model": "balanced", "eyes_m": PAIR.eyes_m[:1]}, 0, 8, 1.0),
    ],
)
def test_more_steps_serve_the_eyes_better(
    pictures: tuple[Any, Any], how: dict[str, Any], sigma_mm: float, many: int, gain_db: float
) -> None:
    def light_db(**steps: int) -> float:
        measured = solution(*pictures, **SHOWN | how | steps).measure(sigmas_mm=(sigma_mm,), every=8)
        return measured.light_db[str(sigma_mm)]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one step leaves ghosts
        assert light_db(steps=1) + gain_db < light_db(steps=many)
    assert light_db() > 25


@pytest.mark.parametrize("model", ["fast", "sart"])
def test_float_layers_are_the_layers_before_rounding(model: str, tmp_path: Path) -> None:
    assert solution(PAIR.left, PAIR.right, **SHOWN, model=model).floats is None
    result = solution(PAIR.left, PAIR.right, **SHOWN, model=model, floats=True)
    assert result.floats is not None and result.floats.dtype == np.float32
    exact = result.floats.astype(float) * 255
    assert exact.min() >= 0 and exact.max() <= 255
    assert np.abs(exact - result.layers).max() < 0.501 and np.abs(exact - result.layers).mean() > 0.1
    result.save(tmp_path)
    assert (np.load(tmp_path / "layers.npy") == result.floats).all()


def test_obvious_ghosts_are_noted() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (2, 180, 320, 3)).astype(np.uint8)
    result = solution(*noise, eyes_m=((0.6, -0.03, 0), (0.6, 0.03, 0)))
    assert result.quality.light_db["1"] < 21 and any("obvious ghosts: light is" in note for note in result.notes)


def test_a_tensor_with_channels_first_gets_the_torch_way_out() -> None:
    torch = pytest.importorskip("torch")
    eyes, stack = ((0.6, -0.03, 0), (0.6, 0.03, 0)), phasestack.example_pair().stack
    for shape, way in (
        ((3, 90, 160), r"left\.permute\(1, 2, 0\)"),
        ((1, 3, 90, 160), r"left\[0\]\.permute\(1, 2, 0\)"),
    ):
        with pytest.raises(ValueError, match=way):
            phasestack.solve(torch.zeros(shape), torch.zeros(shape), eyes_m=eyes, stack=stack)
