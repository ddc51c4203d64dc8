"""The whole chain of the eyes, in decibels: real faces on moving heads before a simulated RGB-D camera.

The product's own run, on the simulated clock, finds the eyes in what that camera sees, and shows them a picture.
Beside it the same heads' true eyes as points, and points with the noise that is assumed where a sensor does not tell
its own. A face is a flat picture across the line of sight, at the depth of the eyes; it does not blur where it moves.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.errors import FatalError
from runtime.eyes.benchmark import EYE_DISTANCE_M, FOCAL_PX, HEIGHT_PX, RATE_HZ, WIDTH_PX, Face, picture_at, read_faces
from runtime.eyes.demo_geometry import demo_sensor_from_stack, demo_stack_from_sensor
from runtime.eyes.motions import Path as Way
from runtime.eyes.motions import true_eyes
from runtime.records import F64, U16, EyePoints, Intrinsics, SensorFrame, State
from runtime.report.moving import settings_for, simulated_run
from runtime.report.page import in_columns
from runtime.sensor.recording import recording_to
from runtime.sensor.recording_format import RecordingHeader
from runtime.support import progress

MOTIONS = ("still", "lean", "walk")
PATHS = {"walk": Way(size=0.4)}  # which would else leave the camera's picture: 1 m to and fro at up to 0.4 m/s
NETWORKS, TRUE, NOISY = "networks", "true eyes", "points, 3 mm"
POINTS_SIGMA_M = {TRUE: 0.0, NOISY: 0.003}
TRUE_VARIANCE_M2 = 1e-8  # what the driver of true eyes says of them
FACES = 2  # the most frontal ones: a flat picture of a turned head has its eyes at the wrong depth
DISTANCE_M, SECONDS, SCALE = 0.75, 4.0, 0.25  # of the head at rest; a run; panels of 480x270
SOLVER_MS, EVERY = 33.0, 15  # refreshes from one that is looked at to the next
# Of the camera's depth at 0.75 m: standard deviation and steps, mm; share of pixels without; the wall behind a head.
DEPTH_NOISE_MM, DEPTH_STEP_MM, HOLES, WALL_MM = 1.0, 2.0, 0.025, 2500.0
HEAD = 1.5  # radius of a head about the middle between its eyes, in eye distances
CAMERA = Intrinsics(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, WIDTH_PX / 2, HEIGHT_PX / 2)


def measure(
    folder: Path, *, motions: Sequence[str] = MOTIONS, seconds: float = SECONDS, scale: float = SCALE
) -> list[dict[str, Any]]:
    """A row for each motion and source of eyes, means over the faces. Raises InputError, FatalError."""
    faces = sorted(read_faces(folder), key=lambda face: -face.foreshortening)[:FACES]
    rows = []
    for number, motion in enumerate(motions):
        runs: dict[str, list[dict[str, float]]] = {NETWORKS: [], TRUE: [], NOISY: []}
        with tempfile.TemporaryDirectory(prefix="phasestack-") as scratch:
            for count, face in enumerate(faces):
                progress.tell("motions", number * len(faces) + count, len(motions) * len(faces))
                # Points do not depend on the face.
                for source, path in record(Path(scratch), motion, face, seconds=seconds, points=count == 0).items():
                    runs[source].append(_run(path, scale))
        rows += [
            {"motion": motion, "eyes": source} | {name: float(np.mean([r[name] for r in found])) for name in found[0]}
            for source, found in runs.items()
        ]
    return rows


def record(folder: Path, motion: str, face: Face, *, seconds: float, points: bool = True) -> dict[str, Path]:
    """One recording for each source of eyes: the camera's pictures, and points."""
    times_ns = [round(number * NS_PER_S / RATE_HZ) for number in range(round(seconds * RATE_HZ))]
    path = true_eyes(motion, np.array(times_ns) / NS_PER_S, distance_m=DISTANCE_M, path=PATHS.get(motion, Way()))
    stack_from_sensor, random = demo_stack_from_sensor(), np.random.default_rng(1)
    pictures = RecordingHeader("motion", "demo", eye_points=False, colour=True, depth=True, truth=True)
    headers = {NETWORKS: pictures}
    if points:
        headers |= dict.fromkeys(POINTS_SIGMA_M, RecordingHeader("motion", "demo", truth=True))
    paths = {source: folder / f"{source}.mcap" for source in headers}
    with ExitStack() as cleanup:
        writers = {source: cleanup.enter_context(recording_to(paths[source], headers[source])) for source in headers}
        for number, (time_ns, eyes) in enumerate(zip(times_ns, path, strict=True), start=1):
            place = _across_the_sight(demo_sensor_from_stack(), eyes)
            eyes = place @ stack_from_sensor[:3, :3].T + stack_from_sensor[:3, 3]
            pupils = FOCAL_PX * place[:, :2] / place[:, 2:] + [WIDTH_PX / 2, HEIGHT_PX / 2]
            for source, writer in writers.items():
                what: dict[str, Any]
                if source == NETWORKS:
                    depth = _depth(pupils, 1000 * place[:, 2], random)
                    what = {"colour": picture_at(face, pupils, seed=number), "depth_mm": depth, "intrinsics": CAMERA}
                else:
                    what = {"eyes": _points(place, POINTS_SIGMA_M[source], random)}
                writer.write(SensorFrame(number, time_ns, true_eyes_m=eyes, **what))
    return paths


def _across_the_sight(sensor_from_stack: F64, eyes_m: F64) -> F64:
    """(2, 3) in the sensor's frame: these eyes, of a head that faces the camera as its picture does."""
    place: F64 = eyes_m @ sensor_from_stack[:3, :3].T + sensor_from_stack[:3, 3]
    middle, line = place.mean(axis=0), place[0] - place[1]
    line -= (line @ middle) / (middle @ middle) * middle
    half = EYE_DISTANCE_M / 2 * line / np.linalg.norm(line)
    return np.array([middle + half, middle - half])


def _points(place_m: F64, sigma_m: float, random: np.random.Generator) -> EyePoints:
    told = None if sigma_m else np.eye(3) * TRUE_VARIANCE_M2
    return EyePoints(place_m + random.normal(0.0, sigma_m, (2, 3)), np.ones(2), covariance_m2=told)


def _depth(pupils: F64, eyes_mm: F64, random: np.random.Generator) -> U16:
    """(h, w) mm of a head with pupils (2, 2) px at (2,) mm."""
    line, (y, x) = pupils[0] - pupils[1], np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    off_x, off_y = x - pupils[:, 0].mean(), y - pupils[:, 1].mean()
    along = (off_x * line[0] + off_y * line[1]) / (line @ line)
    head = np.hypot(off_x, off_y) < HEAD * np.hypot(*line)
    depth = np.where(head, eyes_mm.mean() + along * (eyes_mm[0] - eyes_mm[1]), WALL_MM)
    coarser = np.square(depth / (1000 * DISTANCE_M))  # with the distance, as a structured light's
    step = DEPTH_STEP_MM * coarser
    depth = step * np.rint((depth + random.normal(0.0, DEPTH_NOISE_MM, depth.shape) * coarser) / step)
    depth[random.random(depth.shape) < HOLES] = 0
    return np.rint(depth).astype(np.uint16)


def _run(recording: Path, scale: float) -> dict[str, float]:
    """What one run says of itself, and how far from the truth it had the eyes at its refreshes."""
    settings = settings_for(recording, solver_ms=SOLVER_MS)
    settings = settings.model_copy(update={"loop": settings.loop.model_copy(update={"evaluate_every": EVERY})})
    watched = simulated_run(settings, scale=scale, quality=True)
    tracked = [line for line in watched.lines if line["state"] == State.TRACKING]
    known = [line for line in tracked if line["true_eyes_m"] is not None]
    if not known or watched.summary["carried_db_true_eyes"] is None:
        raise FatalError(f"{recording.stem}: no refresh was looked at")
    off = np.array([line["eyes_m"] - line["true_eyes_m"] for line in known])
    p50, p95 = np.percentile(1000 * np.linalg.norm(off, axis=2).mean(axis=1), (50, 95))
    names = ("carried_db", "carried_db_true_eyes", "quality_frames")
    return {name: watched.summary[name] for name in names} | {"eyes_p50_mm": p50, "eyes_p95_mm": p95}


def told(rows: list[dict[str, Any]]) -> str:
    """The same as a table."""
    headings = ["motion", "eyes", "dB at the eyes used", "at the true eyes", "eyes off, mm: p50", "p95"]
    figures = ("carried_db", "carried_db_true_eyes", "eyes_p50_mm", "eyes_p95_mm")
    return in_columns([headings, *([r["motion"], r["eyes"], *(f"{r[name]:.1f}" for name in figures)] for r in rows)])
