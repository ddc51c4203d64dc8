"""What settings name outside the configuration: drivers, scenes, models, files. Known or there, or told."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.errors import InputError
from runtime.support import foreign
from runtime.support.live import LIVE, is_live
from runtime.support.plausible import nearest

if TYPE_CHECKING:
    from runtime.config import ContentSettings, Settings

LIBRARY_MOST, LIBRARY_LOOKED_AT = 200, 2000


def scene_names() -> tuple[str, ...]:
    """Every scene that is no file."""
    from runtime.content.presets import preset_names
    from runtime.content.scenes import SCENES

    return (*SCENES, *preset_names(), "external")


def library_scenes(settings: ContentSettings) -> tuple[str, ...]:
    """What can be shown of the library's folder, by its whole path; as many as a page can offer."""
    from runtime.content.pictures import PICTURES, VIDEOS
    from runtime.content.registry import MESHES, PLAYLISTS

    shown = {*PICTURES, *VIDEOS, *MESHES, *PLAYLISTS, ".ply"}
    if not settings.library:
        return ()
    try:
        entries = sorted(Path(settings.library).absolute().iterdir())[:LIBRARY_LOOKED_AT]
    except (OSError, ValueError):
        return ()
    entries = [path for path in entries if not path.name.startswith(".")]
    found = [str(path) for path in entries if path.suffix.lower() in shown or path.is_dir()]
    return tuple(found[:LIBRARY_MOST])


def model_names() -> tuple[str, ...]:
    """Every model that is no file."""
    from runtime.model.predictor import SHIPPED

    return (*SHIPPED, "sart")


def scene_from_here(name: str) -> str:
    """A scene for a daemon that runs elsewhere: a file's or folder's absolute path; a known name as it is.

    What is neither known nor there is left as it is: the daemon says what it knows.
    """
    if name.startswith(LIVE):
        return LIVE + _from_here(name.removeprefix(LIVE), tuple)
    return _from_here(name, scene_names)


def model_from_here(name: str) -> str:
    """The same of a model."""
    return _from_here(name, model_names)


def _from_here(name: str, known: Callable[[], tuple[str, ...]]) -> str:
    try:
        if not Path(name).exists() or (Path(name).name == name and name in known()):
            return name
        return str(Path(name).absolute())
    except (OSError, ValueError):  # too long, or a NUL character
        return name


def check_recording(settings: Settings, *, source: str | Path) -> None:
    """Raise InputError where a recording is to be replayed that is not there."""
    sensor = settings.sensor
    if sensor.driver == "replay" and sensor.source != "demo":
        _there("sensor.source", sensor.source, source)


def check_names(settings: Settings, *, source: str | Path) -> None:
    """Raise InputError for the first name that nobody knows, or file that is not there, naming its field."""
    from runtime.eyes.calibration import load_calibration
    from runtime.sensor.registry import driver_names

    sensor, content, output = settings.sensor, settings.content, settings.output
    if sensor.driver not in driver_names():
        _unknown("sensor.driver", sensor.driver, driver_names(), source)
    check_recording(settings, source=source)
    if sensor.openni2_folder:
        _there("sensor.openni2_folder", sensor.openni2_folder, source)
    if settings.detector.kind == "yunet":
        _there("detector.yunet_model", settings.detector.yunet_model, source)
    if settings.calibration.file:
        _there("calibration.file", settings.calibration.file, source)
        load_calibration(Path(settings.calibration.file))
    if content.scene not in scene_names() and not is_live(content.scene):
        _known_or_there("content.scene", content.scene, scene_names(), source)
    if content.file:
        _there("content.file", content.file, source)
    if content.library:
        _there("content.library", content.library, source)
    if settings.model.name not in model_names():
        _known_or_there("model.name", settings.model.name, model_names(), source)
    for number, panel in enumerate(output.panels):
        if panel.lut:
            _there(f"output.panels.{number}.lut", panel.lut, source)
        if output.kind != "offscreen" and not (panel.edid_serial or panel.connector or panel.index >= 0):
            raise InputError(source, f"output.panels.{number}", "names no monitor: set edid_serial or connector")
    if output.kind != "offscreen" and not output.panels:
        raise InputError(
            source,
            "output.panels",
            f"{output.kind} need one table a panel that names its monitor (phasestack identify)",
        )


def _there(field: str, path: str, source: str | Path) -> None:
    if not path or not foreign.is_there(Path(path)):
        raise InputError(source, field, f"{path!r} is not there")


def _unknown(field: str, name: str, known: tuple[str, ...], source: str | Path) -> None:
    hint = nearest(name, known) or f"; known: {', '.join(known)}"
    raise InputError(source, field, f"nobody knows {name!r}{hint}")


def _known_or_there(field: str, name: str, known: tuple[str, ...], source: str | Path) -> None:
    if Path(name).exists():
        return
    if "/" in name or Path(name).suffix:
        _there(field, name, source)
    _unknown(field, name, known, source)
