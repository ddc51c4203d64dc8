"""A model file's weights back into torch, so that a file can be checked without the checkpoint it came from."""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import nn

from model_export.eyereal import EyeRealNet
from model_export.network import SpectralSolver
from runtime.errors import InputError
from runtime.model.contract import Contract


class Weights:
    """Constants of a graph in the order of the nodes that use them, whatever number format they are kept in."""

    def __init__(self, graph: Any) -> None:
        self._graph = graph
        self._stored = {item.name: numpy_helper.to_array(item) for item in graph.initializer}
        self._made = {output: node for node in graph.node for output in node.output}

    def of(self, kinds: set[str]) -> list[list[np.ndarray]]:
        """float32 constants among the inputs of every node of some kinds."""
        found = []
        for node in self._graph.node:
            if node.op_type in kinds:
                parts = [value for value in map(self._constant, node.input) if value is not None]
                if parts:
                    transposed = any(a.name == "transB" and a.i for a in node.attribute)
                    if node.op_type == "MatMul" or (node.op_type == "Gemm" and not transposed):
                        parts[0] = parts[0].T
                    found.append(parts)
        return found

    def held(self, name: str) -> np.ndarray | None:
        """A constant by its name."""
        return self._constant(name)

    def _constant(self, name: str) -> np.ndarray | None:
        if name in self._stored:
            return self._stored[name].astype(np.float32)
        node = self._made.get(name)
        if node is None:
            return None
        if node.op_type == "Constant":
            return numpy_helper.to_array(node.attribute[0].t).astype(np.float32)
        if node.op_type in {"Cast", "Identity"}:
            return self._constant(node.input[0])
        if node.op_type != "DequantizeLinear" or node.input[0] not in self._stored:
            return None
        value, scale = self._stored[node.input[0]], self._stored[node.input[1]]
        zero = self._stored[node.input[2]] if len(node.input) > 2 else np.zeros_like(scale)
        axis = next((a.i for a in node.attribute if a.name == "axis"), 1)
        shape = [1] * value.ndim
        if scale.ndim == 1:
            shape[axis if value.ndim > 1 else 0] = -1
            scale, zero = scale.reshape(shape), zero.reshape(shape)
        real: np.ndarray = ((value.astype(np.float64) - zero) * scale).astype(np.float32)
        return real


def rebuilt(model: onnx.ModelProto, contract: Contract, *, source: str) -> nn.Module:
    """The torch module whose weights a file holds. Raises InputError where its graph is not of that architecture."""
    weights, arch = Weights(model.graph), contract.arch
    try:
        if arch == "spectral":
            return _spectral(weights, contract)
        if arch == "eyereal":
            return _eyereal(weights)
    except (IndexError, ValueError, RuntimeError) as error:
        raise InputError(source, "graph", f"does not hold the weights of {arch} ({str(error)[:120]})") from None
    raise InputError(source, "contract.arch", f"{arch!r} is neither spectral nor eyereal: nothing to check it against")


def _spectral(weights: Weights, contract: Contract) -> nn.Module:
    penalties = weights.held("log_penalty")
    net = SpectralSolver(contract.cell_px, 0 if penalties is None else penalties.size)
    for name, parameter in net.named_parameters():
        if not parameter.numel():
            continue
        value = weights.held(name)
        if value is None or value.shape != tuple(parameter.shape):
            raise ValueError(f"{name} is missing or of another shape")
        parameter.data = torch.from_numpy(value.copy())
    return net.eval()


def _eyereal(weights: Weights) -> nn.Module:
    layers = weights.of({"Conv"})
    net = EyeRealNet(layers[0][0].shape[0])
    # Export folds each batch norm into the convolution before it.
    for module in net.modules():
        if isinstance(module, nn.Sequential):
            for index in range(len(module) - 1):
                conv = module[index]
                if isinstance(conv, nn.Conv2d) and isinstance(module[index + 1], nn.BatchNorm2d):
                    conv.bias = nn.Parameter(torch.zeros(conv.out_channels))
                    module[index + 1] = nn.Identity()
    convolutions = [module for module in net.modules() if isinstance(module, nn.Conv2d)]
    if len(convolutions) != len(layers):
        raise ValueError(f"{len(layers)} convolutions instead of {len(convolutions)}")
    _put(convolutions, layers)
    return net.eval()


def _put(modules: list[Any], layers: list[list[np.ndarray]]) -> None:
    for module, (weight, bias) in zip(modules, layers, strict=True):
        if weight.shape != tuple(module.weight.shape):
            raise ValueError(f"{weight.shape} instead of {tuple(module.weight.shape)}")
        module.weight.data, module.bias.data = torch.from_numpy(weight.copy()), torch.from_numpy(bias.copy())
