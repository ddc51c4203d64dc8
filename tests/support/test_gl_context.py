"""Tests errors of the offscreen context where OpenGL is missing."""

from __future__ import annotations

from typing import Any

import moderngl
import pytest

from runtime.errors import MissingPart
from runtime.support import gl


def test_a_missing_context_is_told_from_missing_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(**_: Any) -> None:
        raise Exception("eglInitialize failed (0x3001)")  # as glcontext raises it

    monkeypatch.setattr(moderngl, "create_context", refused)
    with pytest.raises(MissingPart, match=r"libgl1$"):
        gl.offscreen_context()
    monkeypatch.setattr(gl, "DRIVER_BYTES", 1 << 62)
    with pytest.raises(MemoryError, match="too little memory"):
        gl.offscreen_context()
