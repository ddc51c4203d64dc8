"""Open the content source specified by the setting `content.scene`. Readers are imported on demand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from runtime.config import ContentSettings, validated
from runtime.content.base import ContentSource, View
from runtime.content.placed import placed_source, placing_of
from runtime.content.placing import SceneFile
from runtime.content.ply import read_header
from runtime.content.presets import preset_names
from runtime.content.scenes import SCENES
from runtime.errors import InputError, PhasestackError, without_secrets
from runtime.optics.stack import PanelStack
from runtime.optics.views import raster_from_stack
from runtime.support import progress, untrusted_input
from runtime.support.child import in_child
from runtime.support.crash import written
from runtime.support.picture_header import JPEG, PNG, header_of_file
from runtime.support.plausible import nearest
from runtime.support.plugins import is_plugin, plugin_class, strict
from runtime.support.untrusted_input import LIMITS

LIVE = ("program", "pipe", "window")  # modules of this package that show pictures from elsewhere
MESHES = (".glb", ".gltf", ".obj", ".off", ".stl")
SPLATS = (".ply", ".splat", ".spz", ".sog")  # a .ply may be a mesh
PLAYLISTS = (".toml", ".json")
HARMLESS = {".png": PNG, ".jpg": JPEG, ".jpeg": JPEG}  # first bytes of stills that are read without a child process
HARMLESS_PX = 4096 * 4096  # most pixels in such a still
TO_GLTF, TO_PLY = "export it as glTF (.glb), for example with Blender", "save it as PLY, for example with CloudCompare"
TO_SPLATS = "convert it with `npx @playcanvas/splat-transform in{} out.ply`"
FILMS = (".wmv", ".flv", ".mpg", ".mpeg", ".ts", ".m2ts", ".mts", ".3gp", ".ogv", ".vob")
OTHER_FILES = {  # kind of file and remedy, keyed by the suffix of unsupported files
    **dict.fromkeys((".fbx", ".dae", ".blend", ".3ds", ".x3d", ".wrl", ".abc"), ("a 3D scene", TO_GLTF)),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), ("a USD scene", TO_GLTF)),
    **dict.fromkeys(
        (".3mf", ".step", ".stp", ".iges", ".igs"), ("a CAD or 3D-print model", "export it as STL or glTF")
    ),
    **dict.fromkeys((".xyz", ".pts", ".pcd", ".las", ".laz", ".e57"), ("a point cloud", TO_PLY)),
    **dict.fromkeys(FILMS, ("a film", "convert it with `ffmpeg -i in{} out.mp4`")),
    **dict.fromkeys((".ksplat", ".lcc"), ("a compressed splat file", TO_SPLATS)),
}
LFS = b"version https://git-lfs"
TRIED_PX = (32, 18)  # size of the trial picture drawn with a user-defined scene
Opener = Callable[..., ContentSource]  # creates a source, given the keyword argument `context`


def open_content(settings: ContentSettings, stack: PanelStack, context: Any) -> ContentSource:
    """Open the scene that the settings specify: a built-in scene, a preset, a class, a file or a folder.
    `context` is the moderngl context of the thread that will use it. Raises InputError, which names file and field.
    """
    return prepare_content(settings, stack)(context=context)


def prepare_content(settings: ContentSettings, stack: PanelStack) -> Opener:
    """Read and check the scene specified by the settings, and return a function that creates the source.

    Preparation is slow, but may run on any thread and reports progress; only the function needs the GL context's
    thread. Files are read in a child process, except for small pictures. Raises InputError.
    """
    file = SceneFile(Path(settings.scene), settings, stack)
    too_slow = InputError(settings.scene, "", f"takes longer than {LIMITS.load_s:g} s to load")
    with progress.task(f"loading {settings.scene}", seconds=LIMITS.load_s, too_slow=too_slow):
        return _placed(file)


def _placed(file: SceneFile) -> Opener:
    opener, placing = _prepared(file), placing_of(file.settings)
    return lambda context: placed_source(opener(context=context), placing)


def _prepared(file: SceneFile) -> Opener:
    name, settings = file.settings.scene, file.settings
    if name in SCENES:
        return _built_in(name, file)
    if name in preset_names():
        if not settings.file:
            problem = (
                f"is missing; set it to the .ply file, .glb file or data-set folder of {name}, which is not shipped"
            )
            raise InputError("content", "file", problem)
        return _from_path(replace(file, path=Path(settings.file), preset=name))
    if name in LIVE:
        prepare: Callable[[SceneFile], Opener] = import_module(f"runtime.content.{name}").prepare
        return prepare(file)
    if name.lower().startswith("file://"):
        path = unquote(urlsplit(name).path)
        return _prepared(replace(file, path=Path(path), settings=file.settings.model_copy(update={"scene": path})))
    if name.lower().startswith(("smb://", "nfs://", "sftp://", "\\\\")):
        problem = "is on another computer; mount the share, and set the path where it is mounted"
        raise InputError("content", "scene", f"{untrusted_input.shown(without_secrets(name))} {problem}")
    if "://" in name or name.startswith("/dev/video"):
        problem = "live pictures require the scene `pipe` or `window`, your own class or a program (docs/programs.md)"
        raise InputError("content", "scene", f"{untrusted_input.shown(without_secrets(name))}: {problem}")
    if is_plugin(name):
        return _plugin(name, file)
    if not untrusted_input.checked_path(name, source="content", field="scene").exists():
        presets = preset_names()
        meant = nearest(name, (*SCENES, *presets))
        some = f"use {', '.join(SCENES)} or one of {len(presets)} presets such as lego_bulldozer"
        problem = f"`{name}` is not a file, a folder or the name of a scene{meant} ({some})"
        raise InputError("content", "scene", problem)
    return _from_path(file)


def _from_path(file: SceneFile) -> Opener:
    path = file.path
    untrusted_input.checked_path(path, source="content", field="file")
    if not path.exists():
        raise InputError(path, "", "does not exist")
    suffix = path.suffix.lower()
    if suffix in OTHER_FILES and path.is_file():
        kind, way_out = OTHER_FILES[suffix]
        raise InputError(path, "", f"is {kind} ({suffix}), which is not supported; {way_out.format(suffix)}")
    if suffix in (*MESHES, *SPLATS) and path.is_file():
        with untrusted_input.open_regular(path) as opened:
            if opened.read(len(LFS)) == LFS:
                raise InputError(path, "", "is a Git LFS pointer; fetch the file itself with `git lfs pull`")
    progress.tell(f"loading {path.name}", 0)
    if suffix in PLAYLISTS and not path.is_dir():
        return _playlist(file)
    return _read(file) if _is_harmless(file) else in_child(_read, file, source=path, seconds=LIMITS.load_s)


def _is_harmless(file: SceneFile) -> bool:
    """Return True if a file's header shows that the file is quick to decode and needs little memory."""
    from runtime.content.layout import layout_of

    mark = HARMLESS.get(file.path.suffix.lower())
    if mark is None or file.path.is_dir() or layout_of(file.path, file.settings).kind == "rgbd":
        return False
    with untrusted_input.open_regular(file.path) as opened:
        if opened.read(len(mark)) != mark:
            return False
    header = header_of_file(file.path)
    return not header.is_animated and len(header.views) == 1 and header.width_px * header.height_px <= HARMLESS_PX


def _read(file: SceneFile) -> Opener:
    """Read a file or folder with the reader for its suffix and contents, and return an opener that can be pickled."""
    path = file.path
    suffix = path.suffix.lower()
    if path.is_dir():
        from runtime.content import compressed_splats, eyereal, splat

        if eyereal.is_data_set(path):
            return eyereal.prepare(file)
        if compressed_splats.is_sog_folder(path):
            return splat.prepare(file)
    elif suffix in MESHES:
        from runtime.content import mesh

        return mesh.prepare(file)
    elif suffix in SPLATS:
        from runtime.content import mesh, splat

        is_splats = suffix != ".ply" or read_header(path).kind == "splats"
        return splat.prepare(file) if is_splats else mesh.prepare(file)
    from runtime.content import pictures, rgbd
    from runtime.content.layout import layout_of

    is_rgbd = layout_of(path, file.settings).kind == "rgbd"
    return rgbd.prepare(file) if is_rgbd else pictures.prepare(file)


def _built_in(name: str, file: SceneFile) -> Opener:
    from runtime.content.procedural import ProceduralSource, parts_of

    scene = SCENES[name]()
    parts = parts_of(scene)

    background = file.settings.background
    return lambda context: ProceduralSource(
        scene, stack=file.stack, context=context, background=background, parts=parts
    )


def _playlist(file: SceneFile) -> Opener:
    from runtime.content.playlist import PlaylistSource, read_playlist

    playlist = read_playlist(file.path, file.settings)
    openers = []
    for number, entry in enumerate(playlist.entries):
        progress.tell(f"{file.path.name}: {Path(entry.scene).name}", number, len(playlist.entries))
        try:
            openers.append(_placed(replace(file, path=Path(entry.scene), settings=entry)))
        except InputError as error:
            raise InputError(file.path, f"show[{number}]", str(error)) from None
    return lambda context: PlaylistSource(playlist, openers, context=context)


def _plugin(name: str, file: SceneFile) -> Opener:
    """Import a user-defined scene's class, and return a function that creates the source and draws a trial picture.
    Raises InputError if the class cannot be imported or the options are invalid, and so does the function for a fault.
    """
    plugin = plugin_class(name, ContentSource, field="content.scene")
    try:
        signature(plugin.render).bind(None, None, time_ns=0)
    except TypeError as error:
        raise InputError(name, "render", f"must be declared as render(self, view, *, time_ns): {error}") from None
    options = validated(strict(plugin.Options), file.settings.options, source="content.options")

    def make(context: Any) -> ContentSource:
        eye = np.array([0.6, 0.0, 0.0])
        plane = replace(file.stack, width_px=TRIED_PX[0], height_px=TRIED_PX[1]).panel(0)
        try:
            source: ContentSource = plugin(options, stack=file.stack, context=context)
            picture = source.render(View(eye, 0, raster_from_stack(eye, plane), *TRIED_PX), time_ns=0)
        except PhasestackError:
            raise
        except (Exception, SystemExit) as error:
            raise InputError(name, "", written(error)) from error
        if getattr(picture, "shape", None) != (*TRIED_PX[::-1], 4) or picture.dtype != np.uint8:
            source.close()
            raise InputError(name, "render", "must return a uint8 RGBA array of shape (height_px, width_px, 4)")
        return source

    return make
