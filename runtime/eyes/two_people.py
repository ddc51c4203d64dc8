"""Simulated motions of two people in front of one display, sampled by a simulated depth camera."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from runtime.clock import NS_PER_S
from runtime.eyes.motions import MOTIONS, dropouts, facing_eyes, measured, minimum_jerk
from runtime.records import F64, EyePoints, SensorFrame

SEATS_M = np.array([[0.62, -0.22, 0.0], [0.66, 0.22, 0.0]])  # midpoints of the seated people's eyes, frame `stack`
STANDING_M = 0.35  # how far the eyes rise when a seated person stands up
SENSOR_M = np.array([0.05, 0.02, 0.22])  # where the demo's sensor is, frame `stack`
SEES_DEG = 35.0  # half the sensor's horizontal field of view
HEAD_M = 0.09  # radius of a head that hides things behind it

# Function that maps (n,) times in seconds to the midpoints of two people's eyes (2, n, 3) in metres, frame `stack`, and
# their heads' tilts (2, n) in radians.
MotionOfTwo = Callable[[F64], tuple[F64, F64]]


def _seated(motion: str, person: int, times_s: F64, *, size: float = 1.0) -> tuple[F64, F64]:
    """Return a person who makes one of the benchmark's motions about a seat. People do not move in step."""
    neck, _ = MOTIONS[motion]((1.0 + 0.17 * person) * times_s + 11.3 * person)
    return SEATS_M[person] + size * neck, -0.6 * size * neck[:, 1]


def _both(*people: tuple[F64, F64]) -> tuple[F64, F64]:
    return np.stack([middle for middle, _ in people]), np.stack([roll for _, roll in people])


def _still(times_s: F64) -> tuple[F64, F64]:
    """Both sit still."""
    return _both(*(_seated("still", person, times_s) for person in (0, 1)))


def _lean(times_s: F64) -> tuple[F64, F64]:
    """Both lean from side to side over 20 cm."""
    return _both(*(_seated("lean", person, times_s, size=2 / 3) for person in (0, 1)))


def _one_leans(times_s: F64) -> tuple[F64, F64]:
    """The first sits still, the second leans over 20 cm."""
    return _both(_seated("still", 0, times_s), _seated("lean", 1, times_s, size=2 / 3))


def _along(times_s: F64, stops: dict[float, tuple[float, float, float]]) -> tuple[F64, F64]:
    """Return a person who is at the given places at the given times, upright."""
    middle = minimum_jerk(times_s, knots_s=np.array(list(stops)), values=np.array(list(stops.values())))
    return middle + _seated("still", 1, times_s)[0] - SEATS_M[1], np.zeros_like(times_s)


def _pass(times_s: F64) -> tuple[F64, F64]:
    """The first sits still. The second walks past behind them every four seconds, at up to 1.9 m/s."""
    knots = np.arange(0.0, times_s.max() + 8.0, 4.0)
    place = np.array([1.3, 0.0, STANDING_M]) + np.where(np.arange(len(knots)) % 2, 1.6, -1.6)[:, None] * [0, 1, 0]
    # Walk for 3.2 s, then stay out of sight for 0.8 s.
    walked = minimum_jerk(times_s + 0.8, knots_s=np.ravel([knots, knots + 0.8], order="F"), values=place.repeat(2, 0))
    return _both(_seated("still", 0, times_s), (walked, np.zeros_like(times_s)))


def _exchange(times_s: F64) -> tuple[F64, F64]:
    """They exchange places within two seconds, the first in front of the second, sit for four seconds and repeat."""
    people = []
    for person, depth in ((0, -0.12), (1, 0.35)):
        stops: dict[float, tuple[float, float, float]] = {}
        here, there = SEATS_M[person], SEATS_M[1 - person]
        for begin in np.arange(0.0, times_s.max() + 12.0, 6.0):
            middle = (here + there) / 2 + [depth, 0.0, 0.0]
            stops |= {begin: tuple(here), begin + 4.0: tuple(here), begin + 5.0: tuple(middle)}
            here, there = there, here
        people.append(_along(times_s, stops))
    return _both(*people)


def _leave(times_s: F64) -> tuple[F64, F64]:
    """The second stands up after four seconds, leaves to the side, and is back after another six."""
    x, y, z = SEATS_M[1]
    aside, gone = (x + 0.3, y + 0.2, STANDING_M), (x + 0.6, 2.2, STANDING_M)
    stops = {0.0: (x, y, z), 4.0: (x, y, z), 5.0: aside, 6.6: gone, 8.0: gone, 9.6: aside, 10.6: (x, y, z)}
    return _both(_seated("still", 0, times_s), _along(times_s, stops))


def _sit(times_s: F64) -> tuple[F64, F64]:
    """The second comes from the side after two seconds and sits down next to the first."""
    x, y, z = SEATS_M[1]
    aside, gone = (x + 0.3, y + 0.2, STANDING_M), (x + 0.6, 2.2, STANDING_M)
    stops = {0.0: gone, 2.0: gone, 3.6: aside, 4.6: (x, y, z)}
    return _both(_seated("still", 0, times_s), _along(times_s, stops))


MOTIONS_OF_TWO: dict[str, MotionOfTwo] = {
    "two-still": _still,
    "two-lean": _lean,
    "two-one-leans": _one_leans,
    "two-pass": _pass,
    "two-exchange": _exchange,
    "two-leave": _leave,
    "two-sit": _sit,
}


def true_eyes_of_two(motion: str, times_s: F64) -> F64:
    """Return the (n, 4, 3) eyes of two people during a motion, in metres, in frame `stack`. The first two
    are the first person's left and right eye. A person who is outside the sensor's field of view counts as absent and
    has NaN coordinates.
    """
    middles, rolls = MOTIONS_OF_TWO[motion](times_s)
    eyes = np.stack([facing_eyes(middle, roll=roll) for middle, roll in zip(middles, rolls, strict=True)], 1)
    eyes[~np.moveaxis(_in_view(middles), 0, 1)] = np.nan
    return eyes.reshape(len(times_s), 4, 3)


def _in_view(middles_m: F64) -> NDArray[np.bool_]:
    """Return, for each of (2, n, 3) midpoints, True if it is in the sensor's field of view."""
    sight = middles_m - SENSOR_M
    return np.asarray(np.abs(np.arctan2(sight[..., 1], sight[..., 0])) < np.deg2rad(SEES_DEG))


def hidden(eyes_m: F64) -> NDArray[np.bool_]:
    """Return (n, 2): True for each person whose eyes (n, 4, 3) the other's head hides from the sensor."""
    sight = eyes_m.reshape(-1, 2, 2, 3).mean(axis=2) - SENSOR_M
    away = np.linalg.norm(sight, axis=2)
    with np.errstate(invalid="ignore"):
        sines = np.linalg.norm(np.cross(sight[:, 0], sight[:, 1]), axis=1) / (away[:, 0] * away[:, 1])
        behind = np.stack([away[:, 0] > away[:, 1], away[:, 1] > away[:, 0]], 1)
        return np.asarray(behind & (sines < 2 * HEAD_M / away.max(axis=1))[:, None])


def observe_two(
    motion: str,
    *,
    seconds: float,
    rate_hz: float,
    noise_m: float = 0.003,
    outliers: float = 0.05,
    dropout_every_s: float = 4.0,
    seed: int = 1,
) -> list[SensorFrame]:
    """Simulate the samples taken by a sensor during one of `MOTIONS_OF_TWO`, with true eyes, in `stack`.
    A person whom the other one hides is missing from a sample. The other arguments are those of `motions.observe`.
    """
    random = np.random.default_rng([seed, *motion.encode(), round(rate_hz)])
    times_s = np.arange(round(seconds * rate_hz)) / rate_hz
    truth = true_eyes_of_two(motion, times_s)
    pairs = truth.reshape(-1, 2, 2, 3)
    seen = np.stack([measured(pairs[:, person], random, noise_m=noise_m, outliers=outliers) for person in (0, 1)], 1)
    visible = (
        np.isfinite(pairs).all(axis=(2, 3)) & ~hidden(truth) & ~dropouts(times_s, every_s=dropout_every_s)[:, None]
    )
    frames = []
    for number, (time_s, eyes, shown, true_m) in enumerate(zip(times_s, seen, visible, truth, strict=True), start=1):
        people = sorted((pair for pair, is_shown in zip(eyes, shown, strict=True) if is_shown), key=_distance_m)
        points = [EyePoints(pair, np.ones(2)) for pair in people]
        first, others = (points[0], tuple(points[1:])) if points else (None, ())
        frames.append(SensorFrame(number, round(time_s * NS_PER_S), first, true_eyes_m=true_m, others=others))
    return frames


def _distance_m(eyes_m: F64) -> float:
    return float(np.linalg.norm(eyes_m.mean(axis=0)))
