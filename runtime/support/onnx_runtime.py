"""Import of onnxruntime with telemetry disabled; nothing else in the runtime imports it."""

from __future__ import annotations

import os
from functools import cache
from typing import Any


@cache
def onnxruntime() -> Any:
    """Import onnxruntime with telemetry disabled, both by environment variable and by function."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime as ort

    ort.disable_telemetry_events()
    return ort
