"""Checks of a model file: contract, names, shapes, then values against torch, and drift on stress inputs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import torch
from torch import nn

from model_export import eyereal, network
from model_export.onnx_files import Feeds
from model_export.rebuild import rebuilt
from model_export.stress import ORDINARY, eyereal_cases, spectral_cases
from runtime.errors import InputError
from runtime.model.contract import VERSION, Contract, parse_contract
from runtime.model.transfer import FULL
from runtime.support import foreign

FILE_BYTES_MAX = 4 << 30

OPSETS = range(17, 21)
# Largest difference from torch in panel values: a quarter, two and ten codes of 8 bits; int8 is judged by its mean.
LIMITS = {"fp32": 0.25 / 255, "fp16": 2 / 255, "int8": 10 / 255}
SMALL = (96, 160)  # pictures for a model that takes any size


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the table."""

    name: str
    found: str
    wanted: str
    passed: bool


@dataclass(frozen=True, slots=True)
class Report:
    """Every check of one file."""

    file: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        return all(check.passed for check in self.checks)

    def json(self) -> str:
        """One object."""
        return json.dumps({"file": self.file, "passed": self.passed, "checks": [asdict(c) for c in self.checks]})

    def table(self) -> str:
        """For a person: what was checked, found, wanted."""
        rows = [("check", "found", "wanted", "")]
        rows += [(c.name, c.found, c.wanted, "ok" if c.passed else "FAILED") for c in self.checks]
        widths = [max(len(row[column]) for row in rows) for column in range(3)]
        lines = ["  ".join([*(x.ljust(w) for x, w in zip(row, widths, strict=False)), row[3]]).rstrip() for row in rows]
        failed = sum(not check.passed for check in self.checks)
        end = f"{failed} of {len(self.checks)} checks failed" if failed else f"all {len(self.checks)} checks passed"
        return "\n".join([self.file, *lines, end])


def validate_file(path: Path) -> Report:
    """Checks of a file against the torch module that its own weights make. Raises InputError: no model of ours."""
    data = foreign.read_bytes(path, most_bytes=FILE_BYTES_MAX)
    return check_model(data, source=str(path))


def check_model(data: bytes, *, source: str, reference: nn.Module | None = None) -> Report:
    """Checks of a model's bytes, against a torch module or, without one, against its own weights in torch.

    Raises InputError where the bytes are no ONNX model or carry no contract that we know.
    """
    try:
        model = onnx.load_from_string(data)
        onnx.checker.check_model(model)
    except Exception as error:  # protobuf and onnx raise their own
        raise InputError(source, "", f"is no ONNX model ({(str(error).splitlines() or [''])[0][:120]})") from None
    contract = parse_contract({item.key: item.value for item in model.metadata_props}, source=source)
    opset = next((item.version for item in model.opset_import if item.domain in ("", "ai.onnx")), 0)
    checks = [
        Check("contract", f"{contract.arch} {contract.name} {contract.precision}", f"version {VERSION}", True),
        Check("opset", str(opset), f"{OPSETS[0]} to {OPSETS[-1]}", opset in OPSETS),
    ]
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 2, 3
    try:
        session = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own hierarchy
        problem = (str(error).splitlines() or [""])[0][:120]
        return Report(source, (*checks, Check("onnxruntime loads it", problem, "a session", False)))
    named = _names(session, contract)
    checks += named
    if not all(check.passed for check in named):
        return Report(source, tuple(checks))
    torch_module = reference if reference is not None else rebuilt(model, contract, source=source)
    limit = LIMITS[contract.precision]
    for name, feeds in _cases(session, contract).items():
        checks.append(_compared(name, session, torch_module, feeds, limit, contract))
    return Report(source, tuple(checks))


def _panels(answer: Any) -> np.ndarray:
    """What a module or a session answers, as panel values in one row: two panels in codes, or one tensor of values."""
    if isinstance(answer, torch.Tensor):
        answer = [answer]
    if any(x.numel() == 1 and not torch.isfinite(x).all() for x in answer):
        return np.full(1, np.nan, np.float32)
    panels = [x.to(torch.float32) / (1.0 if x.is_floating_point() else FULL) for x in answer if x.numel() > 1]
    return torch.cat([x.reshape(-1) for x in panels]).numpy()


def _names(session: onnxruntime.InferenceSession, contract: Contract) -> list[Check]:
    chain = contract.input_frame == "chain"
    wanted_in = network.INPUTS if chain else (eyereal.INPUT,)
    wanted_out = network.OUTPUTS if chain else (eyereal.OUTPUT,)
    checks = []
    for what, items, wanted in (
        ("inputs", session.get_inputs(), wanted_in),
        ("outputs", session.get_outputs(), wanted_out),
    ):
        found = tuple(item.name for item in items)
        checks.append(Check(what, " ".join(found), " ".join(wanted), found == tuple(wanted)))
        types = sorted({item.type for item in items})
        some = ["tensor(float)", "tensor(int16)"] if chain else ["tensor(float)"]
        checks.append(Check(f"type of {what}", " ".join(types), " ".join(some), types == some))
    ranks = [len(item.shape) for item in session.get_inputs()]
    if chain:
        checks.append(Check("input dimensions", str(ranks), "[3, 3, 2, 2, 1, 2, 1]", ranks == [3, 3, 2, 2, 1, 2, 1]))
        return checks
    shape = session.get_inputs()[0].shape
    fixed = [1, 18, contract.height_px or "any", contract.width_px or "any"]
    same = len(shape) == 4 and all(
        (b == "any" and isinstance(a, str)) or a == b for a, b in zip(shape, fixed, strict=True)
    )
    return [*checks, Check("input shape", str(shape), str(fixed), same)]


def _cases(session: onnxruntime.InferenceSession, contract: Contract) -> dict[str, Feeds]:
    if contract.input_frame == "chain":
        return spectral_cases(contract.cell_px)
    height, width = (contract.height_px or SMALL[0]), (contract.width_px or SMALL[1])
    return eyereal_cases(height, width)


def _compared(
    name: str,
    session: onnxruntime.InferenceSession,
    module: nn.Module,
    feeds: Feeds,
    limit: float,
    contract: Contract,
) -> Check:
    """One input through both: shape, finite, and how far apart."""
    kind = "values" if name.startswith(ORDINARY) else "drift"
    with torch.no_grad():
        wanted = _panels(module(*(torch.from_numpy(value) for value in feeds.values())))
    try:
        found = _panels([torch.from_numpy(x) for x in session.run(None, feeds)])
    except Exception as error:  # onnxruntime's own hierarchy
        return Check(f"{kind}, {name}", (str(error).splitlines() or [""])[0][:80], "an answer", False)
    if found.shape != wanted.shape:
        return Check(f"{kind}, {name}", f"shape {found.shape}", f"shape {wanted.shape}", False)
    if not np.isfinite(found).all():
        return Check(f"{kind}, {name}", "not finite", "finite", False)
    difference = np.abs(found - wanted)
    measure: Callable[[np.ndarray], np.floating] = np.mean if contract.precision == "int8" else np.max
    value = float(measure(difference))
    which = "mean" if contract.precision == "int8" else "largest"
    return Check(
        f"{kind}, {name}", f"{which} {value * 255:.3g} codes off torch", f"at most {limit * 255:.3g}", value <= limit
    )
