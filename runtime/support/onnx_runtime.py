"""onnxruntime, and nothing sent home: the only place of the runtime that imports it."""

from __future__ import annotations

import os
from functools import cache
from typing import Any


@cache
def onnxruntime() -> Any:
    """The onnxruntime module, with telemetry off by environment and by its own switch."""
    os.environ["ORT_DISABLE_TELEMETRY"] = "1"
    import onnxruntime as ort

    ort.disable_telemetry_events()
    return ort
