"""A checkpoint that is no regular file: refused, never waited for."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from model_export.export import ExportRequest, eyereal_model
from runtime.errors import InputError


def test_a_checkpoint_that_becomes_a_fifo_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is read twice: the weights, and what they are told by."""
    path = tmp_path / "a.pth"
    os.mkfifo(path)
    monkeypatch.setattr("model_export.export.load_eyereal", lambda checkpoint: None)
    with pytest.raises(InputError, match=r"a\.pth: is a FIFO"):
        eyereal_model(ExportRequest(arch="eyereal", out=tmp_path / "a.onnx", checkpoint=path))
