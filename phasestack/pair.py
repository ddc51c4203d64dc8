"""Solve pictures for a stack of panels, and measure the quality of any layers."""

from __future__ import annotations

import html
import math
import os
import sys
import tempfile
import time
import warnings
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import combinations
from pathlib import Path
from threading import RLock
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from phasestack.pictures import as_array, as_codes, as_numbers, as_picture
from phasestack.stack import checked_stack
from runtime.errors import InputError, ModelFailure
from runtime.evaluation.displayed import SIGMAS_MM, Picture, on_panels_raster
from runtime.evaluation.solved import PairQuality, SolvedPair
from runtime.model.job import VIEWS_MOST
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.sart import SartPredictor
from runtime.model.still import solve_still
from runtime.optics.cameras import as_cameras, doubts, looking_at_origin
from runtime.optics.disparity import disparity_doubts
from runtime.optics.real.light import RealSampling, Sight, real_light
from runtime.optics.real.panels import RealPanels
from runtime.optics.retina import sees_panels
from runtime.optics.stack import PanelStack
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8
from runtime.support.artifacts import OutputFolder, write_json
from runtime.support.ranges import EYE_MOST_M, FOV_RANGE_DEG, SEPARATION_MIN_M, refusal
from runtime.support.untrusted_input import checked_path

EVERY_LEAST = 20  # minimum number of pixels to sample along a picture's shorter side
STEPS_MOST = 1000  # maximum number of steps of a solution
FAINT_DB = 21.0  # light PSNR below which the eyes see obvious ghosts (as on the viewer page)
NOTED_EVERY = 8  # `Result.notes` is based on every 8th pixel of every 8th row
LEAST_APART_M = 0.0005  # minimum distance between two views' eyes if there are more than two
REAL_PIXELS = 20_000  # pixels of a picture that are measured on real panels, about
SAME_PLACE_M = 0.001  # maximum distance between an eye and its camera
_one_at_a_time = RLock()  # a loaded model reuses its buffers
# A fork waits for a solution of another thread. In the child, which has no other thread, the lock would never be free.
os.register_at_fork(
    before=_one_at_a_time.acquire, after_in_parent=_one_at_a_time.release, after_in_child=_one_at_a_time.release
)

Eyes = Sequence[Sequence[float]] | Sequence[F64] | F64
Pictures = Sequence[ArrayLike] | ArrayLike
Cameras = Sequence[Sequence[Sequence[float]]] | Sequence[F64] | F64


@dataclass(frozen=True)
class _Pair:
    """A call's validated arguments. The pictures are views from pinhole eyes that look at the stack's origin."""

    pictures: tuple[Picture, ...]
    eyes_m: F64
    stack: PanelStack
    fov_deg: float
    is_resampled: bool  # True if the caller gave cameras

    def judged(self, layers: U8) -> SolvedPair:
        """Combine layers with this request, to compute each eye's view of them and its quality."""
        return SolvedPair(layers, self.pictures, self.stack, self.eyes_m, self.fov_deg)


class Measuring(TypedDict, total=False):
    """Options that make a quality measurement faster."""

    sigmas_mm: Sequence[float]  # tracking errors to evaluate; each except 0 takes four more measurements
    every: int  # measure every Nth pixel of every Nth row; 1 measures all pixels


class Solving(TypedDict, total=False):
    """Further options of `solve`."""

    steps: int | None  # number of steps of a solution; None: the model's own
    floats: bool  # True: keep the layers also as they are before rounding (`Result.floats`)


class Result:
    """The layers computed for pictures, one for each eye. The result can also show each eye's view of
    the layers, measure the quality, and save everything to files.
    """

    layers: U8  # (panels, h, w, 3), rear to front
    floats: F32 | None  # (panels, h, w, 3) in 0..1, the layers before rounding; None without `floats=True`
    model: str  # name of the model used, with a note if its network does not support the stack
    eye_sigma_mm: float  # tracking error that the layers were computed for
    total_ms: float  # time the solver took, without loading the model

    def __init__(
        self, layers: U8, pair: _Pair, *, floats: F32 | None, model: str, eye_sigma_mm: float, total_ms: float
    ) -> None:
        self.layers, self.floats = layers, floats
        self.model, self.eye_sigma_mm, self.total_ms = model, eye_sigma_mm, total_ms
        self._asked = pair

    def __repr__(self) -> str:
        count, height, width = self.layers.shape[:3]
        return f"<phasestack.Result: {count} layers of {width}x{height} by {self.model}>"

    @property
    def quality(self) -> PairQuality:
        """Quality of the eyes' views, measured on first access, which may take longer than solving. A
        warning is issued for each known reason of ghosts.
        """
        self._warn()
        return self._pair.quality

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Warnings that the eyes will see ghosts, such as from too much disparity for the stack."""
        if self._doubts:
            return self._doubts
        every = max(1, min(NOTED_EVERY, min(self._asked.pictures[0].shape[:2]) // EVERY_LEAST))
        light_db = self._pair.sampled(sigmas_mm=[1.0], every=every).light_db.get("1", math.nan)
        return _ghosts(light_db, self._asked)

    @cached_property
    def _doubts(self) -> tuple[str, ...]:
        asked = self._asked
        if len(asked.pictures) != 2:
            return ()
        return tuple(
            disparity_doubts(
                asked.pictures, asked.eyes_m, asked.stack, fov_deg=asked.fov_deg, parallel=not asked.is_resampled
            )
        )

    def measure(self, **how: Unpack[Measuring]) -> PairQuality:
        """Measure the quality with options of `evaluate`, such as `measure(sigmas_mm=(1,), every=4)`. Raises
        ValueError, which names the option, if one is out of range.
        """
        self._warn()
        return _measured(self._pair, how)

    def _warn(self) -> None:
        for note in self._doubts:
            warnings.warn(note, stacklevel=3)

    @property
    def seen(self) -> U8:
        """The eyes' simulated views through the layers, as a (V, h, w, 3) array in the order of the pictures."""
        return np.stack(self._pair.seen)

    @cached_property
    def _pair(self) -> SolvedPair:
        return self._asked.judged(self.layers)

    @property
    def _line(self) -> str:
        line = f"model {self.model}, solved for a tracking error of {self.eye_sigma_mm:g} mm; "
        return line + f"PSNR with one ray per pixel, as published: {self._pair.quality.psnr_db:.1f} dB"

    def show(self) -> Path:
        """Open a browser page of layers and views, and return its temporary HTML file, which stays."""
        path = Path(tempfile.mkdtemp(prefix="phasestack-")) / "viewer.html"
        path.write_text(self._pair.viewer([self._line, *self.notes]), encoding="utf-8")
        if not webbrowser.open(path.as_uri()):
            print(f"no browser could be opened; open {path.as_uri()}", file=sys.stderr)
        return path

    def _repr_html_(self) -> str:
        """Return the viewer page as an HTML element, for notebooks to display."""
        page = html.escape(self._pair.viewer([self._line, *self.notes]))
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 640px; border: 0"></iframe>'

    def save(self, out: str | Path) -> None:
        """Write the files of `phasestack solve --out` to a folder."""
        told: dict[str, Any] = {"model": self.model, "eye_sigma_mm": self.eye_sigma_mm, "notes": self.notes}
        told["total_ms"] = round(self.total_ms, 3)
        try:
            with OutputFolder(checked_path(_folder(out))) as folder:
                self._pair.write(folder.staging, lines=[self._line, *self.notes], floats=self.floats)
                write_json(folder.staging / "solve.json", self._pair.quality.table() | told)
        except InputError as error:
            raise ValueError(f"out: {error}") from None


def _folder(out: Any) -> str:
    """Return a folder's path. Raises ValueError for anything else, such as an open file."""
    if not isinstance(out, str | os.PathLike) or not isinstance(os.fspath(out), str):
        raise ValueError(f"out: must be a folder, not {type(out).__name__}")
    return os.fspath(out)


def _ghosts(light_db: float, asked: _Pair) -> tuple[str, ...]:
    """Return a note if the light at the eyes is so poor that ghosts are obvious, otherwise none."""
    if not light_db < FAINT_DB:
        return ()
    count, views = asked.stack.count, len(asked.pictures)
    why = f"{count} panels cannot show {views} pictures as different as these"
    return (f"the eyes will see obvious ghosts: light is {light_db:.1f} dB at a tracking error of 1 mm, because {why}",)


def solve(
    left: Pictures,
    right: ArrayLike | None = None,
    *,
    stack: PanelStack,
    eyes_m: Eyes | None = None,
    fov_deg: float = 40.0,
    cameras: Cameras | None = None,
    model: str | Path = "balanced",
    eye_sigma_mm: float = 1.0,
    **how: Unpack[Solving],
) -> Result:
    """Compute the layers that show each eye its picture.

    `solve(left, right, ...)` serves one viewer, and `solve(pictures, ...)` any number of views: the first two are the
    first viewer's left and right eye, the next two the second viewer's. A stack shows about as many different pictures
    as it has panels. A warning is issued for each implausible argument.

    Args:
        left: Picture for the left eye: an array (h, w, 3 or 4) of uint8 or of floats in 0..1, or a Pillow image. It
            must be taken by a pinhole camera at the eye that looks at the stack's origin without roll. If `right` is
            omitted, a sequence of such pictures, all of the same size.
        right: Picture for the right eye, of the same size.
        eyes_m: Positions (V, 3) of the V pictures' eyes in metres, in the `stack` frame (+x out of the screen, +y to
            the viewer's right, +z up). Required unless `cameras` is given.
        fov_deg: The pictures' horizontal field of view, in degrees.
        cameras: 3x4 matrices for pictures taken by other pinhole cameras, such as parallel or shifted ones. Each
            matrix maps homogeneous metres in the `stack` frame to homogeneous pixels, with +u right, +v down and pixel
            centres at half-integers. It is K·[R | t] with OpenCV's axes; add half a pixel to the principal point if K
            assumes pixel centres at integers. The cameras replace `eyes_m` and `fov_deg`: the pictures are resampled to
            look at the stack's origin and to cover the panels before they are solved and measured.
        model: `fast`, `balanced`, `best`, `sart`, or the path to an ONNX file.
        eye_sigma_mm: Tracking error to allow for: 1 suits a good tracker, and 0 assumes exact positions.
        **how: `steps`, the number of updates of all panels after the network's proposal or, for `sart`, its iterations.
            By default, as many as the model was made for. `floats=True` also keeps the layers before rounding, as
            `Result.floats`; all pixels are then solved, even where this is unnecessary.

    Raises:
        ValueError: An argument is invalid. The message begins with the argument's name.
    """
    if unknown := sorted(how.keys() - Solving.__annotations__.keys()):
        raise TypeError(f"{unknown[0]}: unknown argument")
    pair = _checked(left, right, stack=stack, eyes_m=eyes_m, fov_deg=fov_deg, cameras=cameras)
    steps = how.get("steps")
    steps = None if steps is None else _whole("steps", steps, 0, STEPS_MOST)
    floats = how.get("floats", False)
    if not isinstance(floats, bool):
        raise ValueError(f"floats: must be True or False, not {floats!r}")
    eye_sigma_mm = _number("eye_sigma_mm", eye_sigma_mm, 0.0, 1000.0, "mm")
    with _one_at_a_time:
        try:
            name = _name_of(model)
            is_sart = steps is not None and name == "sart"
            predictor = SartPredictor(pair.stack, iterations=steps or 0) if is_sart else _loaded(name, pair.stack)
            start_ns = time.perf_counter_ns()
            codes = [as_codes(picture) for picture in pair.pictures]
            solved = solve_still(
                *codes,
                eyes_m=pair.eyes_m,
                fov_deg=pair.fov_deg,
                predictor=predictor,
                eye_sigma_mm=eye_sigma_mm,
                trimmed=True,
                steps=steps,
                floats=floats,
            )
            total_ms = (time.perf_counter_ns() - start_ns) / 1e6
            layers = np.ascontiguousarray(solved.layers[..., :3])
        except InputError as error:
            raise ValueError(str(error) if error.source == "model" else f"model: {error}") from None
        except ModelFailure as error:
            raise ValueError(f"eyes_m: {error}") from None
    name = predictor.name_with(len(codes))
    return Result(layers, pair, floats=solved.floats, model=name, eye_sigma_mm=eye_sigma_mm, total_ms=total_ms)


def evaluate(
    layers: ArrayLike,
    left: Pictures,
    right: ArrayLike | None = None,
    *,
    stack: PanelStack,
    eyes_m: Eyes | None = None,
    fov_deg: float = 40.0,
    cameras: Cameras | None = None,
    panels: RealPanels | None = None,
    **how: Unpack[Measuring],
) -> PairQuality:
    """Measure how well any layers show each eye its picture.

    Args:
        layers: Array (panels, h, w, 3 or 4) from rear to front, at the stack's resolution, of uint8 or of floats in
            0..1. A panel value v rotates the polarization by v·90 degrees, and an eye sees sin² of the sum of the
            angles along a ray. Floats are rounded to a panel's 8 bits.
        left: Picture that the left eye should see or, if `right` is omitted, all eyes' pictures, as in `solve`.
        right: Picture that the right eye should see, as in `solve`.
        eyes_m: Eye positions, as in `solve`.
        fov_deg: The pictures' horizontal field of view, in degrees.
        cameras: The pictures' cameras, as in `solve`.
        panels: Imperfections of real panels. Only `light_db` is then measured, for a tracking error of 1 mm and at some
            20,000 pixels unless `how` says otherwise; the other figures are NaN, and there is no standard error.
        **how: Options that make the measurement faster. `evaluate(..., sigmas_mm=(1,), every=4)` measures only a
        tracking error of 1 mm, at every 4th pixel of every 4th row, and also gives the light PSNR's standard error.
        SSIM is then NaN.

    Raises:
        ValueError: An argument is invalid. The message begins with the argument's name.
    """
    pair = _checked(left, right, stack=stack, eyes_m=eyes_m, fov_deg=fov_deg, cameras=cameras)
    given = as_array("layers", layers)
    wanted = (pair.stack.count, pair.stack.height_px, pair.stack.width_px)
    if given.ndim != 4 or given.shape[:3] != wanted or given.shape[3] not in (3, 4):
        last = given.ndim == 4 and given.shape[1] in (3, 4) and given.shape[3] not in (3, 4)
        advice = "; channels must come last, so pass np.moveaxis(layers, 1, -1)" if last else ""
        advice = "; for grey layers, pass np.stack([layers] * 3, -1)" if given.shape == wanted else advice
        raise ValueError(f"layers: must have shape {(*wanted, 3)}, but has shape {given.shape}{advice}")
    if np.issubdtype(given.dtype, np.floating) and 1 < given.max() <= np.pi / 2:
        raise ValueError(
            f"layers: values must be at most 1, but reach {given.max():g}; if they are angles in radians, divide them "
            "by pi/2"
        )
    codes = [as_codes(as_picture(f"layers[{n}]", layer[..., :3])) for n, layer in enumerate(given)]
    for n, layer in enumerate(codes):
        if pair.stack.is_grey(n) and np.ptp(layer, axis=2).max() > 0:
            raise ValueError(f"layers[{n}]: this panel has no colour filters, so its three channels must be equal")
    if panels is not None:
        return _on_real_panels(pair, np.stack(codes), panels, how)
    return _measured(pair.judged(np.stack(codes)), how)


def _on_real_panels(pair: _Pair, layers: U8, panels: RealPanels, how: Measuring) -> PairQuality:
    """Measure the light of layers on real panels. Raises as `_options` does, and if the panels do not fit the stack."""
    if not isinstance(panels, RealPanels):
        raise ValueError(f"panels: must be phasestack.RealPanels, not {type(panels).__name__}")
    targets = tuple(on_panels_raster(picture, pair.stack) for picture in pair.pictures)
    height, width = targets[0].shape[:2]
    usual: Measuring = {"sigmas_mm": (1.0,), "every": max(1, round(math.sqrt(height * width / REAL_PIXELS)))}
    sigmas, every = _options(targets, usual | how)
    sight = Sight(pair.eyes_m, targets, pair.fov_deg)
    light = {
        f"{sigma:g}": real_light(
            layers, pair.stack, panels, replace(sight, sigma_mm=sigma), RealSampling(step=every)
        ).light_db
        for sigma in sigmas
    }
    unknown = tuple(math.nan for _ in pair.eyes_m)
    return PairQuality(light, {}, math.nan, math.nan, unknown)


def _measured(pair: SolvedPair, how: Measuring) -> PairQuality:
    """Measure all or the requested figures. Raises as `_options` does."""
    if not how:
        return pair.quality
    sigmas, every = _options(pair.pictures, how)
    return pair.sampled(sigmas_mm=sigmas, every=every)


def _options(pictures: Sequence[Picture], how: Measuring) -> tuple[list[float], int]:
    """Return the tracking errors and the step between measured pixels. Raises TypeError for an unknown option, and
    ValueError if a value is out of range.
    """
    if unknown := sorted(how.keys() - Measuring.__annotations__.keys()):
        raise TypeError(f"{unknown[0]}: unknown argument; use {' or '.join(Measuring.__annotations__)}")
    sigmas_mm, every = how.get("sigmas_mm", SIGMAS_MM), how.get("every", 1)
    if not isinstance(sigmas_mm, Sequence) or not sigmas_mm:
        raise ValueError(f"sigmas_mm: must be a sequence of tracking errors in mm such as (1,), not {sigmas_mm!r}")
    sigmas = [_number("sigmas_mm", sigma_mm, 0.0, 1000.0, "mm") for sigma_mm in sigmas_mm]
    most = min(pictures[0].shape[:2]) // EVERY_LEAST
    return sigmas, _whole("every", every, 1, most)


def camera(eye_m: Sequence[float] | F64, *, width_px: int, height_px: int, fov_deg: float = 40.0) -> F64:
    """Return the 3x4 matrix of the pinhole camera that `solve` assumes by default at an eye in `stack`.

    The camera looks at the stack's origin, and its pixel rows are parallel to the ground. The matrix maps homogeneous
    metres in the `stack` frame to homogeneous pixels; their third coordinate is the distance along the gaze, in metres.
    Raises ValueError, which begins with an argument's name.
    """
    sizes = {"width_px": width_px, "height_px": height_px}
    for name, size in sizes.items():
        if not _number(name, size, 1, 1 << 16, "pixels").is_integer():
            raise ValueError(f"{name}: is {size!r}, not a whole number of pixels")
    eye = as_numbers("eye_m", eye_m, "must be three numbers in metres")
    if eye.shape != (3,) or not np.isfinite(eye).all() or not eye.any():
        raise ValueError("eye_m: must be three finite numbers (in metres), not all zero")
    return image_from_stack(eye, fov_deg=_number("fov_deg", fov_deg, *FOV_RANGE_DEG, "degrees"), **sizes)


def project(
    points_m: ArrayLike, *, eye_m: Sequence[float] | F64, width_px: int, height_px: int, fov_deg: float = 40.0
) -> F64:
    """Project points (..., 3) in `stack` to pixels (..., 2) of an eye's picture, NaN behind the eye.
    `fov_deg` is horizontal. Raises ValueError, which begins with an argument's name.
    """
    points = as_numbers("points_m", points_m, "must be numbers in metres")
    if points.ndim < 1 or points.shape[-1] != 3:
        raise ValueError(f"points_m: must have shape (..., 3), but has shape {points.shape}")
    matrix = camera(eye_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)
    seen = points @ matrix[:, :3].T + matrix[:, 3]
    depth = np.where(seen[..., 2:] > 0, seen[..., 2:], np.nan)
    return np.asarray(seen[..., :2] / depth)


def _named(left: Any, right: Any) -> dict[str, Any]:
    """Return the given pictures by the names to use in error messages. Raises ValueError for their number."""
    if right is not None:
        return {"left": left, "right": right}
    if not isinstance(left, Sequence) and getattr(left, "ndim", 0) != 4:
        raise ValueError("right: is required, unless the first argument is a sequence of pictures")
    if isinstance(left, str) or not 1 <= len(left) <= VIEWS_MOST:
        raise ValueError(f"pictures: must be a sequence of 1 to {VIEWS_MOST} pictures")
    return {f"pictures[{n}]": picture for n, picture in enumerate(left)}


def _checked(
    left: Any, right: Any, *, stack: PanelStack, eyes_m: Eyes | None, fov_deg: float, cameras: Cameras | None
) -> _Pair:
    """Validate the arguments of `solve`, and resample pictures taken by other cameras. Raises ValueError."""
    given = _named(left, right)
    first, *_ = given
    pictures = [as_picture(name, picture) for name, picture in given.items()]
    for name, picture in zip(given, pictures, strict=True):
        if picture.shape != pictures[0].shape:
            raise ValueError(
                f"{name}: must have the same shape as {first} ({pictures[0].shape}), but has shape {picture.shape}"
            )
    stack = checked_stack(stack)
    fov_deg = _number("fov_deg", fov_deg, *FOV_RANGE_DEG, "degrees")
    if cameras is None:
        if eyes_m is None:
            raise ValueError(
                "eyes_m: is required without cameras; pass the positions of the left and right eyes in metres"
            )
        eyes = _eyes(eyes_m, stack, count=len(pictures))
    else:
        matrices_given = as_numbers("cameras", cameras, "must be 3x4 matrices, one for each picture")
        try:
            matrices, places_m = as_cameras(matrices_given, count=len(pictures))
            eyes = _eyes(places_m, stack, count=len(pictures))
            if eyes_m is not None and np.abs(_eyes(eyes_m, stack, count=len(pictures)) - eyes).max() > SAME_PLACE_M:
                raise ValueError(f"are at {np.round(eyes, 4).tolist()}, which contradicts eyes_m; omit eyes_m")
            pictures, fov_deg = looking_at_origin(pictures, matrices, eyes, stack)
        except ValueError as error:
            raise ValueError(f"cameras: {error}") from None
    for line in doubts(eyes, stack, fov_deg=fov_deg, size=(pictures[0].shape[1], pictures[0].shape[0])):
        warnings.warn(line, stacklevel=3)
    pair = _Pair(tuple(pictures), eyes, stack, fov_deg, is_resampled=cameras is not None)
    if not all(sees_panels(eye, stack, fov_deg=fov_deg) for eye in eyes):
        raise ValueError(
            "eyes_m: at least one eye cannot see any part of the display; move the eyes in front of the panels"
        )
    return pair


def _number(name: str, given: Any, low: float, high: float, unit: str) -> float:
    """Return a number as a float. Raises ValueError unless it is a number from `low` to `high`."""
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


def _whole(name: str, value: Any, least: int, most: int) -> int:
    """Return a whole number from `least` to `most`. Raises ValueError for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise ValueError(f"{name}: must be a whole number from {least} to {most}, not {value!r}")
    return int(value)


def _eyes(eyes_m: Any, stack: PanelStack, *, count: int) -> F64:
    """Return the eyes (count, 3). Raises ValueError if they are not finite points in front, apart and near enough."""
    points = "two points" if count == 2 else f"{count} points, one for each picture,"
    eyes = as_numbers("eyes_m", eyes_m, f"must be {points} of three numbers in metres")
    if eyes.shape != (count, 3) or not np.isfinite(eyes).all():
        raise ValueError(f"eyes_m: must be {points} of three finite numbers in metres; the shape is {eyes.shape}")
    if np.abs(eyes).max() > EYE_MOST_M:
        raise ValueError(f"eyes_m: {refusal(float(np.abs(eyes).max()), -EYE_MOST_M, EYE_MOST_M, 'm')}")
    if eyes[:, 0].min() <= stack.x_m[-1]:
        raise ValueError(
            f"eyes_m: x = {eyes[:, 0].min():g} m is not in front of the panels; x must exceed {stack.x_m[-1]:g} m"
        )
    apart_m = min((float(np.linalg.norm(a - b)) for a, b in combinations(eyes, 2)), default=np.inf)
    least_m = SEPARATION_MIN_M if count == 2 else LEAST_APART_M
    if apart_m < least_m:
        raise ValueError(f"eyes_m: the eyes are {apart_m * 1e3:g} mm apart, but the minimum is {least_m * 1e3:g} mm")
    return eyes
