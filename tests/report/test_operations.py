"""Multiply-adds: a small graph counted by hand, and formulas against the work that is really done."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import ModelSettings
from runtime.errors import InputError
from runtime.model.predictor import load_predictor, model_path
from runtime.optics.stack import PanelStack
from runtime.report import operations
from runtime.report.methods import Method, opened
from runtime.report.pairs import StillPair, eyes_at

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)


def still(stack: PanelStack = STACK) -> StillPair:
    grey = np.full((stack.height_px, stack.width_px, 3), 128, np.uint8)
    return StillPair("grey", stack, eyes_at(distance_m=0.6), (grey, grey), 40.0)


def write_graph(path: Path) -> None:
    """(1, 4, h, w): a convolution of two groups to 6 channels, 3x3, stride 2; a rectifier; times a matrix 5x7."""
    onnx = pytest.importorskip("onnx")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    weights = onnx.numpy_helper.from_array(np.ones((6, 2, 3, 3), np.float32), "weights")
    matrix = onnx.numpy_helper.from_array(np.ones((5, 7), np.float32), "matrix")
    nodes = [
        helper.make_node("Conv", ["x", "weights"], ["a"], group=2, strides=[2, 2], pads=[1, 1, 1, 1]),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Transpose", ["b"], ["c"], perm=[0, 1, 2, 3]),
        helper.make_node("MatMul", ["c", "matrix"], ["y"]),
    ]
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("x", kind, [1, 4, "h", "w"])],
        [helper.make_tensor_value_info("y", kind, None)],
        [weights, matrix],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def test_a_small_graph_counts_as_by_hand(tmp_path: Path) -> None:
    write_graph(tmp_path / "small.onnx")
    # 8x10 in, 4x5 out of the convolution: 6 channels of 4·5 values, each of 2 channels of 3x3.
    by_hand = 6 * 4 * 5 * (2 * 3 * 3) + 6 * 4 * 5 + 6 * 4 * 7 * 5
    assert operations.graph_multiply_adds(tmp_path / "small.onnx", [(1, 4, 8, 10)]) == by_hand
    with pytest.raises(InputError, match=r"small\.onnx: does not run"):
        operations.graph_multiply_adds(tmp_path / "small.onnx", [(1, 3, 8, 10)])


def test_the_published_network_counts_as_its_own_layers_do(tmp_path: Path) -> None:
    torch = pytest.importorskip("torch")
    from model_export.export import ExportRequest, eyereal_model

    request = ExportRequest("eyereal", tmp_path / "e.onnx", random_init=0, width_px=64, height_px=96, base_width=4)
    data, net = eyereal_model(request)
    (tmp_path / "e.onnx").write_bytes(data)
    convolved = 0

    def note(layer: Any, _: Any, answer: Any) -> None:
        nonlocal convolved
        convolved += answer.numel() * layer.weight[0].numel()

    for layer in net.modules():
        if isinstance(layer, torch.nn.Conv2d):
            layer.register_forward_hook(note)
    with torch.no_grad():
        net(torch.zeros(1, 18, 96, 64))
    counted = operations.graph_multiply_adds(tmp_path / "e.onnx", [(1, 18, 96, 64)])
    assert convolved < counted < 1.15 * convolved  # rectifiers, limits and enlargements are the rest


def test_a_model_counts_its_network_as_often_as_it_runs_and_is_left_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    predictor = load_predictor("best", STACK, ModelSettings())
    session = predictor.session  # type: ignore[attr-defined]
    counted = []
    monkeypatch.setattr(operations, "graph_multiply_adds", lambda path, shapes: counted.append(shapes) or 10**12)
    total = operations.predictor_multiply_adds(predictor, still(), path=model_path("best"))
    chains = sum(step.kind == "chain" for step in session.contract.steps)
    assert chains > 0 and total // 10**12 % chains == 0 and total // 10**12 > 0
    assert 0 < total % 10**12 < 10**9  # the corrections: nothing to do with the network
    assert counted and predictor.session is session  # type: ignore[attr-defined]


def test_more_work_is_more_multiply_adds() -> None:
    pair = still()

    def count(source: str, iterations: int = 0, scale: float = 1.0) -> int:
        method = Method(source, "network", source, iterations, scale=scale)
        return opened(method, pair, threads=1).multiply_adds(pair)

    assert 0 < count("mean") < count("fast") < count("balanced") < count("best")
    assert count("best", scale=0.5) < 0.6 * count("best")
    for source in ("sart", "cg", "filter"):
        one, two, three = (count(source, n) for n in (1, 2, 3))
        assert one > 0 and three - two == two - one > 0
    # SART by hand: a table, then per turn, eye and panel two samples of four, a sum, a share and sum, and a limit.
    assert count("sart", 1) - count("sart", 0) == 2 * 3 * 11 * 3 * 192 * 108


def test_counts_are_spoken_in_billions() -> None:
    assert [operations.spoken(n) for n in (4.27e8, 2.08e9, 4.04e11, 5.3e12)] == ["0.43", "2.1", "404", "5,300"]
