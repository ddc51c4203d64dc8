"""Compares `viewer.html` in Chromium with an independent tracer, and the script's optics with the runtime's."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import phasestack
from runtime.browser.still import asset, half_floats, stack_table, viewer_html
from runtime.config import StackGeometry
from runtime.optics.alignment import align
from runtime.optics.light import panels_from_centre
from runtime.optics.presentation import Interpolation, PixelMap, panel_draws, scale_and_shift, shown_layers
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack, Tilt
from runtime.optics.views import image_from_stack
from runtime.records import PanelFrame, SensorFrame
from runtime.report.pairs import PairPainter, eyes_at
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.artifacts import to_json
from tests.browser.tracer import Panels, light
from tests.panels.presentation_table import HEAD, ROWS, UNMOUNTED, Row, agrees, hills, picture
from tests.test_cli import phasestack as phasestack_command

HERE = Path(__file__).parent
STACK = StackGeometry().stack()
TILT = ((0.01, -0.02), (0.0, 0.0), (-0.015, 0.012))
MOVE = [0.01, 0.03, -0.01]


def needs_chromium() -> None:
    modules = Path(os.environ.get("NODE_PATH", ""))
    if shutil.which("node") is None or shutil.which("chromium") is None or not (modules / "playwright-core").is_dir():
        pytest.skip("chromium, node, and a NODE_PATH with playwright-core are needed")


def driven(script: str, *arguments: object) -> dict[str, Any]:
    """Values printed by a script that drives Chromium, by name."""
    needs_chromium()
    command = ["node", str(HERE / script), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return {told["what"]: told["value"] for told in map(json.loads, done.stdout.splitlines())}


def encoded(data: bytes | np.ndarray) -> str:
    return base64.b64encode(data).decode()


def in_node(code: str, given: Any) -> Any:
    """The value of a JavaScript expression over the module `d` and `given`."""
    if shutil.which("node") is None:
        pytest.skip("node is needed")
    text = f"{asset('display.js')}\nconst given = {json.dumps(given)};\nconsole.log(JSON.stringify({code}));"
    done = subprocess.run(
        ["node", "--input-type=module", "-"], input=text, capture_output=True, text=True, timeout=60, check=True
    )
    return json.loads(done.stdout)


STACKS = (
    STACK,
    replace(STACK, x_m=(-0.02, 0.05)),
    replace(STACK, x_m=(-0.1, -0.02, 0.03, 0.07), tilt=Tilt(((0.0, 0.02, 0.01),) * 4, (0.6, 0.1, 0.05))),
)


@pytest.mark.parametrize("people", [1, 2])
@pytest.mark.parametrize("stack", STACKS, ids=lambda stack: f"{stack.count} panels")
def test_the_page_aligns_as_the_runtime_does_to_its_limits(stack: PanelStack, people: int) -> None:
    random = np.random.default_rng(3)
    places = random.uniform((0.3, -40), (1.2, 40), (40, people, 2))
    old = [np.concatenate([eyes_at(distance_m=d, angle_deg=a, height_m=0.1) for d, a in each]) for each in places]
    moves = random.normal(size=(40, 1, 3)) * np.geomspace(1e-2, 100, 40)[:, None, None]
    moves = np.repeat(moves * random.uniform(0.5, 1.5, (40, people, 1)), 2, axis=1)
    now = [eyes + move for eyes, move in zip(old, moves, strict=True)]
    cases = [[a.tolist(), b.tolist()] for a, b in zip(old, now, strict=True)]
    table = json.loads(json.dumps(stack_table(stack)))
    found = in_node("given[1].map(([a, b]) => alignment(given[0], a, b))", [table, cases])
    limited = 0
    for one, solved, eyes in zip(found, old, now, strict=True):
        wanted = align(stack, solved_for_m=solved, eyes_m=eyes)
        np.testing.assert_allclose(one["maps"], [scale_and_shift(m) for m in wanted.solved_from_shown], atol=1e-8)
        assert bool(one["limited"]) == bool(wanted.limited)
        assert (one["parallax"] is None) == (wanted.parallax is None) == (stack.count % 2 == 0)
        if wanted.parallax is not None:
            motion, middles = wanted.parallax, map(scale_and_shift, wanted.parallax.middle_from_shown)
            np.testing.assert_allclose(one["parallax"]["drift"], [*motion.drift_px, motion.growth], atol=1e-8)
            np.testing.assert_allclose(one["parallax"]["middles"], list(middles), atol=1e-8)
            np.testing.assert_allclose(one["parallax"]["weights"], motion.weights, atol=1e-8)
        limited += bool(wanted.limited)
    assert 0 < limited < 40


def test_eyes_that_stay_where_they_were_displace_nothing() -> None:
    eyes = eyes_at(distance_m=0.6).tolist()
    assert in_node("alignment(...given).parallax", [stack_table(STACK), eyes, eyes]) is None


def records(row: Row) -> dict[str, Any]:
    """What the page's `panelDraws` returns for a row of the golden table, from the runtime's records."""
    draws = panel_draws(row.frame())
    first = draws[0]
    table = {name: getattr(first, name) for name in ("size_px", "solved_px", "flatness", "rest", "extended_px")}
    relief_px = (1, 1) if first.relief is None else first.relief.shape[::-1]
    shares = PixelMap(1 / relief_px[0], 1 / relief_px[1], 0.0, 0.0)
    moves = [
        (draw.relief_from_shown.then(shares), draw.push if draw.relief is not None else (0.0,) * 4) for draw in draws
    ]
    table["solved_from_shown"] = [draw.solved_from_shown for draw in draws]
    return table | dict(zip(("relief_from_shown", "push"), map(list, zip(*moves, strict=True)), strict=True))


def test_the_page_derives_the_records_that_the_runtime_derives() -> None:
    cases, wanted = [], []
    for name in UNMOUNTED:
        row = ROWS[name]
        solved, records_of_row = row.frame().solved, records(row)
        assert solved is not None
        cases.append(
            [stack_table(row.stack), HEAD.tolist(), (HEAD + row.move_m).tolist(), solved.shape[2:0:-1], row.flatness]
        )
        wanted.append(records_of_row)
    code = "given.map(([stack, old, now, px, flatness]) => panelDraws(stack, alignment(stack, old, now), px, flatness))"
    for name, one, other in zip(UNMOUNTED, in_node(code, cases), wanted, strict=True):
        moves = ROWS[name].relief and ROWS[name].frame().parallax is not None
        for key in other if moves else set(other) - {"relief_from_shown", "push"}:
            np.testing.assert_allclose(one[key], other[key], atol=1e-8, err_msg=f"{name}: {key}")


def page_pictures(folder: Path) -> dict[str, np.ndarray]:
    """What the page shows for rows of the golden table: (n, h, w, 3) each."""
    cases: list[dict[str, Any]] = []
    for name in UNMOUNTED:
        row = ROWS[name]
        frame = row.frame()
        assert frame.solved is not None and frame.flat is not None
        case = {"stack": stack_table(row.stack), "flat": encoded(frame.flat), "layers": encoded(frame.solved)}
        case |= {"size": frame.solved.shape[2:0:-1], "draws": records(row)}
        if frame.relief is not None and frame.parallax is not None:
            case |= {"relief": encoded(half_floats(frame.relief)), "relief_px": frame.relief.shape[::-1]}
        cases.append(case)
    script = f"{asset('display.js')}\nconst given = {to_json(cases)};\n{(HERE / 'panels.js').read_text()}"
    (folder / "panels.html").write_text(f'<script type="module">{script}</script>')
    told = driven("value.mjs", folder / "panels.html")
    assert told["errors"] == [] and len(told["value"]) == len(UNMOUNTED)
    found = {}
    for name, text in zip(UNMOUNTED, told["value"], strict=True):
        stack = ROWS[name].stack
        codes = np.frombuffer(base64.b64decode(text), np.uint8)
        found[name] = codes.reshape(stack.count, stack.height_px, stack.width_px, 4)[..., :3]
    return found


@pytest.mark.slow
def test_panels_in_the_page_show_what_the_reference_shows(tmp_path: Path) -> None:
    for name, shown in page_pictures(tmp_path).items():
        assert agrees(shown, ROWS[name].reference(Interpolation.CUBIC)), name


@pytest.mark.parametrize("stack", STACKS, ids=lambda stack: f"{stack.count} panels")
def test_the_page_looks_through_the_pixels_that_the_runtime_looks_through(stack: PanelStack) -> None:
    nominal, true = np.array([0.6, -0.1, 0.12]), np.array([0.55, -0.07, 0.1])
    picture = {"width": 640, "height": 360, "fov_deg": 40}
    code = "given[0].x_m.map((_, n) => panelFromPicture(given[0], n, given[1], given[3], given[2]))"
    found = in_node(code, [stack_table(stack), true.tolist(), nominal.tolist(), picture])
    image = image_from_stack(nominal, width_px=640, height_px=360, fov_deg=40)
    wanted = panels_from_centre(true, stack) @ panel_from_image(image, stack.panel(stack.count // 2))
    points = np.array([[u, v, 1.0] for u in (0.5, 320, 639) for v in (0.5, 180, 359)]).T
    for one, other in zip(found, wanted, strict=True):
        ours, theirs = (m @ points for m in (np.reshape(one, (3, 3)), other))
        np.testing.assert_allclose(ours[:2] / ours[2], theirs[:2] / theirs[2], atol=1e-6)


def test_a_picture_is_as_wide_as_what_all_panels_show() -> None:
    eyes = [[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]]
    found = in_node("reach(given[0], given[1])", [stack_table(STACK), eyes])
    rear_m = 0.6 - STACK.x_m[0]  # the rear panel is the smallest
    back = np.array([0.6, 0.03, 0.0]) / np.hypot(0.6, 0.03)
    edges = np.array([[STACK.x_m[0], side * STACK.width_m / 2, 0.0] for side in (-1, 1)]) - [0.6, 0.03, 0.0]
    across = np.abs(edges @ [-back[1], back[0], 0.0] / (edges @ back))
    assert found[0] == pytest.approx(across.max(), rel=1e-6)
    assert found[1] == pytest.approx(STACK.height_m / 2 / rear_m, rel=0.05)


@pytest.mark.parametrize("aside_m", [0.0, 0.1, 0.25])
def test_a_display_is_drawn_larger_to_a_nearer_head(aside_m: float) -> None:
    distances = np.array([1.2, 0.8, 0.6, 0.5, 0.4, 0.3, 0.2])
    heads = [(x, aside_m * min(1.0, (x / 0.6) ** 2)) for x in distances]  # the way of `#nearer` in look.js
    usual_m = float(np.hypot(0.6, aside_m))
    cases = [[stack_table(STACK), [[x, y - 0.03, 0.1], [x, y + 0.03, 0.1]], usual_m, 1070, 868] for x, y in heads]
    fov = np.radians(in_node("given.map((one) => fieldOfView(...one))", cases))
    half_m = STACK.width_m / 2
    angles = [np.arctan2(half_m - y, x) + np.arctan2(half_m + y, x) for x, y in heads]
    assert (np.diff(np.tan(np.divide(angles, 2)) / np.tan(fov / 2)) > 0).all()


def pair(stack: phasestack.Stack) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
    eyes = eyes_at(distance_m=0.7, angle_deg=6, height_m=0.1)
    with PairPainter("demo", stack) as painter:
        size = {"width_px": stack.width_px, "height_px": stack.height_px}
        return eyes, tuple(painter.image(eye, **size) for eye in eyes)


def agreement_db(folder: Path, name: str, layers: np.ndarray, panels: Panels, eyes: np.ndarray, step: int) -> float:
    """PSNR of the page's picture against the tracer's light, on a sample of both eyes' pixels."""
    errors = []
    for side, eye in enumerate(eyes):
        seen = cv2.imread(str(folder / f"{name}-{side}.png"))[..., ::-1] / 255
        rows, columns = (np.arange(step // 2, size, step) for size in seen.shape[:2])
        truth, inside = light(layers, panels, eye, rows=rows, columns=columns)
        assert inside.mean() > 0.5
        errors.append(((seen[np.ix_(rows, columns)] - truth) ** 2)[inside])
    return float(-10 * np.log10(np.concatenate(errors).mean()))


def judged(tmp_path: Path, panels: Panels, eyes: np.ndarray, layers: np.ndarray, step: int) -> list[float]:
    moved = eyes + MOVE
    return [
        agreement_db(tmp_path, "rest", layers, panels, eyes, step),
        agreement_db(tmp_path, "aligned", panels.aligned(layers, eyes, moved), panels, moved, step),
        agreement_db(tmp_path, "standing", layers, panels, moved, step),
    ]


@pytest.mark.slow
def test_the_viewer_shows_the_light_that_a_tracer_finds(tmp_path: Path) -> None:
    eyes, pictures = pair(STACK)
    result = phasestack.solve(*pictures, eyes_m=eyes, stack=STACK, model="fast")
    result.save(tmp_path)
    told = driven("look.mjs", tmp_path / "viewer.html", 1920, 1080, json.dumps(MOVE), tmp_path)
    panels = Panels(STACK.width_m, STACK.height_m, STACK.x_m)
    for n, layer in enumerate(result.layers):  # as Chromium decodes them
        assert np.array_equal(cv2.imread(str(tmp_path / f"decoded-{n}.png"))[..., ::-1], layer)
    found = judged(tmp_path, panels, eyes, result.layers, step=7)
    print("agreement with the tracer, dB: at rest, aligned, as they stand:", np.round(found, 2))
    assert min(found) > 45
    at_eyes = float(re.search(r"([\d.]+) dB", told["told"])[1])
    assert at_eyes == pytest.approx(result.quality.light_db["0"], abs=2.0)  # of other rays, and another pupil
    assert told["keys move the head"] and told["fits a phone"]
    assert len(told["modes"]) == 10 and min(told["modes"].values()) > 20_000
    assert told["elsewhere"] == [] and told["errors"] == []


@pytest.mark.slow
def test_the_viewer_of_a_run_moves_its_content_by_its_depth(tmp_path: Path) -> None:
    stack, relief, layers = replace(STACK, width_px=320, height_px=180), hills(90, 160), picture(3, 180, 320, seed=4)
    eyes = eyes_at(distance_m=0.7, angle_deg=6, height_m=0.1)
    page = viewer_html(layers, (), stack, eyes_m=eyes, fov_deg=40, text=["in relief"], relief=relief)
    (tmp_path / "viewer.html").write_text(page)
    driven("look.mjs", tmp_path / "viewer.html", 320, 180, json.dumps(MOVE), tmp_path)
    panels, now = Panels(stack.width_m, stack.height_m, stack.x_m), eyes + MOVE
    moved = align(stack, solved_for_m=eyes, eyes_m=now)
    frame = PanelFrame(1, layers, 1, moved.solved_from_shown, relief=relief, parallax=moved.parallax)
    as_shown, aligned = (shown_layers(one)[..., :3] for one in (frame, replace(frame, relief=None)))
    assert agreement_db(tmp_path, "aligned", as_shown, panels, now, 2) > 45
    assert agreement_db(tmp_path, "aligned", aligned, panels, now, 2) < 30


@pytest.mark.slow
def test_tilted_panels_too(tmp_path: Path) -> None:
    tilt = Tilt(tuple((0.0, *slopes) for slopes in TILT), (0.5, 0.0, 0.0))
    stack = replace(STACK, width_px=320, height_px=180, tilt=tilt)
    layers = picture(3, 180, 320, seed=4)[..., :3]
    eyes = eyes_at(distance_m=0.7, angle_deg=6, height_m=0.1)
    page = viewer_html(layers, (), stack, eyes_m=eyes, fov_deg=40, text=["tilted"])
    (tmp_path / "viewer.html").write_text(page)
    driven("look.mjs", tmp_path / "viewer.html", 320, 180, json.dumps(MOVE), tmp_path)
    panels = Panels(stack.width_m, stack.height_m, stack.x_m, TILT)
    assert min(judged(tmp_path, panels, eyes, layers, step=2)) > 45


def test_the_page_is_small_beside_its_pictures_and_asks_for_nothing(tmp_path: Path) -> None:
    layers = np.zeros((3, 36, 64, 3), np.uint8)
    eyes = eyes_at(distance_m=0.6)
    page = viewer_html(layers, (layers[0],) * 2, STACK, eyes_m=eyes, fov_deg=40, text=["</script><b>", "<i>"])
    assert len(re.sub(r"data:image/[^\"]*", "", page)) < 60 * 1024
    assert page.count("</script>") == 4 and "<b>" not in page and "<i>" not in page and "import " not in page
    assert not re.search(r"https?://(?!www\.w3\.org/2000/svg)", page)


@pytest.mark.parametrize("width_px", [320, 960])
def test_a_page_is_no_larger_than_its_layers_files_and_64_kib(tmp_path: Path, width_px: int) -> None:
    stack = replace(STACK, width_px=width_px, height_px=width_px * 9 // 16)
    eyes, pictures = pair(stack)
    result = phasestack.solve(*pictures, eyes_m=eyes, stack=stack, model="fast")
    result.save(tmp_path)
    files = sum((tmp_path / f"layer-{n}.png").stat().st_size for n in range(3))
    page = (tmp_path / "viewer.html").read_text()
    assert len(page.encode()) <= files + 64 * 1024
    urls = json.loads(re.findall(r'id="layers">(.*?)</script>', page)[0])
    for url, layer in zip(urls, result.layers, strict=True):
        decoded = cv2.imdecode(np.frombuffer(base64.b64decode(url.partition(",")[2]), np.uint8), cv2.IMREAD_COLOR_RGB)
        assert np.array_equal(decoded, layer)
    stored_db = float(re.search(r"compressed to (\d+) dB", page)[1])  # type: ignore[index]
    assert stored_db >= 35


def test_a_page_above_8_mb_has_compressed_layers_and_says_so() -> None:
    stack = replace(STACK, width_px=1280, height_px=720)
    random = np.random.default_rng(3)
    coarse = random.integers(0, 256, (3, 90, 160, 3)).astype(np.uint8)
    layers = np.stack([cv2.resize(each, (1280, 720), interpolation=cv2.INTER_CUBIC) for each in coarse])
    layers ^= random.integers(0, 16, layers.shape, np.uint8)  # what no lossless coder can shorten
    page = viewer_html(layers, (layers[0],) * 2, stack, eyes_m=eyes_at(distance_m=0.6), fov_deg=40.0, text=["large"])
    assert len(page.encode()) <= 8_000_000
    urls = json.loads(re.findall(r'id="layers">(.*?)</script>', page)[0])
    decoded = [
        np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")) for url in urls
    ]
    stored_db = float(re.search(r"Layers .* to (\d+) dB", page)[1])  # type: ignore[index]
    error = np.subtract(decoded, layers, dtype=np.float32) / 255
    assert -10 * np.log10(np.mean(error**2)) == pytest.approx(stored_db, abs=0.51) and stored_db > 35


def test_the_page_in_the_docs_has_today_s_script() -> None:
    """Or `make gallery` is due."""
    stack = replace(STACK, width_px=64, height_px=36)
    layers = np.zeros((3, 36, 64, 3), np.uint8)
    today = viewer_html(layers, (), stack, eyes_m=eyes_at(distance_m=0.6), fov_deg=40.0, text=[""])
    kept = (Path(__file__).parents[2] / "docs" / "images" / "viewer.html").read_text(encoding="utf-8")
    scripts = [re.findall(r"<script type=\"module\">(.*?)</script>", page, re.DOTALL) for page in (today, kept)]
    assert len(scripts[0]) == 1 and scripts[0] == scripts[1]


def test_a_result_opens_in_a_browser_and_is_a_notebook_s_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    stack = replace(STACK, width_px=64, height_px=36)
    random = np.random.default_rng(5).integers(0, 256, (2, 36, 64, 3)).astype(np.uint8)
    result = phasestack.solve(*random, eyes_m=eyes_at(distance_m=0.6), stack=stack, model="fast")
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    path = result.show()
    assert opened == [path.as_uri()] and "window.phasestack" in path.read_text()
    assert result._repr_html_().startswith("<iframe srcdoc=") and result._repr_html_().count("<") == 2
    shutil.rmtree(path.parent)


def test_a_run_that_saw_nobody_can_be_looked_into_too(tmp_path: Path) -> None:
    with recording_to(tmp_path / "r.mcap", RecordingHeader(driver="openni2", serial="A1")) as writer:
        for number in range(10):
            writer.write(SensorFrame(number + 1, number * 33_000_000))
    config, out = tmp_path / "c.toml", tmp_path / "out"
    config.write_text('[stack]\nwidth_px = 64\nheight_px = 36\n[model]\nname = "fast"\nbackend = "cpu"\n')
    options = ["--config", config, "--replay", tmp_path / "r.mcap", "--headless", "--max-speed", "--out", out]
    assert phasestack_command("run", *options).returncode == 0
    page = (out / "viewer.html").read_text()
    assert "no viewer was seen" in page and page.count("data:image/webp;base64,") == 3 and '"follows": false' in page


@pytest.mark.slow
def test_panels_as_built_show_what_the_simulator_computes(tmp_path: Path) -> None:
    pair = phasestack.example_pair()
    at: Any = {"stack": pair.stack, "eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg}
    layers = phasestack.solve(pair.left, pair.right, **at).layers
    targets = [pair.left, pair.right]
    page = viewer_html(layers, targets, pair.stack, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, text=["as built"])
    (tmp_path / "viewer.html").write_text(page)
    built = [{"shift_px": 3}, {"black": 0.02}, {}, {"short_deg": 3, "dark_deg": 2}]
    told = driven("built.mjs", tmp_path / "viewer.html", 640, 360, json.dumps(built), tmp_path)
    assert told["errors"] == []
    assert told["sliders"] == [0, 3, 2, 0, 0, 0]
    panels = Panels(pair.stack.width_m, pair.stack.height_m, pair.stack.x_m)
    rows, columns = np.arange(20, 340, 16), np.arange(20, 620, 16)
    shifted, grey, ideal = (cv2.imread(str(tmp_path / f"built-{k}.png"))[..., ::-1] / 255 for k in range(3))
    front_moved = np.concatenate([layers[:-1], np.roll(layers[-1:], 3, axis=2)])
    truth, _ = light(front_moved, panels, pair.eyes_m[0], rows=rows, columns=columns)
    assert -10 * np.log10(((shifted[np.ix_(rows, columns)] - truth) ** 2).mean()) > 38
    assert np.abs(grey - (ideal + 0.02 * (1 - ideal))).mean() < 0.01
    real = phasestack.RealPanels(cells=(phasestack.Cell(white_deg=87.0, black_deg=2.0),))
    simulated_db = phasestack.evaluate(layers, *targets, **at, panels=real, sigmas_mm=(0,)).light_db["0"]
    assert told["told"].endswith("dB against the target.")  # labels would mislead
    assert float(re.findall(r"(\d+\.\d) dB", told["told"])[0]) == pytest.approx(simulated_db, abs=0.5)


@pytest.mark.slow
def test_a_pupil_focused_on_a_panel_sees_that_panel_s_pixels_best(tmp_path: Path) -> None:
    """Noise on the rear panel is right of the middle, noise on the front panel left of it."""
    noise = np.random.default_rng(6).integers(0, 120, (360, 320, 1), np.uint8).repeat(3, 2)
    layers = np.full((3, 360, 640, 3), 60, np.uint8)
    layers[0, :, 320:] += noise
    layers[2, :, :320] += noise
    stack = PanelStack(640 * 0.27e-3, 360 * 0.27e-3, (-0.06, 0.0, 0.06), 640, 360)
    page = viewer_html(layers, (), stack, eyes_m=eyes_at(distance_m=0.4), fov_deg=22, text=["focus"])
    (tmp_path / "viewer.html").write_text(page)
    told = driven("focus.mjs", tmp_path / "viewer.html", 640, 360, json.dumps([-60, 0, 60]), tmp_path)
    assert told["errors"] == [] and told["slider"] == ["-40", True]
    rear, middle, front = (cv2.imread(str(tmp_path / f"focus-{k}.png")).astype(float) for k in range(3))
    right, left = (slice(100, 260), slice(440, 540)), (slice(100, 260), slice(100, 200))
    assert rear[right].std() > 1.2 * middle[right].std() > 1.2 * front[right].std()
    assert front[left].std() > 1.2 * middle[left].std() > 1.2 * rear[left].std()
