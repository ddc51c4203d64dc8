"""Which source a name opens, and what an unknown one is told."""

from __future__ import annotations

from typing import Any

import pytest

from runtime.config import ContentSettings
from runtime.content.registry import open_content
from runtime.errors import InputError
from runtime.optics.stack import PanelStack


def test_the_default_is_the_built_in_scene(context: Any, stack: PanelStack) -> None:
    assert open_content(ContentSettings(), stack, context).info.name == "demo"


def test_an_unknown_name_is_one_line_with_what_there_is(context: Any, stack: PanelStack) -> None:
    with pytest.raises(InputError, match=r"^content: scene: `nothing`.*demo"):
        open_content(ContentSettings(scene="nothing"), stack, context)
