"""How well pupils are found: a folder of faces whose pupils are known, seen by simulated cameras.

`truth.json` in the folder lists objects with `file`, `left` and `right` (the viewer's, continuous pixels), and, where
it is known, `yaw_deg`, by which the head is turned. Errors are millimetres at eyes that are 63 mm apart.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from math import cos, pi, radians, sin, tan
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_S
from runtime.errors import InputError
from runtime.eyes.networks import resampled
from runtime.eyes.pupils import PupilFinder, Pupils
from runtime.records import F64, U8
from runtime.support import untrusted_input
from runtime.support.artifacts import read_image
from runtime.support.figures import lines_of

EYE_DISTANCE_M = 0.063
FOV_DEG = 65.0
WIDTH_PX, HEIGHT_PX = 640, 480
FOCAL_PX = WIDTH_PX / 2 / tan(radians(FOV_DEG) / 2)
CASES = ((0.5, 1.0), (0.75, 1.0), (0.75, 0.25), (1.0, 1.0), (1.5, 1.0))  # m, light
RIGHT_WITHIN_MM = 12.0  # both eyes: else it is not this face that was found
NOISE = 3.0  # codes
STEADY_M = 0.75
FRAMES, SETTLED, RATE_HZ = 40, 8, 30.0
TRACKS_MAX = 12  # faces that are followed


@dataclass(frozen=True, slots=True)
class Face:
    """A picture with known pupils."""

    picture: U8
    pupils: F64  # (2, 2) left, right; px
    foreshortening: float  # of the line between the eyes, by the head's turn


def read_faces(folder: Path) -> list[Face]:
    """Raises InputError, naming the file and the field."""
    path, faces = folder / "truth.json", []
    rows = untrusted_input.read_json(path)
    if not isinstance(rows, list) or not rows:
        raise InputError(path, "", "must be a list of faces")
    for number, row in enumerate(rows):
        try:
            pupils = np.array([row["left"], row["right"]], np.float64).reshape(2, 2)
            name, yaw = str(row["file"]), float(row.get("yaw_deg", 0.0))
        except (KeyError, TypeError, ValueError, AttributeError):
            raise InputError(path, f"{number}", "must have file, left: [x, y] and right: [x, y]") from None
        faces.append(Face(read_image(folder / name), pupils, max(cos(radians(yaw)), 0.3)))
    return faces


def seen_by_camera(
    face: Face, distance_m: float, *, light: float = 1.0, shift_px: tuple[float, float] = (0.0, 0.0), seed: int = 0
) -> tuple[U8, F64]:
    """The camera's picture of a face at a distance, and its pupils in it. light: of that in the face's picture."""
    scale = FOCAL_PX * EYE_DISTANCE_M / distance_m * face.foreshortening
    scale /= float(np.linalg.norm(face.pupils[0] - face.pupils[1]))
    middle = np.array([WIDTH_PX / 2, HEIGHT_PX / 2]) + shift_px
    pupils = scale * (face.pupils - face.pupils.mean(axis=0)) + middle
    return picture_at(face, pupils, light=light, seed=seed), pupils


def picture_at(face: Face, pupils: F64, *, light: float = 1.0, seed: int = 0) -> U8:
    """The camera's picture of a face whose pupils are at (2, 2) continuous pixels of it."""
    before, after = (complex(*(points[0] - points[1])) for points in (face.pupils, pupils))
    turn = after / before
    matrix = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0]])
    matrix[:, 2] = pupils.mean(axis=0) - matrix[:, :2] @ face.pupils.mean(axis=0)
    picture = resampled(face.picture, (WIDTH_PX, HEIGHT_PX), matrix).astype(np.float32)
    noise = np.random.default_rng(seed).normal(0, NOISE, picture.shape).astype(np.float32)
    seen: U8 = np.clip(np.rint(picture * light + noise), 0, 255).astype(np.uint8)
    return seen


def measure(folder: Path) -> dict[str, Any]:
    """Detection, error and sigma by camera; jitter and lag of heads that move; time. Raises InputError."""
    faces = read_faces(folder)
    finder = PupilFinder(lock_ns=NS_PER_S)
    spent: dict[str, list[float]] = {"found": [], "followed": []}
    cv2.setNumThreads(1)

    def find(picture: U8, number: int = 0) -> Pupils | None:
        begin = time.thread_time()
        pupils = finder.find(picture, time_ns=round(number * NS_PER_S / RATE_HZ))
        if pupils is not None:
            spent["followed" if number else "found"].append(1e3 * (time.thread_time() - begin))
        return pupils

    cameras = [_found(faces, find, finder, distance_m, light) for distance_m, light in CASES]
    steady = _followed(faces[:: max(1, len(faces) // TRACKS_MAX)], find, finder)
    ms = {name: _percentiles(values) for name, values in spent.items()}
    return {"faces": len(faces), "cameras": cameras, "steady": steady, "processor_ms": ms}


def _percentiles(values: list[float]) -> dict[str, float | None]:
    p50, p99 = np.percentile(values, [50, 99]) if values else (None, None)
    return {"p50": p50, "p99": p99}


def _found(faces: list[Face], find: Any, finder: PupilFinder, distance_m: float, light: float) -> dict[str, Any]:
    errors, ratios, rows = [], [], 0
    for number, face in enumerate(faces):
        picture, pupils = seen_by_camera(face, distance_m, light=light, seed=number)
        finder.forget()
        found = find(picture)
        if found is None:
            continue
        off = found.eyes_px - pupils
        apart = 1e3 * np.linalg.norm(off, axis=1) * distance_m / FOCAL_PX
        if apart.max() <= RIGHT_WITHIN_MM:
            rows += 1
            errors.extend(apart)
            ratios.extend(off.ravel() / found.sigma_px)
    return {
        "distance_m": distance_m,
        "light": light,
        "right": rows / len(faces),
        "mean_mm": float(np.mean(errors)) if errors else None,
        "p95_mm": float(np.percentile(errors, 95)) if errors else None,
        "error_in_sigmas": float(np.sqrt(np.mean(np.square(ratios)))) if ratios else None,  # 1: sigma is true
        "within_2_sigma": float(np.mean(np.abs(ratios) < 2)) if ratios else None,
    }


def _followed(faces: list[Face], find: Any, finder: PupilFinder) -> dict[str, Any]:
    """Heads that sway, less their constant error; mean over the faces."""
    spreads, lags, lost = [], [], 0
    for face in faces:
        finder.forget()
        errors, places = [], []
        for number in range(FRAMES):
            shift = (1.5 * sin(0.37 * number), 1.1 * sin(0.23 * number + pi / 2))  # px: a head that stands
            picture, pupils = seen_by_camera(face, STEADY_M, shift_px=shift, seed=number)
            found = find(picture, number)
            if found is None:
                lost += 1
                break
            errors.append(found.eyes_px - pupils)
            places.append(shift[0])
        if len(errors) == FRAMES:
            off = np.array(errors)[SETTLED:] * 1e3 * STEADY_M / FOCAL_PX
            spreads.append(off.std(axis=0).mean(axis=0))
            speed = np.gradient(np.array(places)[SETTLED:]) * 1e3 * STEADY_M / FOCAL_PX
            lags.append(-np.polyfit(speed, off.mean(axis=1)[:, 0], 1)[0])
    right, up = np.mean(spreads, axis=0) if spreads else (None, None)
    return {
        "distance_m": STEADY_M,
        "faces": len(spreads),
        "lost": lost,
        "right_mm": right,
        "up_mm": up,
        "lag_frames": float(np.median(lags)) if lags else None,
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="How well pupils are found and followed in a folder of faces.")
    parser.add_argument("folder", type=Path, help="pictures, and their pupils")
    try:
        print("\n".join(lines_of(measure(parser.parse_args().folder))))
    except InputError as error:
        parser.error(str(error))
