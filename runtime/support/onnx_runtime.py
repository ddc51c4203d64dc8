"""Import ONNX Runtime with telemetry disabled. No other module in `runtime` imports onnxruntime."""

from __future__ import annotations

import os
from functools import cache
from typing import Any


@cache
def onnxruntime() -> Any:
    """Import onnxruntime with telemetry disabled, by environment variable and by function call."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime as ort

    ort.disable_telemetry_events()
    return ort
