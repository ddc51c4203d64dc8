"""Read folders from the EyeReal data set: pairs of pictures with the eyes' positions in their names."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from runtime.content.base import WHITE, ContentInfo, ContentSource, View
from runtime.content.images import WarpedPicture, image_from_view, rgba_from_rgb
from runtime.content.placing import SceneFile
from runtime.content.presets import drawn_scene_from_stack, preset_names
from runtime.errors import ContentFailure, InputError
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8, Eyes
from runtime.support.picture_file import read_image

NUMBER = r"(-?(?:\d+\.?\d*|\.\d+))"
NAME = re.compile(rf"pair(\d+)_x{NUMBER}_y{NUMBER}_z{NUMBER}_([01]|left|right)\.(?:jpg|jpeg|png)$", re.IGNORECASE)
KEPT = 4  # number of pairs kept in memory


@dataclass(frozen=True, slots=True)
class Pair:
    """A scene's pictures for the left and right eyes, in two files."""

    number: int
    paths: tuple[Path, Path]  # left, right
    eyes_m: Eyes  # (2, 3) left and right eye positions, frame `stack`
    looks_at_m: F64  # (3,) scene's origin in frame `stack`, where both eyes look; not always on the display

    def image_from_stack(self, side: int, *, width_px: int, height_px: int, fov_deg: float) -> F64:
        """Return the (3, 4) projection from `stack` to the left (`side` 0) or right (1) picture's pixels."""
        around_origin = np.eye(4)
        around_origin[:3, 3] = -self.looks_at_m
        eye = self.eyes_m[side] - self.looks_at_m
        return image_from_stack(eye, width_px=width_px, height_px=height_px, fov_deg=fov_deg) @ around_origin


def is_data_set(folder: Path) -> bool:
    """Return True if a folder contains a picture whose name follows the data set's naming scheme."""
    return folder.is_dir() and any(NAME.match(path.name) for path in folder.iterdir())


def read_folder(folder: Path, preset: str) -> tuple[Pair, ...]:
    """Return all pairs in a folder, ordered by number.

    File names contain the eyes' positions in the scene's digital units, which determine whether `_0` or `_1` is the
    left picture, and with which `_left` and `_right` in newer data must agree. Raises InputError.
    """
    stack_from_scene: F64 = np.linalg.inv(drawn_scene_from_stack(preset)).astype(np.float64)
    files: dict[int, list[tuple[str, Path, F64]]] = {}
    for path in sorted(folder.iterdir()):
        match = NAME.match(path.name)
        if not match:
            continue
        eye = (stack_from_scene @ [float(match[2]), float(match[3]), float(match[4]), 1.0])[:3]
        if eye[0] <= 0:
            problem = f"places the eye behind the display (x = {eye[0]:.3f} m) in preset {preset}"
            raise InputError(path, "name", problem)
        files.setdefault(int(match[1]), []).append((match[5].lower(), path, eye))
    if not files:
        raise InputError(folder, "", "contains no pictures with names such as pair0_x.._y.._z.._0.jpg")
    pairs = []
    for number, halves in sorted(files.items()):
        names = [half for half, _, _ in halves]
        if sorted(names) not in (["0", "1"], ["left", "right"]):
            problem = f"has {', '.join(f'_{half}' for half in names)}, but needs either _0 and _1, or _left and _right"
            raise InputError(halves[0][1], f"pair{number}", problem)
        (name, left, left_eye), (_, right, right_eye) = sorted(halves, key=lambda half: half[2][1])
        if left_eye[1] == right_eye[1]:
            raise InputError(
                left, f"pair{number}", "both eyes have the same y coordinate, so left and right cannot be distinguished"
            )
        if name == "right":
            raise InputError(
                right, f"pair{number}", f"the _left viewpoint lies to the right of the _right one in preset {preset}"
            )
        pairs.append(Pair(number, (left, right), np.array([left_eye, right_eye]), stack_from_scene[:3, 3]))
    return tuple(pairs)


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Read a folder of pairs, and return a function that creates the source. By default, the preset is
    that whose name occurs in the folder's name. Raises InputError without one, or if the pairs cannot be read.
    """
    path, settings = file.path, file.settings
    name = file.preset or next((name for name in preset_names() if name in path.resolve().name), "")
    if not name:
        raise InputError(
            path,
            "name",
            "does not contain the name of a preset; set content.scene to a preset and content.file to this folder",
        )
    pairs = read_folder(path, name)
    background = settings.background or WHITE
    make = partial(EyeRealSource, pairs, fov_deg=settings.fov_deg, background=background, name=name)
    make()  # raises now if a picture is unreadable
    return make


class EyeRealSource(ContentSource):
    """Source of the pair whose left eye is nearest to the viewer's, warped as if at x = 0."""

    def __init__(
        self,
        pairs: tuple[Pair, ...],
        *,
        fov_deg: float,
        background: tuple[float, float, float],
        name: str,
        context: object = None,
    ) -> None:
        self._pairs, self._fov_deg, self._background = pairs, fov_deg, background
        self._eyes_m = np.stack([pair.eyes_m for pair in pairs])
        self._loaded = lru_cache(KEPT)(self._load)
        self._chosen = 0
        self._loaded(0)
        self.info = ContentInfo(name=name, background=background, fixed_views=True)

    def render(self, view: View, *, time_ns: int) -> U8:
        if view.side == 0:  # the right eye sees the pair that was chosen for the left eye
            self._chosen = int(np.linalg.norm(self._eyes_m[:, 0] - view.eye_m, axis=1).argmin())
        try:
            picture, projection = self._loaded(self._chosen)[view.side]
        except InputError as error:
            raise ContentFailure(str(error)) from None
        matrix = image_from_view(projection, view.pixels_from_stack)
        return picture.warped(matrix, view)

    def _load(self, index: int) -> list[tuple[WarpedPicture, F64]]:
        return [self._opened(self._pairs[index], side) for side in (0, 1)]

    def _opened(self, pair: Pair, side: int) -> tuple[WarpedPicture, F64]:
        rgb = read_image(pair.paths[side])
        height, width = rgb.shape[:2]
        projection = pair.image_from_stack(side, width_px=width, height_px=height, fov_deg=self._fov_deg)
        return WarpedPicture(rgba_from_rgb(rgb), background=self._background), projection
