"""What settings name outside the configuration: drivers, scenes, models, files. Known or there, or told."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.live import LIVE, is_live
from runtime.support.plausible import nearest
from runtime.support.plugins import is_plugin

if TYPE_CHECKING:
    from runtime.config import ContentSettings, Settings

LIBRARY_MOST, LIBRARY_LOOKED_AT = 200, 2000


def scene_names() -> tuple[str, ...]:
    """Every scene that is no file."""
    from runtime.content.presets import preset_names
    from runtime.content.scenes import SCENES

    return (*SCENES, *preset_names())


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


Problems = Iterator[tuple[str, str]]  # a setting, and what is wrong with it


def check_recording(settings: Settings, *, source: str | Path) -> None:
    """Raise InputError where a recording is to be replayed that is not there."""
    _refuse(_recording(settings), source)


def check_names(settings: Settings, *, source: str | Path) -> None:
    """Raise InputError for all names that nobody knows, and files that are not there, naming their fields."""
    _refuse(_problems(settings), source)


def _refuse(problems: Problems, source: str | Path) -> None:
    found = list(problems)
    if found:
        (field, problem), *others = found
        raise InputError(source, field, "; ".join([problem, *(f"{name}: {text}" for name, text in others)]))


def _recording(settings: Settings) -> Problems:
    sensor = settings.sensor
    if sensor.driver == "replay" and sensor.source != "demo":
        yield from _there("sensor.source", sensor.source)


def _problems(settings: Settings) -> Problems:
    from runtime.eyes.calibration import load_calibration
    from runtime.sensor.registry import driver_names

    sensor, content, output = settings.sensor, settings.content, settings.output
    if sensor.driver not in driver_names() and not is_plugin(sensor.driver):
        yield from _unknown("sensor.driver", sensor.driver, driver_names())
    yield from _recording(settings)
    if sensor.openni2_folder:
        yield from _there("sensor.openni2_folder", sensor.openni2_folder)
    if settings.calibration.file:
        yield from _there("calibration.file", settings.calibration.file)
        try:
            load_calibration(Path(settings.calibration.file))
        except InputError as error:
            if untrusted_input.is_there(settings.calibration.file):
                yield "calibration.file", str(error)
    if content.scene not in scene_names() and not (is_live(content.scene) or is_plugin(content.scene)):
        yield from _known_or_there("content.scene", content.scene, scene_names())
    if content.file:
        yield from _there("content.file", content.file)
    if content.library:
        yield from _there("content.library", content.library)
    if settings.model.name not in model_names():
        yield from _known_or_there("model.name", settings.model.name, model_names())
    for number, panel in enumerate(output.panels):
        if panel.lut:
            yield from _there(f"output.panels.{number}.lut", panel.lut)
        if output.kind != "offscreen" and not (panel.edid_serial or panel.connector):
            yield f"output.panels.{number}", "names no monitor: set edid_serial or connector"
    if output.kind != "offscreen" and not output.panels:
        yield "output.panels", f"{output.kind} need one table a panel that names its monitor (phasestack identify)"


def _there(field: str, path: str) -> Problems:
    if not path or not untrusted_input.is_there(Path(path)):
        yield field, f"{path!r} is not there"


def _unknown(field: str, name: str, known: tuple[str, ...]) -> Problems:
    yield field, f"nobody knows {name!r}" + (nearest(name, known) or f"; known: {', '.join(known)}")


def _known_or_there(field: str, name: str, known: tuple[str, ...]) -> Problems:
    if Path(name).exists():
        return
    if "/" in name or Path(name).suffix:
        yield from _there(field, name)
    else:
        yield from _unknown(field, name, known)
