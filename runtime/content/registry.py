"""Which source draws what `content.scene` names. Loaders are imported when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from runtime.config import ContentSettings, LimitSettings
from runtime.content.base import ContentSource
from runtime.content.placed import placed_source, placing_of
from runtime.content.presets import Preset, preset, preset_names
from runtime.content.scenes import SCENES
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64
from runtime.support import foreign, progress
from runtime.support.live import is_live
from runtime.support.plausible import nearest

MESHES = (".glb", ".gltf", ".obj", ".stl")
PLAYLISTS = (".toml", ".json")
Opener = Callable[[Any], ContentSource]


def open_content(
    settings: ContentSettings, stack: PanelStack, context: Any, *, limits: LimitSettings | None = None
) -> ContentSource:
    """The source of `settings.scene`: a built-in scene, a preset, `external`, a file or a folder.

    context: the moderngl context of the thread that will call `render`. Raises InputError, naming file and field.
    """
    return prepare_content(settings, stack, limits=limits)(context)


def prepare_content(settings: ContentSettings, stack: PanelStack, *, limits: LimitSettings | None = None) -> Opener:
    """Read and check what `settings.scene` names; the answer makes the source on the thread that has the context.

    This is the slow part and needs no GL: it may run on any thread. It tells `runtime.support.progress` how far it is.
    limits: of what files may hold; None: the defaults. Raises InputError, naming file and field.
    """
    limits = limits or LimitSettings()
    with progress.task(f"loading {settings.scene}", seconds=limits.load_s, too_slow=_too_slow(settings.scene, limits)):
        return _placed(settings, stack, limits)


def _placed(settings: ContentSettings, stack: PanelStack, limits: LimitSettings) -> Opener:
    opener, placing = _prepared(settings, stack, limits), placing_of(settings)
    return lambda context: placed_source(opener(context), placing, stack)


def _too_slow(scene: str, limits: LimitSettings) -> InputError:
    return InputError(scene, "", f"takes longer to load than {limits.load_s:g} s (limits.load_s)")


def _prepared(settings: ContentSettings, stack: PanelStack, limits: LimitSettings) -> Opener:
    name = settings.scene
    if name in SCENES:
        return _built_in(name, settings, stack)
    if name == "external":
        return _external(settings, stack)
    if name in preset_names():
        chosen = preset(name, settings.reading)
        if settings.file:
            return _from_path(Path(settings.file), settings, stack, chosen, limits)
        return _stand_in(name, settings, stack)
    if is_live(name):
        return _live(name, settings, stack, limits)
    path = foreign.checked_path(name, source="content", field="scene")
    if not path.exists():
        raise InputError("content", "scene", f"`{name}` {_no_scene(name)}")
    return _from_path(path, settings, stack, None, limits)


def _no_scene(name: str) -> str:
    """What a name is not, and what was meant; not all names, which one line does not hold."""
    presets = preset_names()
    meant = nearest(name, (*SCENES, *presets, "external"))
    some = f"built in: {', '.join(SCENES)}; {len(presets)} presets, such as lego_bulldozer"
    return f"is neither a file or folder nor a scene's name{meant} ({some})"


def _from_path(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, limits: LimitSettings
) -> Opener:
    foreign.checked_path(path, source="content", field="file")
    if not path.exists():
        raise InputError(path, "", "is not there")
    progress.tell(f"loading {path.name}", 0)
    suffix = path.suffix.lower()
    if suffix in PLAYLISTS and path.is_file():
        return _playlist(path, settings, stack, limits)
    if path.is_dir():
        from runtime.content.eyereal import is_data_set

        if is_data_set(path):
            return _eyereal(path, settings, chosen)
        return _pictures(path, settings, stack, limits)
    if suffix in MESHES:
        return _mesh(path, settings, stack, chosen, limits)
    if suffix == ".ply":
        from runtime.content.ply import holds_points_alone

        if _holds_splats(path):
            return _splat(path, settings, stack, chosen, limits)
        if holds_points_alone(path):
            return _points(path, settings, stack, chosen, limits)
        return _mesh(path, settings, stack, chosen, limits)
    return _pictures(path, settings, stack, limits)


def _built_in(name: str, settings: ContentSettings, stack: PanelStack) -> Opener:
    from runtime.content.procedural import ProceduralSource, ready_scene

    made = ready_scene(name, samples=settings.samples)

    def make(context: Any) -> ContentSource:
        return ProceduralSource(
            made, stack=stack, context=context, background=settings.background, samples=settings.samples
        )

    return make


def _stand_in(name: str, settings: ContentSettings, stack: PanelStack) -> Opener:
    """The demo scene under the preset's name: the paper's scenes are not shipped."""
    make_demo = _built_in("demo", settings, stack)

    def make(context: Any) -> ContentSource:
        source = make_demo(context)
        source.info = replace(source.info, name=f"{name} (stand-in `demo`: content.file is empty)", stand_in=True)
        return source

    return make


def _external(settings: ContentSettings, stack: PanelStack) -> Opener:
    def make(context: Any) -> ContentSource:
        from runtime.content.external import ExternalSource

        return ExternalSource(settings, stack=stack)

    return make


def _live(name: str, settings: ContentSettings, stack: PanelStack, limits: LimitSettings) -> Opener:
    from runtime.content.stream import LiveSource, open_feed

    feed, layout, quilt = open_feed(name, settings, limits)
    return lambda context: LiveSource(feed, layout=layout, quilt=quilt, stack=stack, settings=settings)


def _eyereal(path: Path, settings: ContentSettings, chosen: Preset | None) -> Opener:
    from runtime.content.eyereal import EyeRealSource, fitting_presets, read_folder

    # The data set was drawn by the published code: its scale holds in every reading.
    reading = "published-code" if settings.reading == "seed" else settings.reading
    known = chosen.name if chosen else next((name for name in preset_names() if name in path.resolve().name), "")
    told = known
    if not known:
        fitting = fitting_presets(path, (preset(name, reading) for name in preset_names()))
        if not fitting:
            problem = "names no preset, and its eyes fit none: set content.scene to one and content.file to the folder"
            raise InputError(path, "name", problem)
        known = fitting[0].name
        told = f"{path.resolve().name} (read as {known}, which its eyes fit)"
    pairs = read_folder(path, preset(known, reading))
    source = EyeRealSource(pairs, fov_deg=settings.fov_deg, background=settings.background, name=told)
    return lambda context: source


def _playlist(path: Path, settings: ContentSettings, stack: PanelStack, limits: LimitSettings) -> Opener:
    from runtime.content.playlist import PlaylistSource, read_playlist

    playlist = read_playlist(path, settings)
    openers = []
    for number, entry in enumerate(playlist.entries):
        progress.tell(f"{path.name}: {Path(entry.settings.scene).name}", number, len(playlist.entries))
        try:
            openers.append(_placed(entry.settings, stack, limits))
        except InputError as error:
            raise InputError(path, f"show[{number}]", str(error)) from None
    return lambda context: PlaylistSource(playlist, openers, context=context, background=settings.background)


def _pictures(path: Path, settings: ContentSettings, stack: PanelStack, limits: LimitSettings) -> Opener:
    from runtime.content.pictures import ScreenPictures, layout_of, open_frames, quilt_size

    layout = layout_of(path, settings)
    frames = open_frames(path, settings, limits=limits)
    if layout == "rgbd":
        first = frames.frame(0)

        def make(context: Any) -> ContentSource:
            from runtime.content.rgbd import RgbdSource

            return RgbdSource(
                first,
                path=path,
                stack=stack,
                depth_m=settings.depth_m,
                context=context,
                background=settings.background,
                samples=settings.samples,
            )

        return make
    quilt = quilt_size(path, settings) if layout == "quilt" else (1, 1)
    source = ScreenPictures(frames, layout=layout, stack=stack, settings=settings, path=path, quilt=quilt)
    return lambda context: source


def _mesh(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, limits: LimitSettings
) -> Opener:
    from runtime.content.mesh import MeshSource, load_mesh
    from runtime.content.triangles import ready

    data = load_mesh(path, limits=limits, animation=settings.animation)
    parts = []
    for number, part in enumerate(data.parts):
        progress.tell(f"{path.name}: outlines", number, len(data.parts))
        parts.append(ready(part, samples=settings.samples))
    matrix = _stack_from_scene(data.low, data.high, path, settings, stack, chosen)
    return lambda context: MeshSource(
        data,
        stack_from_scene=matrix,
        context=context,
        background=settings.background,
        samples=settings.samples,
        parts=parts,
    )


def _splat(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, limits: LimitSettings
) -> Opener:
    from runtime.content.gaussians import load_gaussians
    from runtime.content.splat import SplatSource

    gaussians = load_gaussians(path, limits=limits)
    matrix = _placed_cloud(gaussians.centres, 1.0, path, settings, stack, chosen)
    return lambda context: SplatSource(
        gaussians, stack_from_scene=matrix, context=context, background=settings.background, name=path.stem
    )


def _points(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, limits: LimitSettings
) -> Opener:
    from runtime.content.points import PointSource, load_points

    cloud = load_points(path, limits=limits)
    matrix = _placed_cloud(cloud.positions, 0.5, path, settings, stack, chosen)
    return lambda context: PointSource(
        cloud, stack_from_scene=matrix, context=context, background=settings.background, name=path.stem
    )


def _placed_cloud(
    places: F32, stray: float, path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None
) -> F64:
    """4x4 `stack_from_scene` of places (n, 3) in the scene; so many percent at either end do not decide the scale."""
    low, high = np.percentile(places.astype(np.float64), [stray, 100 - stray], axis=0)
    return _stack_from_scene(low, high, path, settings, stack, chosen)


def _stack_from_scene(
    low: F64, high: F64, path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None
) -> F64:
    from runtime.content.placing import stack_from_scene

    scene_from_stack = chosen.scene_from_stack if chosen else None
    return stack_from_scene(low, high, settings=settings, path=path, stack=stack, scene_from_stack=scene_from_stack)


def _holds_splats(path: Path) -> bool:
    """True where a PLY's header has a splat's properties."""
    with foreign.open_regular(path) as file:
        head = file.read(8192)
    return any(mark in head for mark in (b" f_dc_0", b" scale_0", b" rot_0"))
