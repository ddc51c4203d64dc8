"""Find and load models by name. All models implement `runtime.model.base.Predictor`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from runtime.config import ModelSettings
from runtime.errors import InputError, MissingPart
from runtime.kernels import library
from runtime.model.base import Prediction, Predictor
from runtime.optics.stack import PanelStack
from runtime.support.memory import keep_freed_memory

__all__ = ["SHIPPED", "Prediction", "Predictor", "load_predictor", "model_path"]

SHIPPED = ("fast", "balanced", "best")
SUMS = "SHA256SUMS"  # file with the shipped models' digests, in sha256sum format


def model_path(name: str) -> Path | None:
    """Return a model's file, or None for `sart`. Raises InputError for an unknown name or no ONNX file."""
    if name == "sart":
        return None
    if name in SHIPPED:
        return Path(str(resources.files("runtime.model") / "data" / f"{name}.onnx"))
    path = Path(name)
    if path.suffix != ".onnx" and not path.exists():
        raise InputError("model", "name", f"{name!r} is not a model; use {', '.join(SHIPPED)}, sart or an ONNX file")
    return path


def shipped_sha256(name: str) -> str:
    """Return the SHA-256 of a shipped model's file, "" for others. Raises InputError if unlisted."""
    if name not in SHIPPED:
        return ""
    table = Path(str(resources.files("runtime.model") / "data" / SUMS))
    try:
        rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()]
        return {file: digest for digest, file in rows}[f"{name}.onnx"]
    except (OSError, ValueError, KeyError):
        raise InputError(table, f"{name}.onnx", "is not listed; reinstall phasestack") from None


def load_predictor(name: str, stack: PanelStack, settings: ModelSettings | None = None) -> Predictor:
    """Load a model, by the name of a shipped one, `sart`, or the path of an ONNX file, for a stack.

    Shipped networks need three panels with gaps that are equal to within `UNEVEN_MOST`. For other stacks, the network
    is not used: steps start from panels at the rest value, and `Predictor.name` says so. Raises InputError if the model
    is unknown, not valid or does not support the stack, and MissingPart if the kernels or the provider do not work.
    """
    keep_freed_memory()
    try:
        library()
    except ImportError as error:  # report the problem now rather than at the first picture
        raise MissingPart(str(error)) from None
    settings = settings or ModelSettings()
    path = model_path(name)
    if path is None:
        from runtime.model.sart import SartPredictor

        return SartPredictor(stack)
    from runtime.model.network import PictureProposal
    from runtime.model.proposal import INPUTS, ChainProposal
    from runtime.model.session import ModelSession
    from runtime.model.solver import StepPredictor, steps_from_even

    session = ModelSession(path, provider=settings.provider, threads=settings.threads, sha256=shipped_sha256(name))
    contract = session.contract
    if name in SHIPPED and not (stack.count == 3 and stack.is_evenly_spaced):
        title = f"{name} (without its network: needs three even panels)"
        return StepPredictor(stack, None, steps_from_even(len(contract.steps)), name=title, threads=settings.threads)
    if contract.panels != stack.count:
        raise InputError(
            path, "contract.panels", f"is {contract.panels}, but the stack has {stack.count} panels; use the model sart"
        )
    if contract.input_frame == "chain":
        if not stack.is_evenly_spaced:
            raise InputError(path, "contract.panels", "the model requires evenly spaced panels; use the model sart")
        if tuple(port.name for port in contract.inputs) != INPUTS:
            raise InputError(path, "contract.inputs", f"are not {', '.join(INPUTS)}; export the model again")
        return StepPredictor(
            stack, ChainProposal(session), contract.steps, name=contract.name, threads=settings.threads
        )
    pictures = PictureProposal(session, stack, source=path)
    return StepPredictor(stack, pictures, contract.steps, name=contract.name, threads=settings.threads)
