"""The published network, untrained, for the report to time: written without `export`'s checks of its values."""

from __future__ import annotations

from pathlib import Path

SEED = 0


def write_eyereal(path: Path, *, width_px: int, height_px: int) -> None:
    """The published network at a fixed size, with random weights. Needs torch and onnx, and some 3 GiB at 1080p."""
    from model_export.export import ExportRequest, eyereal_model
    from runtime.support.artifacts import write_bytes

    request = ExportRequest(
        arch="eyereal",
        out=path,
        random_init=SEED,
        width_px=width_px,
        height_px=height_px,
    )
    data, _ = eyereal_model(request)
    write_bytes(path, data)
