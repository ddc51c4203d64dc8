"""Which source draws what `content.scene` names. Loaders are imported when they are needed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.presets import Preset, preset, preset_names
from runtime.content.scenes import SCENES
from runtime.errors import InputError
from runtime.optics.stack import PanelStack

MESHES = (".glb", ".gltf", ".obj")
Opener = Callable[[Any], ContentSource]
Progress = Callable[[str], None]


def open_content(settings: ContentSettings, stack: PanelStack, context: Any) -> ContentSource:
    """The source of `settings.scene`: a built-in scene, a preset, `external`, a file or a folder.

    context: the moderngl context of the thread that will call `render`. Raises InputError, naming file and field.
    """
    return prepare_content(settings, stack)(context)


def prepare_content(settings: ContentSettings, stack: PanelStack, *, progress: Progress = lambda _: None) -> Opener:
    """Read and check what `settings.scene` names; the answer makes the source on the thread that has the context.

    This is the slow part and needs no GL: it may run on any thread. Raises InputError, naming file and field.
    """
    name = settings.scene
    if name in SCENES:
        return _built_in(name, settings, stack)
    if name == "external":
        return _external(settings, stack)
    if name in preset_names():
        chosen = preset(name, settings.reading)
        if settings.file:
            return _from_path(Path(settings.file), settings, stack, chosen, progress)
        return _stand_in(name, settings, stack)
    path = Path(name)
    if not path.exists():
        known = ", ".join((*SCENES, *preset_names(), "external"))
        raise InputError("content", "scene", f"`{name}` is neither a file or folder nor one of {known}")
    return _from_path(path, settings, stack, None, progress)


def _from_path(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, progress: Progress
) -> Opener:
    if not path.exists():
        raise InputError(path, "", "is not there")
    progress(f"loading {path.name}")
    suffix = path.suffix.lower()
    if path.is_dir():
        from runtime.content.eyereal import is_data_set

        if is_data_set(path):
            return _eyereal(path, settings, chosen)
        return _pictures(path, settings, stack)
    if suffix in MESHES:
        return _mesh(path, settings, stack, chosen)
    if suffix == ".ply":
        if _holds_splats(path):
            return _splat(path, settings, stack, chosen, progress)
        return _mesh(path, settings, stack, chosen)
    return _pictures(path, settings, stack)


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
        source.info = replace(source.info, name=f"{name} (stand-in `demo`: content.file is empty)")
        return source

    return make


def _external(settings: ContentSettings, stack: PanelStack) -> Opener:
    def make(context: Any) -> ContentSource:
        from runtime.content.external import ExternalSource

        return ExternalSource(settings, stack=stack)

    return make


def _eyereal(path: Path, settings: ContentSettings, chosen: Preset | None) -> Opener:
    from runtime.content.eyereal import EyeRealSource, read_folder

    name = chosen.name if chosen else next((known for known in preset_names() if known in path.resolve().name), "")
    if not name:
        raise InputError(path, "name", "names no preset: set content.scene to one and content.file to the folder")
    # The data set was drawn by the published code: its scale holds in every reading.
    reading = "published-code" if settings.reading == "seed" else settings.reading
    pairs = read_folder(path, preset(name, reading))
    source = EyeRealSource(pairs, fov_deg=settings.fov_deg, background=settings.background, name=name)
    return lambda context: source


def _pictures(path: Path, settings: ContentSettings, stack: PanelStack) -> Opener:
    from runtime.content.pictures import ScreenPictures, layout_of, open_frames, quilt_size

    layout = layout_of(path, settings)
    frames = open_frames(path, settings)
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
            )

        return make
    quilt = quilt_size(path, settings) if layout == "quilt" else (1, 1)
    source = ScreenPictures(frames, layout=layout, stack=stack, settings=settings, path=path, quilt=quilt)
    return lambda context: source


def _mesh(path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None) -> Opener:
    from runtime.content.mesh import MeshSource, load_mesh
    from runtime.content.placing import stack_from_scene
    from runtime.content.triangles import ready

    data = load_mesh(path)
    parts = [ready(part, samples=settings.samples) for part in data.parts]
    matrix = stack_from_scene(
        data.low,
        data.high,
        settings=settings,
        path=path,
        stack=stack,
        scene_from_stack=chosen.scene_from_stack if chosen else None,
    )
    return lambda context: MeshSource(
        data,
        stack_from_scene=matrix,
        context=context,
        background=settings.background,
        samples=settings.samples,
        parts=parts,
    )


def _splat(
    path: Path, settings: ContentSettings, stack: PanelStack, chosen: Preset | None, progress: Progress
) -> Opener:
    import numpy as np

    from runtime.content.gaussians import load_gaussians
    from runtime.content.placing import stack_from_scene
    from runtime.content.splat import SplatSource

    gaussians = load_gaussians(path, progress=progress)
    # A few stray splats must not decide the scale.
    low, high = np.percentile(gaussians.centres.astype(np.float64), [1, 99], axis=0)
    matrix = stack_from_scene(
        low,
        high,
        settings=settings,
        path=path,
        stack=stack,
        scene_from_stack=chosen.scene_from_stack if chosen else None,
    )
    return lambda context: SplatSource(
        gaussians, stack_from_scene=matrix, context=context, background=settings.background, name=path.stem
    )


def _holds_splats(path: Path) -> bool:
    """True where a PLY's header has a splat's properties."""
    with path.open("rb") as file:
        head = file.read(8192)
    return any(mark in head for mark in (b" f_dc_0", b" scale_0", b" rot_0"))
