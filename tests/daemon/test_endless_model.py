"""A model whose inference never ends, for real: 2^62 turns of a loop. No start hangs, no end is an abort."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from runtime.model.predictor import model_path

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 300


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shipped model with the loop before its last output, and no digest that would tell."""
    model = onnx.load(str(model_path("fast")))
    for node in model.graph.node:
        for index, name in enumerate(node.output):
            if name == "check":
                node.output[index] = "check_once"
    value = helper.make_tensor_value_info
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Add", ["x", "little"], ["y"])],
        "body",
        [value("turn", TensorProto.INT64, []), value("go", TensorProto.BOOL, []), value("x", TensorProto.FLOAT, [1])],
        [value("on", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, [1])],
        initializer=[numpy_helper.from_array(np.array([1e-30], np.float32), "little")],
    )
    model.graph.initializer.append(numpy_helper.from_array(np.array(2**62, np.int64), "turns"))
    model.graph.initializer.append(numpy_helper.from_array(np.array(True), "begin"))
    model.graph.node.append(helper.make_node("Loop", ["turns", "begin", "check_once"], ["check"], body=body))
    for entry in model.metadata_props:
        entry.value = json.dumps(json.loads(entry.value) | {"graph_sha256": ""})
    path = tmp_path_factory.mktemp("endless") / "endless.onnx"
    onnx.save(model, str(path))
    return path


def started(model: Path, folder: Path) -> subprocess.Popen[str]:
    command = f"run --replay demo --headless --scale 0.1 --backend opencv --model {model}"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "XDG_RUNTIME_DIR": str(folder), "OMP_NUM_THREADS": "1"}
    code = "from runtime.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", code, *command.split()], stderr=subprocess.PIPE, text=True, env=environment
    )


def test_a_stop_while_it_starts_is_heard_and_no_abort(endless: Path, tmp_path: Path) -> None:
    with started(endless, tmp_path) as process:
        assert process.stderr is not None
        line = process.stderr.readline()  # the socket's: signals are heard from before it on
        assert line
        process.send_signal(signal.SIGTERM)
        told = process.communicate(timeout=PATIENCE_S)[1]
    assert process.returncode == 0, told
    assert "stopped" in told and "terminate called" not in told
