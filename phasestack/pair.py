"""Two pictures, two eyes and a stack of panels to layers, from Python."""

from __future__ import annotations

import html
import tempfile
import time
import webbrowser
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from phasestack.pictures import as_codes, as_picture
from runtime.config import StackGeometry, validated
from runtime.errors import InputError, ModelFailure
from runtime.evaluation.solved import PairQuality, SolvedPair, judged
from runtime.model.job import Job
from runtime.model.predictor import Predictor, load_predictor
from runtime.model.still import solve_still
from runtime.model.trim import Scene, trim
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.artifacts import OutputFolder, write_json
from runtime.support.ranges import FOV_RANGE_DEG

SEPARATION_MIN_M = 0.005
_one_at_a_time = Lock()  # a loaded model has buffers of its own


@dataclass(frozen=True, slots=True)
class Result:
    """Layers for a pair of pictures, and what the eyes make of them."""

    layers: U8  # (panels, h, w, 3), rear to front
    quality: PairQuality
    model: str  # what solved: a stack that the networks do not serve is solved by `sart`
    eye_sigma_mm: float
    total_ms: float  # of this one call, its first-time compiling included
    _pair: SolvedPair

    @property
    def seen(self) -> U8:
        """(2, h, w, 3): what each eye sees, left first."""
        return np.stack(self._pair.seen)

    @property
    def _line(self) -> str:
        line = f"model {self.model}, solved for eyes unsure by {self.eye_sigma_mm:g} mm; "
        return line + f"one ray a pixel, as published: {self.quality.psnr_db:.1f} dB"

    def show(self) -> Path:
        """Open the solution's viewer in a browser; answers its file, which stays."""
        path = Path(tempfile.mkdtemp(prefix="phasestack-")) / "viewer.html"
        path.write_text(self._pair.viewer([self._line]), encoding="utf-8")
        webbrowser.open(path.as_uri())
        return path

    def _repr_html_(self) -> str:
        """What a notebook shows of it: the viewer."""
        page = html.escape(self._pair.viewer([self._line]))
        return f'<iframe srcdoc="{page}" style="width: 100%; height: 640px; border: 0"></iframe>'

    def save(self, out: str | Path) -> None:
        """Write what `phasestack solve --out` leaves: layers, pictures, contact sheet, viewer, solve.json."""
        with OutputFolder(Path(out)) as folder:
            self._pair.write(folder.staging, lines=[self._line])
            told = {"model": self.model, "eye_sigma_mm": self.eye_sigma_mm, "total_ms": round(self.total_ms, 3)}
            write_json(folder.staging / "solve.json", self.quality.table() | told)


def solve(
    left: ArrayLike,
    right: ArrayLike,
    *,
    eyes_m: Sequence[Sequence[float]] | F64,
    stack: PanelStack,
    fov_deg: float = 40.0,
    model: str = "balanced",
    eye_sigma_mm: float = 1.0,
) -> Result:
    """Layers with which two eyes see two pictures.

    left, right: (h, w, 3 or 4), uint8 or float in 0..1, as wide as `fov_deg`. eyes_m: left and right eye, metres, frame
    `stack` (+x out of the screen, +y the viewer's right, +z up). model: fast, balanced, best, sart or an ONNX file.
    eye_sigma_mm: how unsure the eyes are; 1: a pupil; 0: two points. Raises ValueError, naming the argument.
    """
    pictures = [as_picture("left", left), as_picture("right", right)]
    if pictures[0].shape != pictures[1].shape:
        raise ValueError(f"right: is {pictures[1].shape}, left is {pictures[0].shape}")
    if not FOV_RANGE_DEG[0] <= fov_deg <= FOV_RANGE_DEG[1]:
        raise ValueError(f"fov_deg: {fov_deg:g} is not within {FOV_RANGE_DEG[0]:g} and {FOV_RANGE_DEG[1]:g}")
    if not 0 <= eye_sigma_mm <= 1000:
        raise ValueError(f"eye_sigma_mm: {eye_sigma_mm:g} is not within 0 and 1000")
    eyes = _eyes(eyes_m, _checked(stack))
    with _one_at_a_time:
        try:
            predictor = _loaded(model, stack)
            start_ns = time.perf_counter_ns()
            codes = [as_codes(picture) for picture in pictures]

            def trimmed(job: Job) -> Job:
                return trim(job, Scene(stack))[0] if predictor.trims else job

            solved = solve_still(
                *codes, eyes_m=eyes, fov_deg=fov_deg, predictor=predictor, eye_sigma_mm=eye_sigma_mm, changed=trimmed
            )
            total_ms = (time.perf_counter_ns() - start_ns) / 1e6
            layers = np.ascontiguousarray(solved.layers[..., :3])
        except InputError as error:
            raise ValueError(f"model: {error}") from None
        except ModelFailure as error:
            raise ValueError(f"eyes_m: {error}") from None
    try:
        pair = judged(layers, pictures, stack, eyes_m=eyes, fov_deg=fov_deg)
    except ValueError as error:
        raise ValueError(f"eyes_m: {error}: nothing of the display can be seen from there") from None
    return Result(layers, pair.quality, predictor.name, eye_sigma_mm, total_ms, pair)


@lru_cache(maxsize=2)
def _loaded(model: str, stack: PanelStack) -> Predictor:
    return load_predictor(model, stack)


def _checked(stack: PanelStack) -> PanelStack:
    """Raises ValueError, naming the field, for what is no stack of panels."""
    if not isinstance(stack, PanelStack):
        raise ValueError(f"stack: is a {type(stack).__name__}, not a phasestack.Stack")
    fields = {name: getattr(stack, name) for name in ("width_m", "height_m", "x_m", "width_px", "height_px")}
    try:
        validated(StackGeometry, fields, source="stack")
    except InputError as error:
        raise ValueError(str(error)) from None
    return stack


def _eyes(eyes_m: Any, stack: PanelStack) -> F64:
    """(2, 3) eyes that can be served."""
    try:
        eyes = np.asarray(eyes_m, np.float64)
    except (TypeError, ValueError):
        raise ValueError("eyes_m: must be two points of three numbers, metres") from None
    if eyes.shape != (2, 3) or not np.isfinite(eyes).all():
        raise ValueError("eyes_m: must be two points of three finite numbers, metres")
    if eyes[:, 0].min() <= stack.x_m[-1]:
        raise ValueError(f"eyes_m: x = {eyes[:, 0].min():g} m is not in front of the panels (x > {stack.x_m[-1]:g})")
    apart_m = float(np.linalg.norm(eyes[0] - eyes[1]))
    if apart_m < SEPARATION_MIN_M:
        raise ValueError(f"eyes_m: are {apart_m * 1e3:g} mm apart; 5 mm is the least")
    return eyes
