"""What an operator may name: scenes and models."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from runtime.config import ContentSettings

LIBRARY_MOST, LIBRARY_LOOKED_AT = 200, 2000


def scene_names() -> tuple[str, ...]:
    """The built-in scenes."""
    from runtime.content.scenes import SCENES

    return tuple(SCENES)


def library_scenes(settings: ContentSettings) -> tuple[str, ...]:
    """What can be shown of the library's folder, by its whole path; as many as a page can offer.

    A name that is not UTF-8 (no setting can hold it) or that can't be printed is left out.
    """
    from runtime.content.pictures import PICTURES, VIDEOS
    from runtime.content.registry import MESHES, PLAYLISTS

    shown = {*PICTURES, *VIDEOS, *MESHES, *PLAYLISTS, ".ply"}
    if not settings.library:
        return ()
    try:
        entries = sorted(Path(settings.library).absolute().iterdir())[:LIBRARY_LOOKED_AT]
    except (OSError, ValueError):
        return ()
    entries = [path for path in entries if not path.name.startswith(".") and path.name.isprintable()]
    found = [str(path) for path in entries if path.suffix.lower() in shown or path.is_dir()]
    return tuple(found[:LIBRARY_MOST])


def model_names() -> tuple[str, ...]:
    """Every model that is no file."""
    from runtime.model.predictor import SHIPPED

    return (*SHIPPED, "sart")
