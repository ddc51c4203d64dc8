"""`status` reports current values, and only measured ones."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import numpy as np
import pytest

from runtime.commands.status_text import status_lines
from runtime.daemon.status import snapshot
from runtime.support.artifacts import to_json
from runtime.support.figures import lines_of
from tests.daemon.rig import Rig


def told_by(rig: Rig) -> tuple[dict, str]:
    """The snapshot as it comes through the socket, and as a person reads it."""
    answer = json.loads(to_json({"ok": True, "pid": 1, "uptime_s": 1.0, **snapshot(rig.presenter.status, rig.run)}))
    return answer, "\n".join(lines_of(answer))


@pytest.fixture
def rig() -> Iterator[Rig]:
    with Rig() as made:
        yield made


def test_eyes_that_are_refused_are_counted_by_reason(rig: Rig) -> None:
    rig.refresh_until("tracking")
    rig.plan.eyes_m = np.array([[-0.7, -0.031, 0.0], [-0.7, 0.031, 0.0]])  # behind the display
    rig.refreshes(100)
    answer, text = told_by(rig)
    refused = {why: count for why, count in answer["rejected_samples"].items() if count}
    assert refused
    for why, count in refused.items():
        assert re.search(rf"^rejected_samples .*{re.escape(why)} {count}", text, re.MULTILINE)


def test_what_was_not_measured_is_no_figure_anywhere(rig: Rig) -> None:
    """Every value that can be None is, as before the first refresh and without a viewer."""
    rig.refreshes(2)
    answer, _ = told_by(rig)
    unmeasured = {
        name: None if value is None or isinstance(value, (int, float, dict, list)) else value
        for name, value in answer.items()
    }
    text = "\n".join(lines_of({**unmeasured, "uptime_s": 1.0, "pid": 7, "provider": None, "model": None}))
    digits = [line for line in text.splitlines() if re.search(r"\d", line) and not line.startswith(("uptime_s", "pid"))]
    assert digits == []


def test_nothing_that_came_through_the_socket_breaks_a_line() -> None:
    lines = list(lines_of({"state": "tracking\nup 3 h", "scene": "\x1b[2Ja\u202eb", "refused": "x" * 10000}))
    assert all(line.isprintable() for line in lines)
    assert all(len(line) <= 2000 for line in lines)


def test_people_are_listed_by_number(rig: Rig) -> None:
    rig.refresh_until("tracking")
    answer, _ = told_by(rig)
    assert [person["number"] for person in answer["people"]] == [1] and answer["people_in_view"] == 1
    assert answer["people"][0]["eyes_m"] == answer["eyes_m"]
    assert any("person 1 served" in line for line in status_lines(answer))
