"""Training: exact geometry of the data, light as the loss, resumed as if never stopped; and custom modules."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
torch = pytest.importorskip("torch")
from typer.testing import CliRunner  # noqa: E402

from model_export.checkpoint import load_checkpoint  # noqa: E402
from model_export.data import TrainingPair, random_pair  # noqa: E402
from model_export.export import export_model, picture_file  # noqa: E402
from model_export.light import Views, improved, light_db  # noqa: E402
from model_export.modules import Form, make_network  # noqa: E402
from model_export.pairs import TrainingPairs, network_input  # noqa: E402
from model_export.scene import Parallelogram, Scene, draw  # noqa: E402
from model_export.train import Training, _held_out_db, displayed, run_training  # noqa: E402
from model_export.validate import validate_file  # noqa: E402
from runtime.commands.app import app  # noqa: E402
from runtime.errors import InputError  # noqa: E402
from runtime.model.base import Prediction  # noqa: E402
from runtime.model.predictor import load_predictor  # noqa: E402
from runtime.model.still import solve_still  # noqa: E402
from runtime.optics.stack import PanelStack  # noqa: E402
from runtime.optics.views import raster_from_stack  # noqa: E402
from runtime.support.artifacts import write_png  # noqa: E402
from runtime.support.picture_file import read_image  # noqa: E402
from runtime.support.progress import listening  # noqa: E402
from tests.model_export.golden import EYES as PUBLISHED_EYES  # noqa: E402
from tests.model_export.golden import picture  # noqa: E402
from tests.model_export.unservable import FAULTS  # noqa: E402
from tests.waiting import eventually  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
EYES = np.array([[0.7, -0.0315, 0.02], [0.7, 0.0315, 0.02]])
SMALL = {"width_px": 160, "height_px": 96}


def drawn(scene: Scene, eye: np.ndarray) -> np.ndarray:
    return draw(scene, raster_from_stack(eye, STACK.panel(1)), width_px=480, height_px=270)


# A texture is drawn twice as fine as the raster and averaged: its edges are true to about a tenth of a pixel.
def test_a_plane_is_drawn_where_the_projection_puts_it() -> None:
    white = np.full((40, 40, 4), 255, np.uint8)
    centre = np.array([-0.1, 0.05, -0.03])
    plane = Parallelogram(white, centre - [0, 0.01, -0.01], np.array([0, 0.02, 0.0]), np.array([0, 0, -0.02]))
    for eye in EYES:
        picture = drawn((plane,), eye).mean(axis=2)
        v_px, u_px = np.mgrid[0:270, 0:480] + 0.5
        u, v, w = raster_from_stack(eye, STACK.panel(1)) @ [*centre, 1.0]
        assert (u_px * picture).sum() / picture.sum() == pytest.approx(u / w, abs=0.12)
        assert (v_px * picture).sum() / picture.sum() == pytest.approx(v / w, abs=0.12)


def test_pairs_of_a_scene_are_the_runtime_s_own_pictures_of_it() -> None:
    first, again, other = (TrainingPairs(Form(), 3, 96, 54, 1.0, scene="demo").pair(number) for number in (0, 0, 1))
    assert np.array_equal(first.images, again.images) and np.array_equal(first.eyes_m, again.eyes_m)
    assert not np.array_equal(first.images[0], first.images[1]) and np.std(first.images) > 20
    assert np.abs(first.eyes_m - other.eyes_m).max() > 0.01 and not np.array_equal(first.images, other.images)
    with pytest.raises(InputError, match="no-such-scene"):
        TrainingPairs(Form(), 3, 96, 54, 1.0, scene="no-such-scene").pair(0)


def test_a_network_of_pictures_is_fed_what_the_runtime_feeds_it(tmp_path: Path) -> None:
    """Pixel by pixel: equal to the runtime's input, for a pair with other panels."""
    pair = random_pair(np.random.default_rng([4, 1]), **SMALL)
    for frame, value in (("centre", "intensity"), ("panel", "phase")):
        form = Form(input_frame=frame, input_value=value)
        network = make_network("tests.model_export.unservable:Even", {})
        network = dataclasses.replace(network, form=form)
        path = tmp_path / f"{frame}.onnx"
        path.write_bytes(picture_file(network, "", **SMALL))
        _, predictor = solved_by(path, pair)
        fed, wanted = predictor._proposal._input[0], network_input(pair, form)
        assert wanted.shape == fed.shape
        inside = slice(8, -8)  # outside the pictures the runtime extrapolates
        assert np.abs(fed - wanted)[:, inside, inside].max() < 3 / 255


def solved_by(path: Path, pair: TrainingPair) -> tuple[Prediction, Any]:
    """A pair's solution by a model's file, and the predictor, closed."""
    predictor = load_predictor(str(path), pair.stack)
    how: dict[str, Any] = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg, "eye_sigma_mm": 0.0}
    solved = solve_still(*pair.images, predictor=predictor, **how)
    predictor.close()
    return solved, predictor


def test_what_is_displayed_is_clipped_in_eight_bits_and_lets_gradients_through() -> None:
    values = torch.tensor([-0.3, 0.2501, 1.7], requires_grad=True)
    shown = displayed(values)
    assert shown.detach().numpy() == pytest.approx([0.0, 64 / 255, 1.0])
    (shown * torch.tensor([1.0, 2.0, 3.0])).sum().backward()
    assert values.grad.tolist() == [1.0, 2.0, 3.0]


SHORT: dict[str, Any] = {
    "arch": "my_network:MyNetwork", "options": {"width": 8, "levels": 1}, "iterations": 12, "width_px": 96,
    "height_px": 64, "validate_every": 4, "pairs": 2, "learning_rate": 1e-2,
}  # fmt: skip


@pytest.fixture(autouse=True)
def examples(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))


def curve(out: Path) -> list[list[str]]:
    return [row.split(",") for row in (out / "curve.csv").read_text().splitlines()]


def test_training_raises_the_light_that_eyes_get_and_leaves_its_files(tmp_path: Path) -> None:
    result = run_training(tmp_path, Training(**SHORT | {"iterations": 40, "validate_every": 40, "pairs": 1}))
    rows = curve(tmp_path)
    assert rows[0] == ["iteration", "light_db", "held_out_light_db"] and [row[0] for row in rows[1:]] == ["0", "40"]
    assert result["iterations"] == 40
    assert read_image(tmp_path / "curve.png").shape[2] == 3
    table = load_checkpoint(tmp_path / "checkpoint.pth")
    assert table["training"]["options"] == SHORT["options"]
    # Light of the training pair by exact rays: before and after.
    pairs = TrainingPairs(Form(), seed=1, width_px=96, height_px=64, eye_sigma_mm=0.0, count=1)
    batch = torch.utils.data.default_collate([pairs[0]])
    before, after = make_network(SHORT["arch"], SHORT["options"], seed=1), make_network(SHORT["arch"], SHORT["options"])
    after.net.load_state_dict(table["model"])
    assert _held_out_db(after, [batch], torch.device("cpu")) > _held_out_db(before, [batch], torch.device("cpu")) + 0.5


def test_two_processes_share_a_batch_and_learn_what_one_does(tmp_path: Path) -> None:
    command = ["train", "--arch", SHORT["arch"], "--option", "width=8", "--option", "levels=1", "--iterations", "6"]
    command += ["--width", "96", "--height", "64", "--validate-every", "3", "--learning-rate", "1e-2", "--json"]
    two = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "phasestack"]
    environment = os.environ | {"PYTHONPATH": f"{ROOT / 'examples'}{os.pathsep}{ROOT}"}

    def trained(start: list[str], out: str, batch: str) -> subprocess.CompletedProcess[str]:
        arguments = [*start, *command, "--batch", batch, "--out", str(tmp_path / out)]
        return subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=300, check=False)

    one, shared = trained([sys.executable, "-m", "phasestack"], "one", "4"), trained(two, "two", "4")
    assert one.returncode == shared.returncode == 0, one.stderr + shared.stderr
    assert json.loads(shared.stdout)["held_out_db"] == pytest.approx(json.loads(one.stdout)["held_out_db"], abs=0.01)
    tables = [load_checkpoint(tmp_path / out / "checkpoint.pth") for out in ("one", "two")]
    assert tables[0]["curve"][1:] == [pytest.approx(row, rel=1e-3) for row in tables[1]["curve"][1:]]
    for name, weights in tables[0]["model"].items():
        torch.testing.assert_close(tables[1]["model"][name], weights, rtol=1e-3, atol=1e-4)
    odd = trained(two, "odd", "3")
    assert odd.returncode != 0 and "--batch: must be a multiple of the 2 processes, not 3" in odd.stderr


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_training_told_to_stop_leaves_its_last_iteration(tmp_path: Path, sent: signal.Signals, code: int) -> None:
    """Long before the first validation; --resume then ends where one that was never stopped does."""
    cut, whole, training = tmp_path / "cut", tmp_path / "whole", Training(**SHORT | {"validate_every": 12})

    def stops(what: str, done: int, total: int | None) -> None:
        if what.startswith("training") and done == 7:
            signal.raise_signal(sent)

    with pytest.raises(SystemExit) as stopped, listening(stops):
        run_training(cut, training)
    assert stopped.value.code == code and load_checkpoint(cut / "checkpoint.pth")["done"] == 7
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    run_training(cut, training, resume=True)
    run_training(whole, training)
    assert curve(cut) == curve(whole)


def test_a_killed_training_continues_as_if_uninterrupted(tmp_path: Path) -> None:
    """kill -9 between two checkpoints; then --resume: the same curve and weights as without."""
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    run_training(whole, Training(**SHORT))
    options = (
        "--option width=8 --option levels=1 --iterations 12 --width 96 --height 64 --validate-every 4 --pairs 2 "
        "--learning-rate 0.01"
    )
    command = [sys.executable, "-m", "runtime.cli", "train", "--arch", SHORT["arch"], *options.split(), "--out", cut]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "examples")])}
    process = subprocess.Popen(command, env=environment, cwd=tmp_path)
    assert eventually(lambda: (cut / "curve.csv").exists(), within_s=120)
    process.kill()
    process.wait()
    assert len(curve(cut)) < len(curve(whole))
    run_training(cut, Training(**SHORT), resume=True)
    assert curve(cut) == curve(whole)
    ends = [load_checkpoint(out / "checkpoint.pth")["model"] for out in (whole, cut)]
    assert all(torch.equal(value, ends[1][key]) for key, value in ends[0].items())
    with pytest.raises(InputError, match=r"checkpoint\.pth: seed: must be 1"):
        run_training(cut, Training(**SHORT | {"seed": 2}), resume=True)


def test_the_published_network_learns_from_a_folder_of_its_pictures(tmp_path: Path) -> None:
    folder = tmp_path / "lego_bulldozer"
    for number in (0, 1):
        for half, (x, y, z) in enumerate(PUBLISHED_EYES["usual"]):
            write_png(folder / f"pair{number}_x{x}_y{y}_z{z}_{half}.png", picture(half))
    training = Training(arch="eyereal", options={"width": 4}, iterations=2, width_px=64, height_px=40, data=str(folder))
    result = run_training(tmp_path / "out", training)
    assert result["held_out_pairs"] == 1 and math.isfinite(result["held_out_db"])
    report = export_model(
        "eyereal", tmp_path / "eyereal.onnx", checkpoint=tmp_path / "out" / "checkpoint.pth", width_px=64, height_px=40
    )
    assert report.passed, report.table()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"options": {"steps": 65}}, "my_network:MyNetwork: steps"),
        ({"data": "/nowhere/lego_bulldozer"}, "is not a folder"),
        ({"data": "/nowhere/unnamed"}, "name must contain one of"),
        ({"arch": "tests.model_export.unservable:NotFinite", "options": {}}, "not finite"),
        ({"options": {"width": 8, "depth": 3}}, "--option: depth"),
        ({"arch": "balanced", "options": {}}, "'balanced' is not a network; use eyereal, unrolled or module:Class"),
    ],
)
def test_what_cannot_be_trained_is_refused_before_anything_is_written(
    tmp_path: Path, changes: dict[str, Any], problem: str
) -> None:
    with pytest.raises(InputError, match=re.escape(problem)):
        run_training(tmp_path / "out", Training(**SHORT | changes))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("arch", "problem"), FAULTS.items())
def test_a_module_that_cannot_be_served_is_refused_in_one_line(
    tmp_path: Path, arch: str, problem: str, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "model.onnx"
    command = ["export", "--arch", arch, "--random-init", "1", "--width", "64", "--height", "48", "--out", str(out)]
    result = CliRunner().invoke(app, [*command, *(["--option", "width=2"] if arch.endswith("Narrow") else [])])
    assert isinstance(result.exception, InputError) and problem in str(result.exception), result.exception
    assert "\n" not in str(result.exception) and result.output == "" and capfd.readouterr() == ("", "")
    assert not out.parent.exists()


def test_a_network_of_ones_own_is_trained_exported_and_served(tmp_path: Path) -> None:
    """The example, by the commands of its page: the runtime shows torch's results."""
    run_training(tmp_path, Training(**SHORT | {"iterations": 4}))
    path, checkpoint = tmp_path / "mine.onnx", tmp_path / "checkpoint.pth"
    assert export_model(SHORT["arch"], path, checkpoint=checkpoint, width_px=160, height_px=96).passed
    assert validate_file(path).passed
    pair = random_pair(np.random.default_rng([4, 1]), **SMALL)
    solved, predictor = solved_by(path, pair)
    assert predictor.facts.name == "MyNetwork"
    net = make_network(SHORT["arch"], SHORT["options"]).net.eval()
    net.load_state_dict(load_checkpoint(checkpoint)["model"])
    with torch.no_grad():
        fed = torch.from_numpy(predictor._proposal._input)
        panels = net(fed)[0].clamp(0, 1).mul(255).round().reshape(3, 3, 96, 160)
    layers = solved.layers[..., :3].astype(np.float32)
    assert solved.steps == 0
    assert np.abs(layers - panels.permute(0, 2, 3, 1).numpy()).max() <= 1
    with pytest.raises(InputError, match="is a checkpoint of my_network:MyNetwork, not "):
        export_model("tests.model_export.unservable:Even", path, checkpoint=checkpoint)


def served(path: Path, number: int) -> tuple[Prediction, float]:
    """A pair's solution by a model's file, and its light by rays for the eyes that it was solved for."""
    pair = random_pair(np.random.default_rng([4, number]), **SMALL)
    solved, _ = solved_by(path, pair)
    panels = torch.from_numpy(solved.layers[..., :3].transpose(0, 3, 1, 2).copy()) / 255
    return solved, light_db(panels, *of_pair(pair), random=torch.Generator().manual_seed(1))


def of_pair(pair: TrainingPair) -> tuple[Any, Views]:
    """Targets and views."""
    views = Views.of(pair.stack, pair.eyes_m, **SMALL, fov_deg=pair.fov_deg)
    return torch.from_numpy(np.stack(pair.images).transpose(0, 3, 1, 2).copy()) / 255, views


def test_steps_after_a_learned_proposal_are_trained_and_raise_its_light(tmp_path: Path) -> None:
    run_training(tmp_path, Training(**SHORT | {"iterations": 8, "options": {**SHORT["options"], "steps": 2}}))
    found = {}
    for steps in (0, 2):
        path = tmp_path / f"{steps}.onnx"
        options = {"steps": steps} if steps == 0 else {}  # the checkpoint says that there are two
        report = export_model(SHORT["arch"], path, checkpoint=tmp_path / "checkpoint.pth", options=options, **SMALL)
        assert report.passed and validate_file(path).passed
        found[steps] = [served(path, number) for number in (1, 2, 3)]
    assert [solved.steps for solved, _ in found[0] + found[2]] == [0] * 3 + [2] * 3
    gains = [after - before for (_, before), (_, after) in zip(found[0], found[2], strict=True)]
    assert min(gains) > 1.0, gains


def test_unrolled_steps_learn_their_sizes_and_are_served_with_them(tmp_path: Path) -> None:
    result = run_training(
        tmp_path,
        Training(
            **SHORT
            | {"arch": "unrolled", "options": {"steps": 3, "size": 0.2}, "iterations": 24, "learning_rate": 0.05}
        ),
    )
    assert result["held_out_db"] > result["start_db"] + 1
    path, checkpoint = tmp_path / "unrolled.onnx", tmp_path / "checkpoint.pth"
    assert export_model("unrolled", path, checkpoint=checkpoint, width_px=160, height_px=96).passed
    learned = load_checkpoint(checkpoint)["model"]["step_sizes"]
    steps = json.loads(onnx.load(path).metadata_props[0].value)["steps"]
    assert [step["size"] for step in steps] == pytest.approx(learned.tolist()) and learned.std() > 0.01
    network = make_network("unrolled", {"steps": 3, "size": 0.2})
    network.net.load_state_dict(load_checkpoint(checkpoint)["model"])
    pair = random_pair(np.random.default_rng([4, 1]), **SMALL)
    with torch.no_grad():
        batch = torch.utils.data.default_collate([{"input": torch.from_numpy(network_input(pair, Form()))}])
        x, of = network.net(batch["input"])[0].reshape(3, 3, 96, 160), of_pair(pair)
        panels = displayed(improved(x, *of, *network.steps()))
        in_torch = light_db(panels, *of, random=torch.Generator().manual_seed(1))
    solved, db = served(path, 1)
    assert solved.steps == 3 and db == pytest.approx(in_torch, abs=0.5)
