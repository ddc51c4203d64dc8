"""What the commands of calibration can't do: refused, and nothing is left."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from calib.commands import app
from runtime.errors import InputError

WRONG = [
    "charts --out x --config no-such-file.toml",
    "grey --out l.csv --photos none --panel 1",
    "grey --photos . --panel 1",
    "grey --panel 3 --show",
    "grey --panel 1 --out c.png",
    "grey --panel 1",
    "panels",
    "panels --photos .",
    "panels --out r",
    "panels --out r --photos . --show",
    "panels --out r --photos none",
    "panels --out r --photos .",
    "panels --out r --photos . --write",
]


@pytest.mark.parametrize("request_line", WRONG)
def test_wrong_requests_are_refused_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request_line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert isinstance(CliRunner().invoke(app, request_line.split()).exception, InputError)
    assert list(tmp_path.iterdir()) == []
