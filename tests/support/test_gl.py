"""The context without a screen, where it can't be had."""

from __future__ import annotations

import resource
from typing import Any

import moderngl
import pytest

from runtime.errors import MissingPart
from runtime.support import gl


@pytest.mark.parametrize(
    ("most", "told"),
    [(resource.RLIM_INFINITY, r"libgl1$"), (900 << 20, r"or lift the limit of 900 MiB \(ulimit -v\)$")],
)
def test_without_a_context_packages_are_named_and_a_limit_that_may_be_the_cause(
    monkeypatch: pytest.MonkeyPatch, most: int, told: str
) -> None:
    def refused(**_: Any) -> None:
        raise Exception("eglInitialize failed (0x3001)")  # as glcontext raises it

    monkeypatch.setattr(moderngl, "create_context", refused)
    monkeypatch.setattr(gl.resource, "getrlimit", lambda kind: (most, most))
    with pytest.raises(MissingPart, match=told):
        gl.offscreen_context()
