"""A session loads one complete, self-describing file, and sends nothing home."""

from __future__ import annotations

import json
import os
import resource
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from runtime.errors import InputError, MissingPart
from runtime.model import predictor, session
from runtime.model.contract import METADATA_KEY
from runtime.model.onnx_bytes import digest, has_external_data
from runtime.model.predictor import SHIPPED, load_predictor, model_path
from runtime.model.session import ModelSession
from runtime.support.onnx_runtime import onnxruntime
from runtime.support.untrusted_input import LIMITS
from tests.model.scenes import STACK


def shipped(name: str = "fast") -> onnx.ModelProto:
    return onnx.load(str(model_path(name)))


def saved(model: onnx.ModelProto, tmp_path: Path, **change: object) -> Path:
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = json.dumps(json.loads(entry.value) | change)
    path = tmp_path / "other.onnx"
    path.write_bytes(model.SerializeToString())
    return path


def outside(name: str) -> TensorProto:
    tensor = numpy_helper.from_array(np.ones(2, np.float32), name)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="weights.bin")
    return tensor


def test_weights_in_another_file_are_refused_wherever_they_are_asked_for(tmp_path: Path) -> None:
    model = shipped()
    assert not has_external_data(model.SerializeToString())
    model.graph.initializer.append(outside("elsewhere"))
    with pytest.raises(InputError, match=r"external_data: is not supported.*onnx\.save\(onnx\.load\(NAME\)"):
        ModelSession(saved(model, tmp_path))
    branch = helper.make_graph([helper.make_node("Constant", [], ["y"], value=outside("deep"))], "b", [], [])
    nested = helper.make_graph(
        [helper.make_node("If", ["x"], ["y"], then_branch=branch, else_branch=branch)], "g", [], []
    )
    assert has_external_data(helper.make_model(nested).SerializeToString())


def test_a_file_that_was_changed_after_its_export_is_refused(tmp_path: Path) -> None:
    model = shipped()
    weight = next(item for item in model.graph.initializer if item.name == "log_floor")
    weight.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(weight) + 1, weight.name))
    with pytest.raises(InputError, match="graph_sha256"):
        ModelSession(saved(model, tmp_path))
    ModelSession(saved(model, tmp_path, graph_sha256=""))  # who doesn't tell isn't checked


def test_the_digest_leaves_out_the_metadata_alone() -> None:
    model = shipped()
    before = digest(model.SerializeToString())
    model.metadata_props.add(key="note", value="x")
    assert digest(model.SerializeToString()) == before
    model.producer_name = "somebody else"
    assert digest(model.SerializeToString()) != before


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_model_is_the_one_that_was_shipped(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load_predictor(name, STACK).close()
    path = model_path(name)
    assert path is not None
    other = tmp_path / "bitten.onnx"
    other.write_bytes(path.read_bytes()[:-1] + b"\0")
    monkeypatch.setattr(predictor, "model_path", lambda _: other)
    with pytest.raises(InputError, match="SHA-256 differs"):
        load_predictor(name, STACK)


def test_inputs_are_the_ones_that_the_contract_declares(tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"contract\.outputs: declares rear \(1 axes\), but the graph has rear \(3 axes\)"
    ):
        ModelSession(saved(shipped(), tmp_path, outputs=[{"name": "rear", "axes": ["x"]}]))


def test_metadata_that_is_no_text_is_one_line(tmp_path: Path) -> None:
    data = shipped().SerializeToString()
    path = tmp_path / "other.onnx"
    path.write_bytes(data.replace(b'"version"', b'"\xff\xfersion"'))
    with pytest.raises(InputError) as caught:
        ModelSession(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("data", [b"", b"\xff" * 40, b"not a model", b"\x3a\xff\xff\xff\x7f"])
def test_bytes_that_are_no_model_are_one_line(data: bytes, tmp_path: Path) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        ModelSession(path)
    assert "\n" not in str(caught.value)


def test_telemetry_is_off_before_onnxruntime_is_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    onnxruntime.cache_clear()
    monkeypatch.delenv("ORT_DISABLE_TELEMETRY", raising=False)
    onnxruntime()
    assert os.environ["ORT_DISABLE_TELEMETRY"] == "1"


def test_nodes_that_another_provider_runs_are_told_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One that comes with onnxruntime and runs none of ours."""
    path = model_path("fast")
    assert path is not None
    assert ModelSession(path).fell_back == ()
    monkeypatch.setitem(session.PROVIDERS, "remote", ("AzureExecutionProvider", "onnxruntime"))
    with caplog.at_level("WARNING"):
        loaded = ModelSession(path, provider="remote")
    assert len(loaded.fell_back) > 50
    assert all(loaded.fell_back)
    assert (
        f"the provider remote left {len(loaded.fell_back)} nodes to another provider: {loaded.fell_back[0]}, "
        in caplog.text
    )


def test_a_provider_that_is_installed_and_does_not_start_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """onnxruntime would go on without it."""
    path = model_path("fast")
    assert path is not None

    class Module:
        SessionOptions, InferenceSession = onnxruntime().SessionOptions, None

        @staticmethod
        def get_available_providers() -> list[str]:
            return ["CUDAExecutionProvider"]

    def on_the_processor(data: bytes, options: Any, providers: list[str]) -> Any:
        return onnxruntime().InferenceSession(data, options, providers=["CPUExecutionProvider"])

    Module.InferenceSession = staticmethod(on_the_processor)
    monkeypatch.setattr(session, "onnxruntime", lambda: Module)
    with pytest.raises(MissingPart, match=r"model\.provider: cuda is installed but does not start"):
        ModelSession(path, provider="cuda")


def test_constants_that_are_worked_out_to_all_memory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model of 6 KB took 17.5 GB: a constant, doubled again and again when the model is loaded."""
    monkeypatch.setattr(session, "MEMORY_MAX", 1 << 29)
    nodes = [helper.make_node("Concat", [f"x{k}", f"x{k}"], [f"x{k + 1}"], axis=0) for k in range(31)]
    nodes.append(helper.make_node("ReduceSum", ["x31"], ["y"], keepdims=0))
    output = helper.make_tensor_value_info("y", TensorProto.FLOAT, None)
    grows = helper.make_graph(nodes, "g", [], [output], [numpy_helper.from_array(np.ones(1, np.float32), "x0")])
    model = helper.make_model(grows, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    (tmp_path / "grows.onnx").write_bytes(model.SerializeToString())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="needs more than 512 MiB"):
        ModelSession(tmp_path / "grows.onnx")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10


def test_a_model_that_takes_for_ever_to_load_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LIMITS, "load_s", 0.01)
    with pytest.raises(InputError, match=r"was not loaded within 0\.01 s"):
        ModelSession(saved(shipped(), tmp_path, name="slow"))
