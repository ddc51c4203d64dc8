"""Pictures with their viewing geometry, read from case files or drawn from built-in scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from runtime.config import Section, StackGeometry, read_table, validated
from runtime.errors import InputError
from runtime.model.job import VIEWS_MOST
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack, stack_from_eye
from runtime.records import F64, U8, Eyes
from runtime.support.picture_file import read_image
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG

if TYPE_CHECKING:
    from runtime.content.scenes import Scene

Metres = Annotated[float, Field(strict=True, ge=-EYE_MOST_M, le=EYE_MOST_M)]
Place = tuple[Metres, Metres, Metres]  # frame `stack`
OFF_MM = (2, 4, 6)  # eye displacements to draw targets for
SEPARATION_MOST_M = 1.0  # largest distance between one viewer's eyes; more is a mistake
FOV_DEG = 40.0  # the drawn pictures' horizontal field of view


@dataclass(frozen=True, slots=True)
class OffView:
    """A target picture for an eye displaced from its nominal position."""

    mm: float  # displacement
    eye_m: F64  # (3,) displaced position, frame `stack`
    image: U8  # (h, w, 3)


@dataclass(frozen=True, slots=True)
class StillPair:
    """Target pictures for two or more eyes, the eyes' positions, and the panels to show the pictures on."""

    name: str
    stack: PanelStack
    eyes_m: Eyes  # (V, 3) frame `stack`: the first viewer's left and right eye, then the next viewer's
    images: tuple[U8, ...]  # each eye's picture, (h, w, 3)
    fov_deg: float  # horizontal field of view
    off: tuple[OffView, ...] = ()  # further targets, for displaced eyes


class OffEntry(Section):
    """An entry in a case file that describes the target picture for a displaced eye."""

    mm: Annotated[float, Field(strict=True, ge=0, le=1000 * EYE_MOST_M)]
    eye: Place
    image: str


class CaseFile(Section):
    """A case file's validated contents (docs/contracts.md)."""

    panels: dict[str, Any]  # fields of StackGeometry
    # The first viewer's left and right eye, then the next viewer's
    eyes: Annotated[tuple[Place, ...], Field(min_length=2, max_length=VIEWS_MOST)]
    images: tuple[str, ...]  # file names, relative to the case file, in the order of the eyes
    fov: Annotated[float, Field(strict=True, ge=FOV_RANGE_DEG[0], le=FOV_RANGE_DEG[1])]
    off: tuple[OffEntry, ...] = ()


def read_pairs(folder: Path) -> list[StillPair]:
    """Read all case files in a folder, by name, no other JSON. Raises InputError for invalid or no cases."""
    if not folder.is_dir():
        raise InputError(folder, "", "is not a folder")
    pairs = []
    for path in sorted(folder.glob("*.json")):
        table = read_table(path)
        if {"panels", "eyes", "images"} <= table.keys():
            pairs.append(_case(path, table))
    if not pairs:
        raise InputError(
            folder, "", "contains no case files; a case file is a JSON file with panels, eyes, images and fov"
        )
    return pairs


def read_case(path: Path) -> StillPair:
    """Read a case file. Raises InputError if it is invalid."""
    return _case(path, read_table(path))


def _case(path: Path, table: dict[str, Any]) -> StillPair:
    case = validated(CaseFile, table, source=path)
    if len(case.images) != len(case.eyes):
        raise InputError(path, "images", f"must be {len(case.eyes)} files (one per eye), not {len(case.images)}")
    images = tuple(read_image(path.parent / name) for name in case.images)
    left = images[0]
    for image in images:
        if image.shape != left.shape:
            raise InputError(
                path, "images", f"must have the same size, but have {left.shape[1::-1]} and {image.shape[1::-1]}"
            )
    size = {"width_px": left.shape[1], "height_px": left.shape[0]}
    stack = validated(StackGeometry, size | case.panels, source=f"{path}: panels").stack()
    eyes = np.array(case.eyes)
    if not (eyes[:, 0] > max(stack.x_m)).all():
        raise InputError(path, "eyes", "must be in front of every panel")
    for n in range(0, len(eyes) - 1, 2):
        apart_m = float(np.linalg.norm(eyes[n + 1] - eyes[n]))
        if apart_m > SEPARATION_MOST_M:
            raise InputError(path, f"eyes.{n + 1}", f"is {apart_m:g} m from the other eye; positions are in metres")
    off = []
    for view in case.off:
        image = read_image(path.parent / view.image)
        if image.shape != left.shape:
            raise InputError(path.parent / view.image, "", "must have the same size as the pair")
        off.append(OffView(view.mm, np.array(view.eye), image))
    return StillPair(path.stem, stack, eyes, images, case.fov, tuple(off))


def eyes_at(*, distance_m: float, angle_deg: float = 0.0, height_m: float = 0.0, ipd_m: float = 0.063) -> F64:
    """Return the (2, 3) eyes of a viewer facing the origin, `angle_deg` from the x axis towards +y."""
    angle = math.radians(angle_deg)
    level = math.sqrt(max(distance_m**2 - height_m**2, 0.0))
    middle = np.array([level * math.cos(angle), level * math.sin(angle), height_m])
    right = stack_from_eye(middle)[:3, 0]
    return np.array([middle - right * ipd_m / 2, middle + right * ipd_m / 2])


def beside(eye_m: ArrayLike, mm: float) -> list[F64]:
    """Return positions in `stack`, along the axes of the eye's pose, right, above, left and below."""
    pose = stack_from_eye(eye_m)
    directions = ((1, 0), (0, 1), (-1, 0), (0, -1))
    return [pose[:3, 3] + mm / 1000 * (right * pose[:3, 0] + up * pose[:3, 1]) for right, up in directions]


class PairPainter:
    """Painter of a scene as seen from any position: a context manager, on one thread, with OpenGL."""

    def __init__(self, scene: str | Scene, stack: PanelStack) -> None:
        """Open a scene, or a built-in scene by name, for a stack's panels. Raises MissingPart without OpenGL."""
        from runtime.content.procedural import ProceduralSource
        from runtime.support.gl import offscreen_context

        self.stack, self.context = stack, offscreen_context()
        self.content = ProceduralSource(scene, stack=stack, context=self.context)

    def __enter__(self) -> PairPainter:
        return self

    def __exit__(self, *_: object) -> None:
        self.content.close()
        self.context.release()

    def draw(self, eye_m: ArrayLike, pixels_from_stack: F64, *, width_px: int, height_px: int) -> U8:
        """Draw the scene (h, w, 4) through any 3x4 projection from `stack` to the picture's pixels."""
        from runtime.content.base import View

        eye = np.asarray(eye_m, dtype=np.float64)
        return self.content.render(View(eye, 0, pixels_from_stack, width_px, height_px), time_ns=0).copy()

    def image(self, eye_m: ArrayLike, *, width_px: int, height_px: int, fov_deg: float = FOV_DEG) -> U8:
        """Draw the picture, shape (h, w, 3), that an eye sees when it looks at the stack's origin."""
        projection = image_from_stack(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
        return np.ascontiguousarray(self.draw(eye_m, projection, width_px=width_px, height_px=height_px)[..., :3])

    def pair(self, name: str, eyes_m: Eyes, *, fov_deg: float = FOV_DEG, off_mm: Sequence[float] = OFF_MM) -> StillPair:
        """Draw a pair at the panels' resolution, and targets for eyes moved to four sides by `off_mm`."""
        size = {"width_px": self.stack.width_px, "height_px": self.stack.height_px}
        left, right = (self.image(eye, **size, fov_deg=fov_deg) for eye in eyes_m)
        off = tuple(
            OffView(mm, place, self.image(place, **size, fov_deg=fov_deg))
            for mm in off_mm
            for eye in eyes_m
            for place in beside(eye, mm)
        )
        return StillPair(name, self.stack, eyes_m, (left, right), fov_deg, off)


PROCEDURAL = (
    ("demo", "objects, 0.6 m", {"distance_m": 0.6, "height_m": 0.05}),
    ("texture", "full texture, 0.45 m, 20 degrees", {"distance_m": 0.45, "angle_deg": 20.0}),
    ("demo", "objects, 1.2 m, 45 degrees", {"distance_m": 1.2, "angle_deg": -45.0, "height_m": 0.2}),
)


def procedural_pairs(stack: PanelStack) -> Iterator[StillPair]:
    """Draw the report's built-in pairs, which show two scenes from a total of three positions."""
    for scene, name, place in PROCEDURAL:
        with PairPainter(scene, stack) as painter:
            pair = painter.pair(name, eyes_at(**place))
        yield pair
