"""A network of pictures that cannot run is refused in one line wherever it is named, and says what was expected."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import onnxruntime
import pytest
from onnx import TensorProto, helper

from model_export.validate import validate_file
from runtime.errors import InputError
from runtime.model.contract import METADATA_KEY
from runtime.model.predictor import load_predictor
from tests.model.scenes import STACK
from tests.test_cli import pair_in, phasestack, solve_arguments

SIZE = (STACK.height_px, STACK.width_px)
ANY = ("H", "W")
IN, OUT = ("N", 6, *ANY), ("N", 9, *ANY)


def network(
    path: Path,
    inside: Sequence[Any],
    outside: Sequence[Any],
    *,
    kind: int = TensorProto.FLOAT,
    opset: int = 17,
    ir: int = 8,
    answered: int = 9,
    expected: int = 1,
) -> Path:
    """One that answers with its input's channels, as often as it takes; inside, outside: declared shapes.

    answered, expected: channels that it does answer and that it takes (1: any), which its graph does not declare.
    """
    ports = [helper.make_tensor_value_info(*port) for port in (("eyes", kind, inside), ("panels", kind, outside))]
    nodes = [
        helper.make_node("Add", ["eyes", "bias"], ["moved"]),
        helper.make_node("Concat", ["moved", "moved"], ["twice"], axis=1),
        helper.make_node("Compress", ["twice", "which"], ["panels"], axis=1),
    ]
    held = [
        helper.make_tensor("bias", kind, [1, expected, 1, 1], [0.0] * expected),
        helper.make_tensor("which", TensorProto.BOOL, [answered], [True] * answered),
    ]
    graph = helper.make_graph(nodes, "g", ports[:1], ports[1:], held)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
    model.ir_version = ir
    axes = ["one", "channels", "height", "width"]
    contract = {
        "version": 2, "arch": "mine", "name": "mine", "panels": 3, "eyes": 2, "input_frame": "centre",
        "input_value": "intensity", "layout": "NCHW", "eye_order": "left-right", "output": "panels", "branch": 1,
        "value_range": [0, 1], "trained_for": None, "recipe_sha256": "",
        "inputs": [{"name": "eyes", "axes": axes}], "outputs": [{"name": "panels", "axes": axes}],
    }  # fmt: skip
    model.metadata_props.add(key=METADATA_KEY, value=json.dumps(contract))
    path.write_bytes(model.SerializeToString())
    return path


def loaded(path: Path) -> object:
    return load_predictor(str(path), STACK)


def test_one_that_fits_is_served_whatever_its_axes_are_called(tmp_path: Path) -> None:
    for sides in (SIZE, ANY):
        path = network(tmp_path / "a.onnx", ("N", 6, *sides), ("N", 9, *sides))
        loaded(path)
        assert validate_file(path).passed
    loaded(network(tmp_path / "a.onnx", ("N", "C", *ANY), ("N", "D", *ANY)))


@pytest.mark.parametrize("read", [loaded, validate_file])
@pytest.mark.parametrize(
    ("inside", "outside", "more", "told"),
    [
        (IN, ("N", 6, *ANY), {"answered": 6}, r"outputs\.panels: is N x 6 x H x W, but must be 1 x 9 x"),
        (IN, ("N", "C", *ANY), {"answered": 6}, r"outputs\.panels: is 1 x 6 x .*, but must be 1 x 9 x"),
        (("N", 18, *ANY), OUT, {}, r"inputs\.eyes: is N x 18 x H x W, but must be 1 x 6 x"),
        (("N", "C", *ANY), OUT, {"expected": 18}, r"inputs\.eyes: the graph fails for an input of 1 x 6 x .*18"),
        (IN, OUT, {"kind": TensorProto.FLOAT16}, r"inputs\.eyes: is float16, but must be float32"),
        (
            IN,
            OUT,
            {"opset": 99},
            rf"has opset 99, but onnxruntime {onnxruntime.__version__} supports at most \d+; export the model",
        ),
        (IN, OUT, {"ir": 99}, r"has IR version 99, but onnxruntime .* supports at most \d+; export the model"),
    ],
)
def test_one_that_can_t_run_is_refused_by_its_port(
    tmp_path: Path, read: Callable[[Path], object], inside: Any, outside: Any, more: Any, told: str
) -> None:
    with pytest.raises(InputError, match=rf"a\.onnx: {told}") as refused:
        read(network(tmp_path / "a.onnx", inside, outside, **more))
    line = str(refused.value)
    assert "\n" not in line and "onnxruntime_src" not in line and len(line) < 400


def test_one_made_for_another_size_is_refused_by_its_port(tmp_path: Path) -> None:
    path = network(tmp_path / "a.onnx", (1, 6, 90, 160), (1, 9, 90, 160))
    assert validate_file(path).passed
    with pytest.raises(
        InputError, match=rf"inputs\.eyes: is 1 x 6 x 90 x 160, but must be 1 x 6 x {SIZE[0]} x {SIZE[1]}"
    ):
        loaded(path)


def test_every_command_ends_with_2_and_the_same_line(tmp_path: Path) -> None:
    path = network(tmp_path / "a.onnx", IN, ("N", 6, *ANY), answered=6)
    lines = []
    for arguments in (
        ["validate", str(path)],
        solve_arguments(pair_in(tmp_path), model=path),
        ["run", "--replay", "demo", "--headless", "--max-speed", "--frames", "3", "--model", str(path)],
    ):
        done = phasestack(*arguments)
        assert done.returncode == 2
        lines.append(done.stderr.strip().splitlines()[-1].partition(", but must be")[0])
    assert set(lines) == {f"phasestack: {path}: outputs.panels: is N x 6 x H x W"}
