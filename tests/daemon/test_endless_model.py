"""Tests that a model with an endless loop and a scene that takes all memory do not hang the daemon."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from runtime.daemon import reconfigure
from runtime.model.predictor import model_path
from runtime.support import child
from tests.daemon.test_changes import Served

ROOT = Path(__file__).resolve().parents[2]
PATIENCE_S = 300


@pytest.fixture(scope="module")
def endless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shipped model with the loop before its last output, and no digest."""
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


def test_an_endless_model_is_refused_and_hangs_no_thread_of_the_daemon(
    endless: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It used to block a thread for two minutes, and the daemon's end forever."""
    monkeypatch.setattr(reconfigure, "MODEL_S", 10.0)
    with Served(tmp_path) as served:
        answer = served.asked("model", str(endless))
        assert not answer["ok"] and answer["error"].endswith("endless.onnx: was not loaded within 10 s")
        assert not [thread for thread in threading.enumerate() if thread.name.startswith("job reconf")]
        served.rig.refresh_until_solved()


@pytest.mark.slow
def test_a_scene_that_takes_all_memory_ends_only_its_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import trimesh

    trimesh.creation.icosphere(subdivisions=6).export(tmp_path / "ball.stl")
    (tmp_path / "bad.stl").write_bytes(b"solid no mesh")
    with Served(tmp_path) as served:
        asked = [served.asked("scene", str(tmp_path / name)) for name in ("ball.stl", "bad.stl")]
        assert asked[0].get("ok"), asked
        assert "bad.stl" in asked[1]["error"]
        monkeypatch.setattr(child, "MEMORY_MAX", 48 << 20)
        answer = served.asked("scene", str(tmp_path / "ball.stl"))
        assert not answer["ok"] and "ball.stl: needs more than 48 MiB" in answer["error"]
        served.rig.refresh_until_solved()
