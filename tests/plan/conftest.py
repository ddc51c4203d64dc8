"""The plan's tests share what the content's do: one GL context, views of the paper's display."""

from tests.content.conftest import context, image_view, panel_view, shared_context

__all__ = ["context", "image_view", "panel_view", "shared_context"]
