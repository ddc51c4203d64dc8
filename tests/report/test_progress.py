"""Long commands tell where they are: a bar on a terminal, a line now and then in a log."""

from __future__ import annotations

import pytest

from runtime.report.progress import tracked
from runtime.support import progress


def test_off_a_terminal_work_over_items_tells_how_many_are_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seen: `calibrate panels photo-trial` was silent for half an hour in a log."""
    monkeypatch.setattr(progress.NowAndThen.__init__, "__kwdefaults__", {"every_s": 0.0})
    assert list(tracked("stacks", ["a", "b"])) == ["a", "b"]
    captured = capsys.readouterr()
    assert [line.partition(" ")[2] for line in captured.err.splitlines()] == ["stacks: 1 of 2", "stacks: 2 of 2"]
    assert captured.out == ""
