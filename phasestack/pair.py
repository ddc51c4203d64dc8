"""Functions that solve pairs of pictures, and measure the quality of any layers."""

from __future__ import annotations

import html
import os
import sys
import tempfile
import time
import warnings
import webbrowser
from collections.abc import Iterable, Iterator, Sequence, Sized
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path
from threading import Lock
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from phasestack.pictures import as_array, as_codes, as_picture
from phasestack.stack import checked_stack
from runtime.errors import InputError, ModelFailure
from runtime.evaluation.displayed import SIGMAS_MM, Picture
from runtime.evaluation.solved import PairQuality, SolvedPair
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.optics.cameras import as_cameras, doubts, looking_at_origin
from runtime.optics.disparity import disparity_doubts
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F64, U8
from runtime.support.artifacts import OutputFolder, write_json
from runtime.support.progress import ShownProgress
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG, SEPARATION_MIN_M, refusal

EVERY_LEAST = 20  # minimum number of sampled pixels along the shorter side of a picture
SAME_PLACE_M = 0.001  # maximum distance between an eye and its camera
_one_at_a_time = Lock()  # a loaded model reuses its buffers

Eyes = Sequence[Sequence[float]] | Sequence[F64] | F64
Cameras = Sequence[Sequence[Sequence[float]]] | Sequence[F64] | F64


@dataclass(frozen=True)
class _Pair:
    """Validated request, with pictures as seen by pinhole eyes that look at the stack's origin."""

    pictures: tuple[Picture, ...]
    eyes_m: F64
    stack: PanelStack
    fov_deg: float
    is_resampled: bool  # True if the caller gave cameras

    def judged(self, layers: U8) -> SolvedPair:
        """Return the layers with the views that both eyes have of them."""
        return SolvedPair(layers, self.pictures, self.stack, self.eyes_m, self.fov_deg)


class Measuring(TypedDict, total=False):
    """Options for a faster measurement of quality."""

    sigmas_mm: Sequence[
        float
    ]  # tracking errors to measure, 0, 1 and 2 by default; each except 0 takes four more measurements
    every: int  # N: measure every Nth pixel of every Nth row; 1: all pixels


class Result:
    """Layers for a pair of pictures, with the views of both eyes and their quality."""

    layers: U8  # (panels, h, w, 3), rear to front
    model: str  # name of the model used; `sart` if the networks do not support the stack
    eye_sigma_mm: float
    total_ms: float  # time that this call took

    def __init__(self, layers: U8, pair: _Pair, *, model: str, eye_sigma_mm: float, total_ms: float) -> None:
        self.layers, self.model, self.eye_sigma_mm, self.total_ms = layers, model, eye_sigma_mm, total_ms
        self._asked = pair

    def __repr__(self) -> str:
        count, height, width = self.layers.shape[:3]
        return f"<phasestack.Result: {count} layers of {width}x{height} by {self.model}>"

    @property
    def quality(self) -> PairQuality:
        """Quality of the eyes' views. Measured on first access, which may take longer than solving.

        Warns if `notes` explains why the quality is poor.
        """
        self._warn()
        return self._pair.quality

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Reasons why the eyes see ghosts, if the disparity of the pictures explains them."""
        asked = self._asked
        return tuple(
            disparity_doubts(
                asked.pictures, asked.eyes_m, asked.stack, fov_deg=asked.fov_deg, parallel=not asked.is_resampled
            )
        )

    def measure(self, **how: Unpack[Measuring]) -> PairQuality:
        """Measure quality faster: `measure(sigmas_mm=(1,), every=4)`. Raises ValueError, naming the argument."""
        self._warn()
        return _measured(self._pair, how)

    def _warn(self) -> None:
        for note in self.notes:
            warnings.warn(note, stacklevel=3)

    @property
    def seen(self) -> U8:
        """Views of the eyes (2, h, w, 3), left first."""
        return np.stack(self._pair.seen)

    @cached_property
    def _pair(self) -> SolvedPair:
        return self._asked.judged(self.layers)

    @property
    def _line(self) -> str:
        line = f"model {self.model}, solved for a tracking error of {self.eye_sigma_mm:g} mm; "
        return line + f"PSNR with one ray per pixel, as published: {self._pair.quality.psnr_db:.1f} dB"

    def show(self) -> Path:
        """Open the solution's viewer in a browser. Returns the path of its file, which is not deleted."""
        path = Path(tempfile.mkdtemp(prefix="phasestack-")) / "viewer.html"
        path.write_text(self._pair.viewer([self._line, *self.notes]), encoding="utf-8")
        webbrowser.open(path.as_uri())
        return path

    def _repr_html_(self) -> str:
        """Return the viewer as HTML, for a notebook."""
        page = html.escape(self._pair.viewer([self._line, *self.notes]))
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 640px; border: 0"></iframe>'

    def save(self, out: str | Path) -> None:
        """Write the files of `phasestack solve --out`: layers, views, contact sheet, viewer, solve.json."""
        with OutputFolder(Path(out)) as folder:
            self._pair.write(folder.staging, lines=[self._line, *self.notes])
            told: dict[str, Any] = {"model": self.model, "eye_sigma_mm": self.eye_sigma_mm, "notes": self.notes}
            told["total_ms"] = round(self.total_ms, 3)
            write_json(folder.staging / "solve.json", self._pair.quality.table() | told)


def solve(
    left: ArrayLike,
    right: ArrayLike,
    *,
    stack: PanelStack,
    eyes_m: Eyes | None = None,
    fov_deg: float = 40.0,
    cameras: Cameras | None = None,
    model: str | Path = "balanced",
    eye_sigma_mm: float = 1.0,
) -> Result:
    """Compute layers that show each eye its picture.

    left, right: (h, w, 3 or 4), uint8 or float in 0..1, or Pillow images, as seen by a pinhole camera at each eye. The
    cameras look at the stack's origin, are not rolled, and have a horizontal field of view of `fov_deg`.
    eyes_m: left and right eye in metres, frame `stack` (+x out of the screen, +y the viewer's right, +z up).
    cameras: for pictures of other pinhole cameras (parallel, shifted), two 3x4 matrices from homogeneous metres of the
    stack's frame to pixels, +u right, +v down, pixel centres at half-integers: K·[R | t] with OpenCV's axes, plus half
    a pixel on K's principal point if its pixel centres are integers. They replace `eyes_m` and `fov_deg`; the pictures
    solved for and measured are then resampled to look at the stack's origin and to cover the panels.
    model: fast, balanced, best, sart or an ONNX file. eye_sigma_mm: tracking error, 1 for a good tracker, 0 for none.
    Raises ValueError, naming the argument. Warns about implausible arguments.
    """
    pair = _checked((left, right), stack=stack, eyes_m=eyes_m, fov_deg=fov_deg, cameras=cameras)
    eye_sigma_mm = _number("eye_sigma_mm", eye_sigma_mm, 0.0, 1000.0, "mm")
    with _one_at_a_time:
        try:
            predictor = _loaded(_name_of(model), pair.stack)
            start_ns = time.perf_counter_ns()
            codes = [as_codes(picture) for picture in pair.pictures]
            solved = solve_still(
                *codes,
                eyes_m=pair.eyes_m,
                fov_deg=pair.fov_deg,
                predictor=predictor,
                eye_sigma_mm=eye_sigma_mm,
                trimmed=True,
            )
            total_ms = (time.perf_counter_ns() - start_ns) / 1e6
            layers = np.ascontiguousarray(solved.layers[..., :3])
        except InputError as error:
            raise ValueError(str(error) if error.source == "model" else f"model: {error}") from None
        except ModelFailure as error:
            raise ValueError(f"eyes_m: {error}") from None
    return Result(layers, pair, model=predictor.name, eye_sigma_mm=eye_sigma_mm, total_ms=total_ms)


def solve_each(
    pairs: Iterable[tuple[ArrayLike, ArrayLike, Eyes]],
    *,
    stack: PanelStack,
    fov_deg: float = 40.0,
    model: str | Path = "balanced",
    eye_sigma_mm: float = 1.0,
    progress: bool = True,
) -> Iterator[Result]:
    """Yield a result for each pair (left picture, right picture, eyes_m). Other arguments: see `solve`.

    Pairs are read one by one, so `pairs` may be a generator. progress: show progress on stderr. Raises ValueError,
    naming the pair and the argument.
    """
    total = len(pairs) if isinstance(pairs, Sized) else None
    solve_one = partial(solve, stack=stack, fov_deg=fov_deg, model=model, eye_sigma_mm=eye_sigma_mm)
    shown = ShownProgress(sys.stderr) if progress else None
    try:
        for number, (left, right, eyes_m) in enumerate(pairs):
            if shown is not None:
                shown("solving", number, total)
            try:
                result = solve_one(left, right, eyes_m=eyes_m)
            except ValueError as error:
                raise ValueError(f"pairs[{number}]: {error}") from None
            yield result
    finally:
        if shown is not None:
            shown("", 0, None)


def evaluate(
    layers: ArrayLike,
    left: ArrayLike,
    right: ArrayLike,
    *,
    stack: PanelStack,
    eyes_m: Eyes | None = None,
    fov_deg: float = 40.0,
    cameras: Cameras | None = None,
    **how: Unpack[Measuring],
) -> PairQuality:
    """Measure the quality of any layers for two eyes, against their target pictures.

    layers: (panels, h, w, 3 or 4), rear to front, in the stack's pixels, uint8 or float in 0..1: a panel of value v
        rotates the polarization by v·90 degrees, and an eye sees sin² of the summed angle; floats are rounded to the
        panels' 8 bits.
    sigmas_mm, every: `evaluate(..., sigmas_mm=(1,), every=4)` is faster. It measures light PSNR for these tracking
        errors alone, at every 4th pixel of every 4th row, with its standard error; SSIM is then NaN.

    For the other arguments see `solve`. Raises ValueError, naming the argument.
    """
    pair = _checked((left, right), stack=stack, eyes_m=eyes_m, fov_deg=fov_deg, cameras=cameras)
    given = as_array("layers", layers)
    wanted = (pair.stack.count, pair.stack.height_px, pair.stack.width_px)
    if given.ndim != 4 or given.shape[:3] != wanted or given.shape[3] not in (3, 4):
        last = given.ndim == 4 and given.shape[1] in (3, 4) and given.shape[3] not in (3, 4)
        advice = "; channels must come last, so pass np.moveaxis(layers, 1, -1)" if last else ""
        advice = "; for grey layers, pass np.stack([layers] * 3, -1)" if given.shape == wanted else advice
        raise ValueError(f"layers: must have the shape {(*wanted, 3)}, not {given.shape}{advice}")
    if np.issubdtype(given.dtype, np.floating) and 1 < given.max() <= np.pi / 2:
        raise ValueError(
            f"layers: values must be at most 1, not {given.max():g}; if they are angles in radians, divide by pi/2"
        )
    codes = [as_codes(as_picture(f"layers[{n}]", layer[..., :3])) for n, layer in enumerate(given)]
    return _measured(pair.judged(np.stack(codes)), how)


def _measured(pair: SolvedPair, how: Measuring) -> PairQuality:
    """Measure all figures of quality, or those requested. Raises ValueError, naming the argument."""
    if unknown := sorted(how.keys() - Measuring.__annotations__.keys()):
        raise TypeError(f"{unknown[0]}: unknown argument; use {' or '.join(Measuring.__annotations__)}")
    if not how:
        return pair.quality
    sigmas_mm, every = how.get("sigmas_mm", SIGMAS_MM), how.get("every", 1)
    if not isinstance(sigmas_mm, Sequence) or not sigmas_mm:
        raise ValueError(f"sigmas_mm: must be a sequence of tracking errors in mm such as (1,), not {sigmas_mm!r}")
    sigmas = [_number("sigmas_mm", sigma_mm, 0.0, 1000.0, "mm") for sigma_mm in sigmas_mm]
    most = min(pair.pictures[0].shape[:2]) // EVERY_LEAST
    if isinstance(every, bool) or not isinstance(every, int | np.integer) or not 1 <= every <= most:
        raise ValueError(f"every: must be a whole number of pixels from 1 to {most}, not {every!r}")
    return pair.sampled(sigmas_mm=sigmas, every=int(every))


def camera(eye_m: Sequence[float] | F64, *, width_px: int, height_px: int, fov_deg: float = 40.0) -> F64:
    """Return the pinhole camera (3, 4) at an eye, from homogeneous metres to homogeneous pixels.

    It looks at the stack's origin, with x parallel to the ground, and is the default for pictures.

    The third coordinate is the distance along the gaze. Raises ValueError, naming the argument.
    """
    sizes = {"width_px": width_px, "height_px": height_px}
    for name, size in sizes.items():
        _number(name, size, 1, 1 << 16, "pixels")
    eye = np.asarray(eye_m, np.float64)
    if eye.shape != (3,) or not np.isfinite(eye).all() or not eye.any():
        raise ValueError("eye_m: must be three finite numbers in metres that are not all 0")
    return image_from_stack(eye, fov_deg=_number("fov_deg", fov_deg, *FOV_RANGE_DEG, "degrees"), **sizes)


def project(
    points_m: ArrayLike, *, eye_m: Sequence[float] | F64, width_px: int, height_px: int, fov_deg: float = 40.0
) -> F64:
    """Project points (..., 3), frame `stack`, to (..., 2) pixels of an eye's picture; NaN behind the eye.

    Raises ValueError, naming the argument.
    """
    points = np.asarray(points_m, np.float64)
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"points_m: must have the shape (..., 3), not {points.shape}")
    matrix = camera(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    seen = points @ matrix[:, :3].T + matrix[:, 3]
    depth = np.where(seen[..., 2:] > 0, seen[..., 2:], np.nan)
    return np.asarray(seen[..., :2] / depth)


def _checked(
    given: tuple[ArrayLike, ArrayLike],
    *,
    stack: PanelStack,
    eyes_m: Eyes | None,
    fov_deg: float,
    cameras: Cameras | None,
) -> _Pair:
    """Raises ValueError, naming the argument."""
    pictures = [as_picture(name, picture) for name, picture in zip(("left", "right"), given, strict=True)]
    if pictures[0].shape != pictures[1].shape:
        raise ValueError(f"right: must have the same shape as left, {pictures[0].shape}, not {pictures[1].shape}")
    stack = checked_stack(stack)
    fov_deg = _number("fov_deg", fov_deg, *FOV_RANGE_DEG, "degrees")
    if cameras is None:
        if eyes_m is None:
            raise ValueError("eyes_m: is required without cameras; pass the left and right eye in metres")
        eyes = _eyes(eyes_m, stack)
    else:
        try:
            matrices, places_m = as_cameras(cameras)
            eyes = _eyes(places_m, stack)
            if eyes_m is not None and np.abs(_eyes(eyes_m, stack) - eyes).max() > SAME_PLACE_M:
                raise ValueError(f"are at {np.round(eyes, 4).tolist()}, which contradicts eyes_m; omit eyes_m")
            pictures, fov_deg = looking_at_origin(pictures, matrices, eyes, stack)
        except ValueError as error:
            raise ValueError(f"cameras: {error}") from None
    for line in doubts(eyes, stack, fov_deg=fov_deg, size=(pictures[0].shape[1], pictures[0].shape[0])):
        warnings.warn(line, stacklevel=3)
    pair = _Pair(tuple(pictures), eyes, stack, fov_deg, is_resampled=cameras is not None)
    black = np.zeros((stack.count, stack.height_px, stack.width_px, 3), np.uint8)
    if not all(seen_by(eye, black, stack, fov_deg=fov_deg, width_px=64, height_px=64).mask.any() for eye in eyes):
        raise ValueError("eyes_m: an eye cannot see any part of the display; move the eyes in front of the panels")
    return pair


def _number(name: str, given: Any, low: float, high: float, unit: str) -> float:
    """Raises ValueError, naming the argument."""
    if isinstance(given, bool) or not isinstance(given, int | float | np.integer | np.floating):
        raise ValueError(f"{name}: must be a number of {unit}, not {given!r}")
    if problem := refusal(float(given), low, high, unit):
        raise ValueError(f"{name}: {problem}")
    return float(given)


def _name_of(model: Any) -> str:
    if not isinstance(model, str | os.PathLike):
        raise ValueError(f"model: must be fast, balanced, best, sart or an ONNX file, not {model!r}")
    return os.fspath(model)


@lru_cache(maxsize=2)
def _loaded(model: str, stack: PanelStack) -> Predictor:
    return load_predictor(model, stack)


def _eyes(eyes_m: Any, stack: PanelStack) -> F64:
    """Return the (2, 3) eyes if the display can serve them. Raises ValueError."""
    try:
        eyes = np.asarray(eyes_m, np.float64)
    except (TypeError, ValueError):
        raise ValueError("eyes_m: must be two points of three numbers in metres") from None
    if eyes.shape != (2, 3) or not np.isfinite(eyes).all():
        raise ValueError(f"eyes_m: must be two points of three finite numbers in metres; the shape is {eyes.shape}")
    if np.abs(eyes).max() > EYE_MOST_M:
        raise ValueError(f"eyes_m: {refusal(float(np.abs(eyes).max()), -EYE_MOST_M, EYE_MOST_M, 'm')}")
    if eyes[:, 0].min() <= stack.x_m[-1]:
        raise ValueError(
            f"eyes_m: x = {eyes[:, 0].min():g} m is not in front of the panels; x must exceed {stack.x_m[-1]:g} m"
        )
    apart_m = float(np.linalg.norm(eyes[0] - eyes[1]))
    if apart_m < SEPARATION_MIN_M:
        raise ValueError(f"eyes_m: the eyes are {apart_m * 1e3:g} mm apart, but the minimum is 5 mm")
    return eyes
