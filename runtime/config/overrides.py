"""Settings replaced by the command line or by an operator, checked like the file's."""

from __future__ import annotations

from typing import Any

from runtime.config.settings import Settings
from runtime.support.sections import Section, validated


def with_options(
    settings: Settings,
    *,
    replay: str | None = None,
    loop: bool = False,
    headless: bool = False,
    scene: str | None = None,
    layout: str | None = None,
    model: str | None = None,
    backend: str | None = None,
) -> Settings:
    """Return the settings with command-line options applied. Raises InputError, naming the option.

    loop: the recording restarts when it ends.
    """
    overrides: tuple[tuple[str, str, dict[str, Any] | None], ...] = (
        ("--replay", "sensor", None if replay is None else {"driver": "replay", "source": replay}),
        ("--replay", "sensor", {"loop": True} if loop else None),
        ("--headless", "output", {"kind": "offscreen"} if headless else None),
        ("--scene", "content", None if scene is None else {"scene": scene}),
        ("--layout", "content", None if layout is None else {"layout": layout}),
        ("--model", "model", None if model is None else {"name": model}),
        ("--backend", "model", None if backend is None else {"backend": backend}),
    )
    for option, section, values in overrides:
        if values is not None:
            settings = changed(settings, section, values, source=option)
    return settings


def changed(settings: Settings, section: str, values: dict[str, Any], *, source: str) -> Settings:
    """Return the settings with values of one section replaced. Raises InputError, naming `source`."""
    old: Section = getattr(settings, section)
    new = validated(type(old), old.model_dump() | values, source=source)
    return settings.model_copy(update={section: new})
