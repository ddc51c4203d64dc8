"""Tests errors of the offscreen context where OpenGL is missing."""

from __future__ import annotations

from typing import Any

import moderngl
import pytest

from runtime.errors import MissingPart
from runtime.support import gl


def test_without_a_context_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(**_: Any) -> None:
        raise Exception("eglInitialize failed (0x3001)")  # as glcontext raises it

    monkeypatch.setattr(moderngl, "create_context", refused)
    with pytest.raises(MissingPart, match=r"libgl1$"):
        gl.offscreen_context()


def test_a_driver_without_memory_is_not_taken_for_a_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(**_: Any) -> None:
        raise Exception("eglInitialize failed (0x3001)")

    monkeypatch.setattr(moderngl, "create_context", refused)
    monkeypatch.setattr(gl, "DRIVER_BYTES", 1 << 62)
    with pytest.raises(MemoryError, match="too little memory"):
        gl.offscreen_context()
