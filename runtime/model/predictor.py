"""Which model a name means, and its loading; what models are is told in `base`."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from runtime.config import ModelSettings
from runtime.errors import InputError
from runtime.model.base import Prediction, Predictor
from runtime.optics.stack import PanelStack
from runtime.support.memory import keep_freed_memory

__all__ = ["SHIPPED", "Prediction", "Predictor", "load_predictor", "model_path"]

SHIPPED = ("fast", "balanced", "best")
SUMS = "SHA256SUMS"  # of the files beside it, as sha256sum writes and checks them


def model_path(name: str) -> Path | None:
    """The file of a shipped model or of a path; None for `sart`. Raises InputError for an unknown name."""
    if name == "sart":
        return None
    if name in SHIPPED:
        return Path(str(resources.files("runtime.model") / "data" / f"{name}.onnx"))
    path = Path(name)
    if path.suffix != ".onnx" and not path.exists():
        raise InputError("model", "name", f"{name!r} is neither {', '.join(SHIPPED)}, sart nor an ONNX file")
    return path


def shipped_sha256(name: str) -> str:
    """What a shipped model's file must be, from the table beside it; empty for another. Raises InputError."""
    if name not in SHIPPED:
        return ""
    table = Path(str(resources.files("runtime.model") / "data" / SUMS))
    try:
        rows = [line.split() for line in table.read_text(encoding="ascii").splitlines()]
        return {file: digest for digest, file in rows}[f"{name}.onnx"]
    except (OSError, ValueError, KeyError):
        raise InputError(table, f"{name}.onnx", "is not listed: install phasestack again") from None


def load_predictor(name: str, stack: PanelStack, settings: ModelSettings | None = None) -> Predictor:
    """The model `name` (shipped name, `sart` or an ONNX file) for a stack.

    A stack that the network was not made for (not three panels, or none that are evenly spaced, to `UNEVEN_MOST`) is
    served by `sart` where a shipped name was asked for; `Predictor.name` says so. Raises InputError, MissingPart.
    """
    keep_freed_memory()
    settings = settings or ModelSettings()
    path = model_path(name)
    if path is None or (name in SHIPPED and not (stack.count == 3 and stack.is_evenly_spaced)):
        from runtime.model.sart import SartPredictor

        return SartPredictor(stack, why="" if path is None else f"instead of {name}: needs three even panels")
    from runtime.model.session import ModelSession

    session = ModelSession(path, provider=settings.provider, threads=settings.threads, sha256=shipped_sha256(name))
    if session.contract.panels != stack.count:
        raise InputError(path, "contract.panels", f"{session.contract.panels}, but the stack has {stack.count}")
    if session.contract.input_frame == "chain":
        if not stack.is_evenly_spaced:
            raise InputError(path, "contract.panels", "needs evenly spaced panels; use the model sart")
        from runtime.model.unrolled import UnrolledPredictor

        return UnrolledPredictor(session, stack, threads=settings.threads)
    from runtime.model.network import NetworkPredictor

    return NetworkPredictor(session, stack, source=path)
