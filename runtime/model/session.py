"""Load models, check them, and run them in onnxruntime using buffers that are bound only once."""

from __future__ import annotations

import hashlib
import logging
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError, MissingPart, ModelFailure
from runtime.model.contract import Contract, parse_contract
from runtime.model.onnx_bytes import digest, has_external_data
from runtime.support import untrusted_input
from runtime.support.child import in_child
from runtime.support.onnx_runtime import onnxruntime
from runtime.support.untrusted_input import LIMITS

FILE_BYTES_MAX = 1 << 30
MEMORY_MAX = 1 << 30  # memory limit in bytes for loading an untrusted file, on top of 8 times its size

log = logging.getLogger("phasestack.model")

PROVIDERS = {
    "cpu": ("CPUExecutionProvider", "onnxruntime"),
    "cuda": ("CUDAExecutionProvider", "onnxruntime-gpu"),
    "tensorrt": ("TensorrtExecutionProvider", "onnxruntime-gpu and TensorRT"),
    "openvino": ("OpenVINOExecutionProvider", "onnxruntime-openvino"),
}
RECORD_NODES = "session.record_ep_graph_assignment_info"
NODES_LOGGED = 5
TYPES = {"tensor(float)": np.float32, "tensor(int16)": np.int16}
NEWER_OPSET = re.compile(r"(Opset) (\d+) is under development.*till opset (\d+)")
NEWER_IR = re.compile(r"(IR version): (\d+), max supported IR version: (\d+)")
ERROR_KIND = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ")
SOURCE_PLACE = re.compile(r"/\S+\.(cc|h|cpp):\d+ .*\) ")  # reference to onnxruntime's source code within a message
Shape = tuple[int, ...]


class ModelSession:
    """A loaded model. `run` binds buffers once for each combination of shapes and then reuses them."""

    def __init__(self, path: Path, *, provider: str = "cpu", threads: int = 2, sha256: str = "") -> None:
        """Load a model and check it; a file whose digest `sha256` is not known is first loaded in a child process.
        Raises InputError if it is not a loadable ONNX model, its digest is wrong, or its contract is missing or does
        not fit, and MissingPart if the provider (of `PROVIDERS`) does not work.
        """
        ort = onnxruntime()
        name, package = PROVIDERS[provider]
        if name not in ort.get_available_providers():
            raise MissingPart(f"model.provider: {provider} is not installed; run: pip install {package}")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        # If the pool's threads were spinning, they would take cores from the camera and the renderer.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        options.add_session_config_entry(RECORD_NODES, "1")
        data = _checked(path, sha256)
        if not sha256:
            _try_out(path, data)
        self._session = _opened(path, data, options, name)
        try:
            metadata = self._session.get_modelmeta().custom_metadata_map
        except UnicodeDecodeError:
            raise InputError(path, "metadata", "is not valid UTF-8") from None
        if name not in self._session.get_providers():  # onnxruntime only prints a message and uses another one
            problem = f"is installed but does not start; check {package} and its driver"
            raise MissingPart(f"model.provider: {provider} {problem}")
        self.provider: str = provider
        self.fell_back = nodes_elsewhere(self._session, name)  # graph nodes that run on another provider
        if count := len(self.fell_back):
            names = ", ".join((*self.fell_back[:NODES_LOGGED], *(["..."] if count > NODES_LOGGED else [])))
            log.warning(
                "the provider %s left %d node%s to another provider: %s", provider, count, "s" * (count != 1), names
            )
        self.contract: Contract = parse_contract(metadata, source=path)
        if self.contract.graph_sha256 and self.contract.graph_sha256 != digest(data):
            raise InputError(
                path, "contract.graph_sha256", "does not match because the file was changed after it was exported"
            )
        self.input_shapes = {item.name: item.shape for item in self._session.get_inputs()}
        self._types = {item.name: TYPES.get(item.type, np.float32) for item in self._session.get_outputs()}
        self._check_ports(path)
        self._bound: dict[tuple[Any, ...], tuple[Any, dict[str, Any], dict[str, Any]]] = {}

    def run(self, feeds: Mapping[str, NDArray[Any]], shapes: Mapping[str, Shape]) -> dict[str, NDArray[Any]]:
        """Run the model on inputs by name, and return outputs of these shapes, valid until the next run with
        the same. Raises ModelFailure if onnxruntime failed.
        """
        key = (*((name, array.shape) for name, array in feeds.items()), *shapes.items())
        try:
            if key not in self._bound:
                if len(self._bound) > 8:  # a walking viewer causes only a few different shapes
                    self._bound.clear()
                self._bound[key] = self._bind(feeds, shapes)
            binding, values, results = self._bound[key]
            for name, array in feeds.items():
                values[name].update_inplace(np.ascontiguousarray(array))
            self._session.run_with_iobinding(binding)
            return {name: value.numpy() for name, value in results.items()}
        except Exception as error:
            raise ModelFailure(f"inference failed: {_first_line(error)}") from error

    def _bind(self, feeds: Mapping[str, NDArray[Any]], shapes: Mapping[str, Shape]) -> Any:
        value_of = onnxruntime().OrtValue
        values = {name: value_of.ortvalue_from_numpy(np.ascontiguousarray(array)) for name, array in feeds.items()}
        results = {
            name: value_of.ortvalue_from_shape_and_type(shape, self._types[name]) for name, shape in shapes.items()
        }
        binding = self._session.io_binding()
        for name, value in values.items():
            binding.bind_ortvalue_input(name, value)
        for name, value in results.items():
            binding.bind_ortvalue_output(name, value)
        return binding, values, results

    def _check_ports(self, path: Path) -> None:
        """Raise InputError if the graph's ports differ from the contract's or have an unsupported type."""
        for field, ports, items in (
            ("inputs", self.contract.inputs, self._session.get_inputs()),
            ("outputs", self.contract.outputs, self._session.get_outputs()),
        ):
            declared = {port.name: len(port.axes) for port in ports}
            actual = {item.name: len(item.shape) for item in items}
            if declared != actual:
                raise InputError(
                    path, f"contract.{field}", f"declares {_named(declared)}, but the graph has {_named(actual)}"
                )
            for item in items:
                if item.type not in TYPES:
                    kind = item.type.removeprefix("tensor(").removesuffix(")")
                    problem = f"is {kind}, but must be float32 (only tensors inside the graph may have lower precision)"
                    raise InputError(path, f"{field}.{item.name}", problem)

    def check_fits(self, source: Path, feeds: Mapping[str, Shape], answers: Mapping[str, Shape]) -> None:
        """Check the shapes of the graph's inputs and outputs by name, if need be by running it. Raises
        InputError if one differs, or the model does not run with these shapes.
        """
        is_open = False
        for field, items, shapes in (
            ("inputs", self._session.get_inputs(), feeds),
            ("outputs", self._session.get_outputs(), answers),
        ):
            if len(items) != len(shapes):
                raise InputError(
                    source, field, f"are {_list(item.name for item in items)}, but must be {_list(shapes)}"
                )
            for item in items:
                sizes, expected = item.shape, shapes[item.name]
                fits = [size == want for size, want in zip(sizes, expected, strict=False) if isinstance(size, int)]
                if len(sizes) != len(expected) or not all(fits):
                    raise InputError(
                        source, f"{field}.{item.name}", f"is {_sizes(sizes)}, but must be {_sizes(expected)}"
                    )
                is_open |= len(fits) < len(sizes)
        if not is_open:
            return
        try:
            zeros = {name: np.zeros(shape, np.float32) for name, shape in feeds.items()}
            got = dict(zip(answers, self._session.run(list(answers), zeros), strict=True))
        except Exception as error:  # onnxruntime's own hierarchy
            name, shape = next(iter(feeds.items()))
            raise InputError(
                source, f"inputs.{name}", f"the graph fails for an input of {_sizes(shape)}: {_first_line(error)}"
            ) from None
        for name, shape in answers.items():
            if got[name].shape != shape:
                raise InputError(
                    source, f"outputs.{name}", f"is {_sizes(got[name].shape)}, but must be {_sizes(shape)}"
                )


def nodes_elsewhere(session: Any, provider: str) -> tuple[str, ...]:
    """Return the names, or else operators, of graph nodes that do not run on the requested provider. The
    session needs the option `RECORD_NODES`. Only nodes left after basic optimizations count.
    """
    return tuple(
        node.name or node.op_type
        for part in session.get_provider_graph_assignment_info()
        if part.ep_name != provider
        for node in part.get_nodes()
    )


def _checked(path: Path, sha256: str) -> bytes:
    data = untrusted_input.read_bytes(path, most_bytes=FILE_BYTES_MAX)
    if sha256 and hashlib.sha256(data).hexdigest() != sha256:
        raise InputError(path, "", "is not the shipped model (its SHA-256 differs); reinstall phasestack")
    try:
        external = has_external_data(data)
    except ValueError as error:
        raise InputError(path, "", f"is not an ONNX model: {error}") from None
    if external:
        way_out = "combine them with onnx.save(onnx.load(NAME), OTHER_NAME)"
        raise InputError(
            path, "external_data", f"is not supported because the weights must be in the model file; {way_out}"
        )
    return data


def _opened(path: Path, data: bytes, options: Any, provider: str) -> Any:
    try:
        return onnxruntime().InferenceSession(data, options, providers=[provider])
    except Exception as error:  # onnxruntime has its own hierarchy of undocumented exceptions
        if "bad_alloc" in str(error):
            raise MemoryError from error
        raise InputError(path, "", _why_not_loaded(error)) from None


_tried_out: set[bytes] = set()  # digests of the files that have been loaded within the limits


def _try_out(path: Path, data: bytes) -> None:
    """Load a file once in a child process. Raises InputError if this exceeds limits on memory and time. Limits are
    necessary because, as a model is loaded, a few bytes of constants can expand and fill all memory.
    """
    checksum = hashlib.sha256(data).digest()
    if checksum not in _tried_out:
        memory_bytes = MEMORY_MAX + 8 * len(data)
        in_child(_tried_here, path, data, source=path, seconds=LIMITS.load_s, memory_bytes=memory_bytes)
        _tried_out.add(checksum)


def _tried_here(path: Path, data: bytes) -> None:
    options = onnxruntime().SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    _opened(path, data, options, "CPUExecutionProvider")


def _why_not_loaded(error: Exception) -> str:
    """Return why onnxruntime failed to load a model; if it is too new, its version and the newest supported."""
    text = str(error)
    for found in (NEWER_OPSET.search(text), NEWER_IR.search(text)):
        if found:
            what, version, most = found.groups()
            runtime = f"onnxruntime {onnxruntime().__version__}"
            remedy = f"export the model with at most {most}, or install a newer onnxruntime"
            return f"has {what.replace('Opset', 'opset')} {version}, but {runtime} supports at most {most}; {remedy}"
    if found := re.search(r"No Op registered for (\S+)", text):
        return f"contains the operator {found[1]}, which onnxruntime does not support"
    return f"cannot be loaded by onnxruntime: {_first_line(error)}"


def _list(names: Iterable[str]) -> str:
    return ", ".join(names)


def _sizes(shape: Sequence[Any]) -> str:
    return " x ".join(str(size) for size in shape)


def _named(ranks: Mapping[str, int]) -> str:
    return ", ".join(f"{name} ({rank} axes)" for name, rank in ranks.items())


def _first_line(error: Exception) -> str:
    line = (str(error).strip().splitlines() or [type(error).__name__])[0]
    return SOURCE_PLACE.sub("", ERROR_KIND.sub("", line))[:200]
