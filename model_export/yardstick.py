"""Models that the report compares and that are not shipped: the published network untrained, and other precisions.

They are written without `export`'s checks against torch: what they are timed for does not hang on their values.
"""

from __future__ import annotations

from pathlib import Path

SEED = 0
PUBLISHED = (("eyereal", "fp32"), ("eyereal int8", "int8"))


def write_eyereal(path: Path, *, precision: str, width_px: int, height_px: int) -> None:
    """The published network at a fixed size, with random weights. Needs torch and onnx, and some 3 GiB at 1080p."""
    from model_export.export import ExportRequest, eyereal_model
    from runtime.support.artifacts import write_bytes

    request = ExportRequest(
        arch="eyereal",
        out=path,
        random_init=SEED,
        width_px=width_px,
        height_px=height_px,
        precision=precision,
    )
    data, _ = eyereal_model(request)
    write_bytes(path, data)


def write_half(path: Path, *, name: str) -> None:
    """A shipped model in fp16, made from its recipe. Needs torch and onnx."""
    from model_export.export import ExportRequest, spectral_model
    from runtime.support.artifacts import write_bytes

    data, _ = spectral_model(ExportRequest(arch=name, out=path, precision="fp16"))
    write_bytes(path, data)
