"""Simulated head motions, sampled by a simulated depth camera, for benchmarks and tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.clock import NS_PER_S
from runtime.records import F64, EyePoints

IPD_M = 0.063
DISTANCE_M = 0.6  # distance from the panels to the eyes at rest
DROPOUT_S = 0.2  # duration of each dropout
NECK_TO_EYES_M = np.array([-0.09, 0.0, 0.14])  # x (negative: towards the display), sideways, up


@dataclass(frozen=True, slots=True)
class Observation:
    """A sample, in the form that the tracker receives."""

    capture_ns: int
    points: EyePoints | None  # eyes in frame `stack`; None: dropout


# Function that maps (n,) times in seconds to the neck's (n, 3) displacement in metres, frame `stack`, and its (n,)
# pitch in radians.
Motion = Callable[[F64], tuple[F64, F64]]


def minimum_jerk(times_s: F64, *, knots_s: F64, values: F64) -> F64:
    """Interpolate values (k, ...) by minimum-jerk movements (Flash and Hogan 1985) at times (n,)."""
    index = np.clip(np.searchsorted(knots_s, times_s, side="right") - 1, 0, len(knots_s) - 2)
    s = np.clip((times_s - knots_s[index]) / (knots_s[index + 1] - knots_s[index]), 0, 1)
    blend = s**3 * (10 + s * (6 * s - 15))
    return values[index] + (values[index + 1] - values[index]) * blend.reshape(-1, *[1] * (values.ndim - 1))


def _still(times_s: F64) -> tuple[F64, F64]:
    """Sit still apart from breathing and a few millimetres of sway."""
    sway = [0.0015 * np.sin(1.7 * times_s), 0.002 * np.sin(0.9 * times_s + 1), 0.0015 * np.sin(1.6 * times_s)]
    return np.stack(sway, 1), np.zeros_like(times_s)


def _lean(times_s: F64) -> tuple[F64, F64]:
    """Lean from side to side over 30 cm without stopping, at up to 0.3 m/s."""
    phase = 2 * np.pi * times_s / 3.2
    neck, pitch = _still(times_s)
    return neck + np.stack([0.03 * np.cos(phase), 0.15 * np.sin(phase), -0.03 * np.sin(phase) ** 2], 1), pitch


def _nod(times_s: F64) -> tuple[F64, F64]:
    """Nod three times by 12 degrees at 1 Hz, pause and repeat."""
    neck, _ = _still(times_s)
    within = times_s % 5.0
    envelope = np.clip(np.minimum(within, 3.0 - within) / 0.5, 0, 1)
    return neck, np.deg2rad(12) * np.sin(2 * np.pi * within) * envelope


def _walk(times_s: F64) -> tuple[F64, F64]:
    """Walk back and forth over 2 m in front of the display, at up to 1.1 m/s with 1.9 steps a second."""
    knots = np.arange(0.0, times_s.max() + 4.0, 3.5)
    side = minimum_jerk(times_s, knots_s=knots, values=np.where(np.arange(len(knots)) % 2, 1.0, -1.0))
    bob = 0.02 * np.sin(2 * np.pi * 1.9 * times_s)
    sway = 0.02 * np.sin(np.pi * 1.9 * times_s)
    return np.stack([0.3 + 0.1 * side + sway, side, bob], 1), np.zeros_like(times_s)


def _stop_and_go(times_s: F64) -> tuple[F64, F64]:
    """Move 10 to 30 cm in half a second to a second, with pauses of similar length."""
    random = np.random.default_rng(7)
    knots, places, place = [0.0], [np.zeros(3)], np.zeros(3)
    while knots[-1] <= times_s.max():
        pause, move = random.uniform(0.4, 1.2), random.uniform(0.5, 1.0)
        target = random.uniform([-0.1, -0.2, -0.05], [0.2, 0.2, 0.05])
        knots += [knots[-1] + pause, knots[-1] + pause + move]
        places += [place, target]
        place = target
    neck, pitch = _still(times_s)
    return neck + minimum_jerk(times_s, knots_s=np.array(knots), values=np.array(places)), pitch


MOTIONS: dict[str, Motion] = {"still": _still, "lean": _lean, "nod": _nod, "walk": _walk, "stop-and-go": _stop_and_go}


@dataclass(frozen=True, slots=True)
class Path:
    """A variation on a motion in phase, speed, extent and initial direction."""

    start_s: float = 0.0  # time within the motion when the path starts
    pace: float = 1.0  # factor on the speed
    size: float = 1.0  # factor on the extent
    side: float = 1.0  # -1: left and right are swapped


BENCHMARK_PATH = Path()


def path_of(seed: int) -> Path:
    """Return the random path for a seed. Seed 0 gives the benchmark's path."""
    if seed == 0:
        return BENCHMARK_PATH
    random = np.random.default_rng([seed, 0x70617468])
    return Path(
        random.uniform(0, 600), random.uniform(0.85, 1.1), random.uniform(0.85, 1.1), random.choice([-1.0, 1.0])
    )


def true_eyes(motion: str, times_s: F64, *, path: Path = BENCHMARK_PATH) -> F64:
    """Return the (n, 2, 3) eye positions in `stack` at times (n,) of one of `MOTIONS`."""
    neck, pitch = MOTIONS[motion](path.start_s + path.pace * times_s)
    neck, pitch = path.size * neck * [1.0, path.side, 1.0], path.size * pitch
    forward, _, up = NECK_TO_EYES_M
    c, s = np.cos(pitch), np.sin(pitch)
    middle = neck + np.stack([forward * c + up * s, np.zeros_like(c), up * c - forward * s], 1)
    middle += np.array([DISTANCE_M - forward, 0.0, -up])
    return facing_eyes(middle, roll=-0.6 * neck[:, 1])  # the head tilts as it leans


def facing_eyes(middle_m: F64, *, roll: F64) -> F64:
    """Return the (n, 2, 3) eyes of heads that face the display, of midpoints (n, 3) and roll (n,)."""
    yaw = np.arctan2(middle_m[:, 1], middle_m[:, 0])
    across = [-np.sin(yaw) * np.cos(roll), np.cos(yaw) * np.cos(roll), np.sin(roll)]
    half = IPD_M / 2 * np.stack(across, 1)
    return np.stack([middle_m - half, middle_m + half], 1)


def observe(
    motion: str,
    *,
    seconds: float,
    rate_hz: float,
    noise_m: float = 0.003,
    outliers: float = 0.05,
    dropout_every_s: float = 4.0,
    seed: int = 1,
    path: Path = BENCHMARK_PATH,
) -> list[Observation]:
    """Simulate the samples that a sensor takes of one of `MOTIONS`, on a variation of its path. `noise_m`
    is the deviation for each eye along each axis. A share of `outliers` have one or both eyes displaced by 4 to 20 cm.
    `dropout_every_s` is 0 for none.
    """
    random = np.random.default_rng([seed, *motion.encode(), round(rate_hz)])
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    eyes = measured(true_eyes(motion, times_s, path=path), random, noise_m=noise_m, outliers=outliers)
    missing = dropouts(times_s, every_s=dropout_every_s)
    confidence = np.ones(2)
    return [
        Observation(round(t * NS_PER_S), None if gone else EyePoints(pair, confidence))
        for t, pair, gone in zip(times_s, eyes, missing)
    ]


def measured(true_m: F64, random: np.random.Generator, *, noise_m: float, outliers: float) -> F64:
    """Return (n, 2, 3) true eyes with the sensor's noise and outliers (`observe`)."""
    count = len(true_m)
    eyes = true_m + random.normal(0.0, noise_m, (count, 2, 3))
    wrong = random.random(count) < outliers
    direction = random.normal(size=(count, 3))
    offset = direction / np.linalg.norm(direction, axis=1, keepdims=True) * random.uniform(0.04, 0.2, (count, 1))
    which = random.integers(0, 3, count)  # 0 left, 1 right, 2 both
    for eye in (0, 1):
        hit = wrong & ((which == eye) | (which == 2))
        eyes[hit, eye] += offset[hit]
    return eyes


def dropouts(times_s: F64, *, every_s: float) -> NDArray[np.bool_]:
    """Return, for each of (n,) times, True if the sensor sees no face. `every_s` is 0 for no dropouts."""
    every_s = every_s or np.inf
    return np.asarray((times_s > 1.0) & (np.mod(times_s, every_s) >= every_s - DROPOUT_S))
