"""An onnxruntime session whose buffers are bound once."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import InputError, MissingPart, ModelFailure
from runtime.model.contract import Contract, parse_contract

log = logging.getLogger("phasestack.model")

PROVIDERS = {
    "cpu": ("CPUExecutionProvider", "onnxruntime"),
    "cuda": ("CUDAExecutionProvider", "onnxruntime-gpu"),
    "tensorrt": ("TensorrtExecutionProvider", "onnxruntime-gpu and TensorRT"),
    "openvino": ("OpenVINOExecutionProvider", "onnxruntime-openvino"),
}


class ModelSession:
    """One loaded model. `run` binds a set of buffers for each input shape once and reuses it."""

    def __init__(self, path: Path, *, provider: str = "cpu", threads: int = 2) -> None:
        """Raises InputError (no ONNX, no contract), MissingPart (provider not installed)."""
        import onnxruntime as ort

        name, package = PROVIDERS[provider]
        if name not in ort.get_available_providers():
            raise MissingPart(f"model.provider: {provider} is not installed: pip install {package}")
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        # A spinning pool eats the cores that the camera and the renderer need.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        try:
            data = path.read_bytes()
        except OSError as error:
            raise InputError(path, "", f"cannot be read ({error.strerror})") from None
        try:
            self._session = ort.InferenceSession(data, options, providers=[name])
        except Exception as error:  # onnxruntime raises its own hierarchy of undocumented exceptions
            raise InputError(path, "", f"is no model that onnxruntime can load ({_first_line(error)})") from None
        self.provider: str = provider
        self.contract: Contract = parse_contract(self._session.get_modelmeta().custom_metadata_map, source=path)
        self.input_names = [item.name for item in self._session.get_inputs()]
        self.output_names = [item.name for item in self._session.get_outputs()]
        self.input_shapes = [item.shape for item in self._session.get_inputs()]
        self._bound: dict[tuple[tuple[int, ...], ...], tuple[Any, list[Any], list[Any]]] = {}

    def run(self, *inputs: NDArray[Any], output_shape: tuple[int, ...]) -> NDArray[np.float32]:
        """The only output. It is the session's own buffer: it holds until the next run of the same shapes.

        Raises ModelFailure where onnxruntime fails.
        """
        import onnxruntime as ort

        key = (*(array.shape for array in inputs), output_shape)
        try:
            if key not in self._bound:
                values = [ort.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(array)) for array in inputs]
                result = ort.OrtValue.ortvalue_from_shape_and_type(output_shape, np.float32)
                binding = self._session.io_binding()
                for name, value in zip(self.input_names, values, strict=True):
                    binding.bind_ortvalue_input(name, value)
                binding.bind_ortvalue_output(self.output_names[0], result)
                if len(self._bound) > 8:  # a viewer who walks about meets a few shapes, not hundreds
                    self._bound.clear()
                self._bound[key] = (binding, values, [result])
            binding, values, results = self._bound[key]
            for value, array in zip(values, inputs, strict=True):
                value.update_inplace(np.ascontiguousarray(array))
            self._session.run_with_iobinding(binding)
            output: NDArray[np.float32] = results[0].numpy()
        except Exception as error:
            raise ModelFailure(f"inference failed: {_first_line(error)}") from error
        return output


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
