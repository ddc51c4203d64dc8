"""Check that a model file meets the runtime's requirements and gives correct results.

On export, the results are compared with the torch module's. An existing file's results are compared with those of the
same graph run without onnxruntime's optimisations, so every file that the runtime accepts can be checked.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime

from model_export.stress import ORDINARY, Feeds, picture_cases, spectral_cases
from runtime.errors import InputError, one_line
from runtime.kernels import FULL
from runtime.model.contract import VERSION, Contract, parse_contract
from runtime.model.network import PictureProposal
from runtime.model.session import FILE_BYTES_MAX, ModelSession
from runtime.optics.stack import PanelStack
from runtime.support import untrusted_input
from runtime.support.progress import tracked

LIMIT = 0.25 / 255  # maximum difference between panel values: a quarter of an 8-bit level
SMALL = (96, 160)  # height and width of the test pictures for a model without a fixed size


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check, with a description of the finding and the requirement."""

    name: str
    found: str
    wanted: str
    passed: bool


@dataclass(frozen=True, slots=True)
class Report:
    """The results of all checks on a model file, available as text or JSON."""

    file: str
    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        return all(check.passed for check in self.checks)

    def json(self) -> str:
        """Return the report as a JSON object."""
        return json.dumps({"file": self.file, "passed": self.passed, "checks": [asdict(c) for c in self.checks]})

    def table(self) -> str:
        """Return a readable table of the checks, each with its result and requirement."""
        rows = [f"{'ok' if c.passed else 'FAILED':8}{c.name}: {c.found}; expected: {c.wanted}" for c in self.checks]
        failed = sum(not check.passed for check in self.checks)
        end = f"{failed} of {len(self.checks)} checks failed" if failed else f"all {len(self.checks)} checks passed"
        return "\n".join([self.file, *rows, end])


Reference = Callable[[Feeds], Sequence[np.ndarray]]


def validate_file(path: Path) -> Report:
    """Check a model file. Raises InputError if the runtime would refuse to load the file."""
    session = ModelSession(path)
    contract = session.contract
    if contract.input_frame != "chain":
        height, width = _size(session.input_shapes.get(contract.inputs[0].name, ()), contract)
        x_m = tuple(0.01 * n for n in range(contract.panels))
        PictureProposal(session, PanelStack(width / 1000, height / 1000, x_m, width, height), source=path)
    return check_model(untrusted_input.read_bytes(path, most_bytes=FILE_BYTES_MAX), source=str(path))


def check_model(data: bytes, *, source: str, reference: Reference | None = None) -> Report:
    """Check a model's results against a reference, such as the torch module, by default the unoptimised
    graph. Raises InputError if the bytes are not an ONNX model, or the model has no valid contract.
    """
    try:
        model = onnx.load_from_string(data)
        onnx.checker.check_model(model)
    except Exception as error:  # errors from protobuf and onnx
        raise InputError(source, "", f"is not an ONNX model: {_said(error)}") from None
    contract = parse_contract({item.key: item.value for item in model.metadata_props}, source=source)
    checks = [Check("contract", f"{contract.arch} {contract.name}", f"version {VERSION}", True)]
    try:
        session = _session(data, optimised=True)
    except Exception as error:  # onnxruntime's own hierarchy
        return Report(source, (*checks, Check("onnxruntime loads it", _said(error), "a session", False)))
    checks += _ports(session, contract)
    if not all(check.passed for check in checks):
        return Report(source, tuple(checks))
    plain = reference or _run(_session(data, optimised=False))
    height, width = _size(session.get_inputs()[0].shape, contract)
    chain = contract.input_frame == "chain"
    cases = spectral_cases(contract.cell_px) if chain else picture_cases(contract, height, width)
    run = _run(session)
    checks += [_compared(name, run, plain, feeds) for name, feeds in tracked(f"checking {source}", list(cases.items()))]
    return Report(source, tuple(checks))


def _size(shape: Sequence[Any], contract: Contract) -> tuple[int, int]:
    """Return the test pictures' height and width, from the graph or the contract, or else `SMALL`."""
    graph, given = (*shape[2:], None, None)[:2], (contract.height_px, contract.width_px)
    found = [g if isinstance(g, int) else c or s for g, c, s in zip(graph, given, SMALL, strict=True)]
    return found[0], found[1]


def _session(data: bytes, *, optimised: bool) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 2, 3
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # two sessions and torch take turns
    levels = onnxruntime.GraphOptimizationLevel
    options.graph_optimization_level = levels.ORT_ENABLE_ALL if optimised else levels.ORT_DISABLE_ALL
    return onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])


def _run(session: onnxruntime.InferenceSession) -> Reference:
    return lambda feeds: session.run(None, feeds)


def _ports(session: onnxruntime.InferenceSession, contract: Contract) -> list[Check]:
    """Check that the names and ranks of the graph's inputs and outputs agree with the contract."""
    checks = []
    for what, items, ports in (
        ("inputs", session.get_inputs(), contract.inputs),
        ("outputs", session.get_outputs(), contract.outputs),
    ):
        found = " ".join(f"{item.name}[{len(item.shape)}]" for item in items)
        wanted = " ".join(f"{port.name}[{len(port.axes)}]" for port in ports)
        checks.append(Check(what, found, wanted, found == wanted))
    return checks


def _panels(answer: Sequence[np.ndarray]) -> np.ndarray:
    """Return a model's outputs as a vector of panel values, or as a single NaN if a scalar output is not finite.
    Integer outputs are in sixteenths of an 8-bit level.
    """
    if any(part.size == 1 and not np.isfinite(part).all() for part in answer):
        return np.full(1, np.nan, np.float32)
    scale = [1.0 if np.issubdtype(part.dtype, np.floating) else FULL for part in answer]
    return np.concatenate(
        [(p / s).astype(np.float32).ravel() for p, s in zip(answer, scale, strict=True) if p.size > 1]
    )


def _compared(name: str, run: Reference, reference: Reference, feeds: Feeds) -> Check:
    """Run one input through both models, and check the shape, the values and the largest difference."""
    name = f"{'values' if name.startswith(ORDINARY) else 'drift'}, {name}"
    try:
        found = _panels(run(feeds))
    except Exception as error:  # onnxruntime's own hierarchy
        return Check(name, _said(error), "an answer", False)
    wanted = _panels(reference(feeds))
    if found.shape != wanted.shape:
        return Check(name, f"shape {found.shape}", f"shape {wanted.shape}", False)
    if not np.isfinite(found).all():
        return Check(name, "not finite", "finite", False)
    value = float(np.abs(found - wanted).max())
    limit = f"at most {LIMIT * 255:.3g}"
    return Check(name, f"largest {value * 255:.3g} codes off the reference", limit, value <= LIMIT)


def _said(error: Exception) -> str:
    return one_line(str(error), most=120)
