"""Which source draws what `content.scene` names. Loaders are imported when they are needed."""

from __future__ import annotations

from typing import Any

from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.scenes import SCENES
from runtime.errors import InputError
from runtime.optics.stack import PanelStack


def open_content(settings: ContentSettings, stack: PanelStack, context: Any) -> ContentSource:
    """The source of `settings.scene`: a built-in scene, a preset, a file or a folder.

    context: the moderngl context of the thread that will call `render`. Raises InputError, naming file and field.
    """
    if settings.scene in SCENES:
        from runtime.content.procedural import ProceduralSource

        return ProceduralSource(settings.scene, stack=stack, context=context, background=settings.background)
    raise InputError("content", "scene", f"`{settings.scene}` is none of {', '.join(SCENES)}")
