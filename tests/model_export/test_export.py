"""Export and validation: written files pass their checks and run in the runtime; failing ones aren't written."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
from onnx import numpy_helper  # noqa: E402
from typer.testing import CliRunner  # noqa: E402

from model_export.checkpoint import load_checkpoint, save_checkpoint  # noqa: E402
from model_export.export import export_model, in_torch, spectral_model  # noqa: E402
from model_export.eyereal import EyeRealNet  # noqa: E402
from model_export.onnx_files import with_contract  # noqa: E402
from model_export.validate import check_model, validate_file  # noqa: E402
from runtime.commands.app import app  # noqa: E402
from runtime.errors import InputError  # noqa: E402
from runtime.model.contract import Contract, Port  # noqa: E402
from runtime.model.job import drawn_job  # noqa: E402
from runtime.model.predictor import SHIPPED, load_predictor, model_path  # noqa: E402
from runtime.model.still import solve_still  # noqa: E402
from runtime.optics.stack import PanelStack  # noqa: E402

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)
EYES = np.array([[0.7, -0.0315, 0.0], [0.7, 0.0315, 0.0]])


def layers_of(path: Path) -> np.ndarray:
    picture = np.random.default_rng(5).integers(0, 256, (108, 192, 3), dtype=np.uint8)
    predictor = load_predictor(str(path), STACK)
    return solve_still(picture, picture, eyes_m=EYES, fov_deg=40.0, predictor=predictor).layers.copy()


def narrow_eyereal(tmp_path: Path) -> Path:
    """A checkpoint of the published network, narrow, with weights and statistics that aren't trivial."""
    torch.manual_seed(1)
    net = EyeRealNet(4)
    with torch.no_grad():
        net.train()(torch.rand(2, 18, 64, 96))
        net.subnets.out_conv[0].weight *= 4
    path = tmp_path / "published.pth"
    save_checkpoint(path, {"model": net.state_dict()})
    return path


def exported(checkpoint: Path, **options: Any) -> Path:
    """The ONNX file of a checkpoint."""
    out = checkpoint.with_suffix(".onnx")
    report = export_model("eyereal", out, checkpoint=checkpoint, width_px=192, height_px=108, **options)
    assert report.passed, report.table()
    return out


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_are_remade_from_their_recipes_to_the_byte(name: str) -> None:
    path = model_path(name)
    assert path is not None
    shipped, made = path.read_bytes(), spectral_model(name)[0]
    # Another version of torch may arrange the file differently; the numbers must not move.
    if onnx.load_from_string(shipped).producer_version == onnx.load_from_string(made).producer_version:
        assert made == shipped
    weights = [[numpy_helper.to_array(i) for i in onnx.load_from_string(d).graph.initializer] for d in (shipped, made)]
    assert all(np.array_equal(a, b) for a, b in zip(*weights, strict=True))


def test_the_eye_that_the_data_had_first_gets_the_first_channels(tmp_path: Path) -> None:
    pictures = np.random.default_rng(9).integers(0, 256, (2, 108, 192, 3), dtype=np.uint8)
    layers = {}
    for order in ("left-right", "right-left"):
        predictor = load_predictor(str(exported(narrow_eyereal(tmp_path), eye_order=order)), STACK)
        rgba = [np.dstack([p, p[..., :1]]) for p in pictures]
        layers[order] = predictor.solve(drawn_job(rgba, EYES, STACK)).layers.copy()
        layers[f"{order} swapped"] = predictor.solve(drawn_job(rgba[::-1], EYES[::-1], STACK)).layers.copy()
    assert np.array_equal(layers["left-right"], layers["right-left swapped"])
    assert not np.array_equal(layers["left-right"], layers["right-left"])


def test_a_file_with_changed_weights_differs_from_its_torch_source(tmp_path: Path) -> None:
    checkpoint = narrow_eyereal(tmp_path)
    model = onnx.load(exported(checkpoint))
    kernel = model.graph.initializer[0]
    kernel.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(kernel) * 3 + 1, kernel.name))
    net = EyeRealNet(4)
    net.load_state_dict(load_checkpoint(checkpoint)["model"])
    assert not check_model(model.SerializeToString(), source="changed", reference=in_torch(net.eval())).passed


def test_an_export_that_fails_its_checks_is_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("model_export.validate.LIMIT", -1.0)
    out = tmp_path / "balanced.onnx"
    arguments = ["export", "--arch", "balanced", "--out", str(out)]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 1
    assert "FAILED" in result.output and not out.exists()


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"width_px": 191}, "--width"),
        ({"height_px": 8}, "--height"),
        ({"arch": "huge"}, "--arch"),
        ({"arch": "eyereal"}, "--checkpoint"),
        ({"random_init": 1, "checkpoint": Path("x.pth")}, "--random-init"),
        ({"arch": "eyereal", "checkpoint": Path("absent.pth")}, "cannot be read"),
        ({"random_init": 1}, "fast is built from its recipe"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(tmp_path: Path, options: dict[str, Any], field: str) -> None:
    out = tmp_path / "new" / "model.onnx"
    with pytest.raises(InputError, match=field):
        export_model(**{"arch": "fast", "out": out, **options})
    assert not out.parent.exists()


def test_validate_refuses_what_is_not_ours(tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(b"nonsense")
    with pytest.raises(InputError, match="is not an ONNX model"):
        validate_file(path)
    model = onnx.load_from_string(spectral_model("fast")[0])
    del model.metadata_props[:]
    path.write_bytes(model.SerializeToString())
    with pytest.raises(InputError, match="has no contract"):
        validate_file(path)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_validate_takes_any_file_that_the_runtime_takes(tmp_path: Path) -> None:
    """Another architecture, of one picture an eye, of any size: blends of both eyes' phases."""

    class Blend(torch.nn.Module):  # type: ignore[name-defined]
        def forward(self, eyes: Any) -> Any:
            both = (eyes[:, :3] + eyes[:, 3:]) / 2
            return torch.cat([both * share for share in (0.3, 0.4, 0.3)], dim=1)

    path, names = tmp_path / "blend.onnx", {"eyes": ("one", "channels", "height", "width")}
    axes = {name: {2: "height", 3: "width"} for name in ("eyes", "panels")}
    torch.onnx.export(
        Blend(), (torch.zeros(1, 6, 32, 32),), str(path), input_names=["eyes"], output_names=["panels"],
        dynamic_axes=axes, dynamo=False,
    )  # fmt: skip
    contract = Contract(
        version=2, arch="blend", name="blend", panels=3, eyes=2, input_frame="centre", input_value="phase",
        layout="NCHW", eye_order="left-right", output="panels", branch=1, value_range=(0.0, 1.0), trained_for=None,
        recipe_sha256="", inputs=(Port(name="eyes", axes=names["eyes"]),),
        outputs=(Port(name="panels", axes=names["eyes"]),),
    )  # fmt: skip
    path.write_bytes(with_contract(path.read_bytes(), contract))
    report = validate_file(path)
    assert report.passed, report.table()
    assert layers_of(path)[..., :3].std() > 0
