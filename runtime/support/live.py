"""Which scenes are live pictures; a module of its own, so that the client commands need no more than this."""

from __future__ import annotations

LIVE = "live:"  # before a scene: a stream, a capture card or a file, its newest picture


def is_live(scene: str) -> bool:
    """True for a stream's URL, a capture card, or a file behind the mark."""
    return scene.startswith((LIVE, "/dev/video")) or "://" in scene
