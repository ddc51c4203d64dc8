"""Fixtures with small real content and a small real model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.registry import open_content
from runtime.model.predictor import Predictor, load_predictor
from runtime.optics.stack import PanelStack
from runtime.support.gl import offscreen_context

SMALL = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 192, 108)


@pytest.fixture(scope="session")
def shared_context() -> Any:
    return offscreen_context()


@pytest.fixture
def content(shared_context: Any) -> Iterator[ContentSource]:
    """A few things that stand still."""
    with shared_context:
        source = open_content(ContentSettings(scene="sparse"), SMALL, shared_context)
        yield source
        source.close()


@pytest.fixture(scope="session")
def predictor() -> Iterator[Predictor]:
    made = load_predictor("fast", SMALL)
    yield made
    made.close()
