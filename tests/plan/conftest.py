"""The plan's tests share what the content's do: one GL context, the display of the paper, views of it."""

from tests.content.conftest import context, image_view, panel_view, shared_context, stack

__all__ = ["context", "image_view", "panel_view", "shared_context", "stack"]
