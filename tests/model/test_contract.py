"""A model file is refused in one clear line where its contract is missing, unknown or does not fit."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from runtime.config import ModelSettings
from runtime.errors import InputError, MissingPart
from runtime.model.contract import METADATA_KEY, parse_contract
from runtime.model.predictor import SHIPPED, load_predictor, model_path
from runtime.optics.stack import PanelStack
from tests.model.scenes import STACK
from tests.model.test_session import saved, shipped


def contract_of(name: str) -> dict[str, object]:
    return json.loads({entry.key: entry.value for entry in shipped(name).metadata_props}[METADATA_KEY])


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_models_keep_their_contract_and_are_small(name: str) -> None:
    contract = parse_contract({METADATA_KEY: json.dumps(contract_of(name))}, source=name)
    assert contract.name == name
    path = model_path(name)
    assert path is not None
    assert path.stat().st_size < 4 * 2**20


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"version": 1}, "version"),
        ({"input_frame": "eye"}, "input_frame"),
        ({"surprise": 1}, "surprise"),
        ({"panels": "three"}, "panels"),
        ({"value_range": [0, "x"]}, "value_range"),
        ({"steps": [{"kind": "front"}]}, "kind"),
        ({"steps": [{"size": 0}]}, "size"),
        ({"steps": [{"size": 3.1}]}, "size"),
        ({"cell_px": 0}, "cell_px"),
        ({"cell_px": 65}, "cell_px"),
        ({"panels": 1}, "panels"),
        ({"panels": 7}, "panels"),
        ({"width_px": 16385}, "width_px"),
        ({"picture_fov_deg": 180}, "picture_fov_deg"),
        ({"inputs": [{"name": "x", "axes": []}] * 33}, "inputs"),
        ({"inputs": [{"name": "x", "axes": ["a"] * 9}]}, "axes"),
        ({"steps": [{}] * 65}, "steps"),
        ({"steps": [{"momentum": 1}]}, "momentum"),
        ({"steps": [{"floor": 0}]}, "floor"),
        ({"outputs": []}, "outputs"),
    ],
)
def test_a_contract_that_does_not_fit_is_refused_by_field(change: dict[str, object], field: str) -> None:
    with pytest.raises(InputError, match=field):
        parse_contract({METADATA_KEY: json.dumps(contract_of("fast") | change)}, source="m.onnx")


def test_a_contract_s_limits_are_in_range() -> None:
    port = {"name": "x", "axes": ["a"] * 8}
    limits = {
        "panels": 6, "width_px": 16384, "height_px": 16384, "cell_px": 64, "picture_fov_deg": 179.9,
        "inputs": [port] * 32, "outputs": [port] * 32, "steps": [{"size": 3, "momentum": 0, "floor": 1}] * 64,
    }  # fmt: skip
    parse_contract({METADATA_KEY: json.dumps(contract_of("fast") | limits)}, source="m.onnx")
    parse_contract({METADATA_KEY: json.dumps(contract_of("fast") | {"panels": 2, "cell_px": 1})}, source="m.onnx")


@pytest.mark.parametrize("text", [None, "{", "[1]", "[" * 100_000, '{"a":' * 100_000])
def test_a_missing_or_malformed_contract_is_refused(text: str | None) -> None:
    with pytest.raises(InputError, match=METADATA_KEY):
        parse_contract({} if text is None else {METADATA_KEY: text}, source="m.onnx")


def test_a_model_for_other_panels_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="panels"):
        load_predictor(str(saved(shipped(), tmp_path, panels=4)), STACK)


def test_a_shipped_network_with_the_inputs_of_another_version_is_refused(tmp_path: Path) -> None:
    model = shipped()
    old = contract_of("fast")
    for port in (*model.graph.input, *old["inputs"]):  # type: ignore[misc]
        if isinstance(port, dict):
            port["name"] = port["name"].replace("cell_waves", "basis")
        else:
            port.name = port.name.replace("cell_waves", "basis")
    for node in model.graph.node:
        node.input[:] = ["basis" if name == "cell_waves" else name for name in node.input]
    path = saved(model, tmp_path, **old | {"graph_sha256": ""})
    with pytest.raises(InputError, match=r"contract\.inputs.*export the model again"):
        load_predictor(str(path), STACK)


def test_a_named_file_never_quietly_becomes_another_solver(tmp_path: Path) -> None:
    uneven = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.03), 480, 270)
    with pytest.raises(InputError, match="evenly"):
        load_predictor(str(saved(shipped(), tmp_path)), uneven)


def test_a_provider_that_is_not_installed_names_its_package() -> None:
    with pytest.raises(MissingPart, match="onnxruntime-gpu"):
        load_predictor("fast", STACK, ModelSettings(provider="cuda"))
