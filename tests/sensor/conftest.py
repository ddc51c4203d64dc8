"""Fixtures for tests of sensors."""

from __future__ import annotations

import pytest


@pytest.fixture(autouse=True)
def quick_to_reopen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reopen a lost sensor immediately."""
    monkeypatch.setattr("runtime.sensor.polling.REOPEN_AFTER_S", 0.02)
    monkeypatch.setattr("runtime.sensor.polling.REOPEN_AFTER_MAX_S", 0.1)
