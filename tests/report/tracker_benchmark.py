"""How well the tracker predicts: error against horizon for recorded kinds of motion, and jitter against lag."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.config import TrackerSettings
from runtime.eyes.motions import Observation, observe, true_eyes
from runtime.eyes.tracker import Tracker
from runtime.records import F64, EyePoints
from tests.eyes.one_euro import OneEuro

HORIZONS_MS = (0, 15, 30, 45, 60, 75, 90, 105, 120)
SETTLED_S = 1.5  # the start of a run, in which no filter knows the velocity yet, is left out
SHIPPED, NONE, EURO, BEST = "shipped", "no filter, no prediction", "One Euro", "tuned offline"
UNPREDICTED = "shipped filter, no prediction"


class Predictor(Protocol):
    """What is compared."""

    def update(self, points: EyePoints | None, *, capture_ns: int) -> None: ...

    def eyes_at(self, time_ns: int) -> F64 | None:
        """(2, 3) or None before the first sample."""


class Shipped:
    """The product's tracker, or one with other settings."""

    def __init__(self, settings: TrackerSettings | None = None) -> None:
        self._tracker = Tracker(settings)
        self.update = self._tracker.update

    def eyes_at(self, time_ns: int) -> F64 | None:
        return self._tracker.at(time_ns).eyes_m


class Unpredicted:
    """The product's tracker, asked for the newest sample's instant whatever the horizon."""

    def __init__(self) -> None:
        self._tracker, self._newest_ns = Tracker(), 0

    def update(self, points: EyePoints | None, *, capture_ns: int) -> None:
        self._tracker.update(points, capture_ns=capture_ns)
        self._newest_ns = capture_ns

    def eyes_at(self, time_ns: int) -> F64 | None:
        return self._tracker.at(self._newest_ns).eyes_m


class Newest:
    """No filter and no prediction: what the published prototype does."""

    def __init__(self) -> None:
        self._eyes: F64 | None = None

    def update(self, points: EyePoints | None, *, capture_ns: int) -> None:
        self._eyes = points.eyes_m if points is not None else self._eyes

    def eyes_at(self, time_ns: int) -> F64 | None:
        return self._eyes


class Euro:
    """One Euro alone, behind the tracker's plausibility check; `predict`: goes on at its filtered speed."""

    def __init__(self, *, min_cutoff_hz: float = 2.0, beta: float = 12.0, predict: bool = False) -> None:
        self._filter = OneEuro(min_cutoff_hz=min_cutoff_hz, beta=beta)
        self._predict, self._last_ns = predict, 0

    def update(self, points: EyePoints | None, *, capture_ns: int) -> None:
        if points is None:
            return
        ipd_m = float(np.linalg.norm(points.eyes_m[0] - points.eyes_m[1]))
        if 0.05 <= ipd_m <= 0.075:
            dt_s = (capture_ns - self._last_ns) / NS_PER_S
            self._filter.update(points.eyes_m.ravel(), dt_s=max(dt_s, 1e-3))
            self._last_ns = capture_ns

    def eyes_at(self, time_ns: int) -> F64 | None:
        if self._filter.position is None:
            return None
        ahead_s = min((time_ns - self._last_ns) / NS_PER_S, 0.12) if self._predict else 0.0
        return (self._filter.position + self._filter.velocity * ahead_s).reshape(2, 3)


def candidates() -> Iterable[tuple[str, Callable[[], Predictor]]]:
    """What offline tuning may choose from, a motion at a time: plain Kalman filters, and One Euro with prediction."""
    for q in (0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0):
        for turn in (1e-5, 1e-4, 1e-3):
            settings = TrackerSettings(acceleration=(q,), turn_acceleration=turn)
            yield f"Kalman q = {q:g}, {turn:g}", partial(Shipped, settings)
    for cutoff_hz in (0.5, 1.0, 2.0, 4.0):
        for beta in (3.0, 10.0, 30.0):
            yield (
                f"One Euro {cutoff_hz:g} Hz, beta {beta:g}, predicting",
                partial(Euro, min_cutoff_hz=cutoff_hz, beta=beta, predict=True),
            )


def errors_mm(
    make: Callable[[], Predictor], observed: Sequence[Observation], motion: str, horizons_ms: Sequence[float]
) -> dict[float, F64]:
    """(n,) for each horizon: distance of the worse eye from the truth at each sample plus that, dropouts included.

    Each horizon is a run of its own: a display has one.
    """
    result = {}
    for horizon in horizons_ms:
        predictor, answers, times_s = make(), [], []
        ahead_ns = round(horizon * NS_PER_MS)
        for sample in observed:
            predictor.update(sample.points, capture_ns=sample.capture_ns)
            eyes = predictor.eyes_at(sample.capture_ns + ahead_ns)
            if sample.capture_ns >= SETTLED_S * NS_PER_S:
                times_s.append((sample.capture_ns + ahead_ns) / NS_PER_S)
                answers.append(np.full((2, 3), np.nan) if eyes is None else eyes)
        truth = true_eyes(motion, np.array(times_s))
        result[horizon] = np.linalg.norm(np.array(answers) - truth, axis=2).max(axis=1) * 1000
    return result


@dataclass(frozen=True, slots=True)
class Row:
    """One method at one horizon."""

    motion: str
    rate_hz: int
    method: str
    horizon_ms: float
    p50_mm: float
    p95_mm: float
    note: str = ""


def _rows(motion: str, rate_hz: int, method: str, errors: dict[float, F64], note: str = "") -> list[Row]:
    return [
        Row(motion, rate_hz, method, h, float(np.nanpercentile(e, 50)), float(np.nanpercentile(e, 95)), note)
        for h, e in errors.items()
    ]


def benchmark(
    *,
    seconds: float = 30.0,
    rates_hz: Sequence[int] = (30, 60),
    motions: Sequence[str] = ("lean", "nod", "walk", "stop-and-go"),
    horizons_ms: Sequence[float] = HORIZONS_MS,
    tune: bool = True,
    tune_at_ms: float = 60.0,
    seed: int = 1,
) -> list[Row]:
    """Prediction error by motion, rate, method and horizon: noise 3 mm, 5 % outliers, dropouts of 0.2 s.

    "tuned offline" is the candidate with the least p95 at `tune_at_ms` of this very run, which no tracker
    can know beforehand.
    """
    rows: list[Row] = []
    for motion in motions:
        for rate_hz in rates_hz:
            observed = observe(motion, seconds=seconds, rate_hz=rate_hz, seed=seed)

            def measure(
                make: Callable[[], Predictor],
                horizons: Sequence[float] = horizons_ms,
                observed: list[Observation] = observed,
                motion: str = motion,
            ) -> dict[float, F64]:
                return errors_mm(make, observed, motion, horizons)

            rows += _rows(motion, rate_hz, SHIPPED, measure(Shipped))
            rows += _rows(motion, rate_hz, UNPREDICTED, measure(Unpredicted))
            rows += _rows(motion, rate_hz, NONE, measure(Newest))
            rows += _rows(motion, rate_hz, EURO, measure(Euro))
            if tune:
                scores = [
                    (float(np.nanpercentile(measure(make, [tune_at_ms])[tune_at_ms], 95)), name, make)
                    for name, make in candidates()
                ]
                _, name, make = min(scores, key=lambda score: score[0])
                rows += _rows(motion, rate_hz, BEST, measure(make), name)
    return rows


@dataclass(frozen=True, slots=True)
class Trade:
    """One setting: how much a still head shakes, and how far behind a moving one the eyes are."""

    method: str
    jitter_mm: float  # root mean square of a still head's steps from sample to sample
    lag_ms: float  # by which the answer for the sample's own instant trails a head at 0.3 m/s


def jitter_and_lag(*, rate_hz: int = 60, seconds: float = 16.0) -> list[Trade]:
    """The trade-off of Kalman and One Euro filters over their settings, with the shipped tracker's point."""
    still = observe("still", seconds=seconds, rate_hz=rate_hz, outliers=0.0, dropout_every_s=0.0)
    lean = observe("lean", seconds=seconds, rate_hz=rate_hz, outliers=0.0, dropout_every_s=0.0)
    times_s = np.array([o.capture_ns for o in lean]) / NS_PER_S
    truth = true_eyes("lean", times_s)[:, :, 1].mean(1)
    speed = np.gradient(truth, times_s)

    def answers(predictor: Predictor, observed: list[Observation]) -> F64:
        given = []
        for sample in observed:
            predictor.update(sample.points, capture_ns=sample.capture_ns)
            eyes = predictor.eyes_at(sample.capture_ns)
            given.append(np.full(3, np.nan) if eyes is None else eyes.mean(0))
        return np.array(given)

    def trade(method: str, make: Callable[[], Predictor]) -> Trade:
        from_s = round(SETTLED_S * rate_hz)
        steps = np.diff(answers(make(), still)[from_s:], axis=0)
        behind = (truth - answers(make(), lean)[:, 1])[from_s:]
        # Least squares of error = lag x speed: the noise averages out.
        lag_s = float(behind @ speed[from_s:] / (speed[from_s:] @ speed[from_s:]))
        return Trade(method, float(np.sqrt((steps**2).sum(1).mean()) * 1000), lag_s * 1000)

    rows = [trade(SHIPPED, Shipped)]
    for q in (0.0003, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0):
        settings = TrackerSettings(acceleration=(q,))
        rows.append(trade("Kalman", partial(Shipped, settings)))
    rows += [
        trade("One Euro", partial(Euro, min_cutoff_hz=cutoff, beta=10.0))
        for cutoff in (0.3, 0.6, 1.2, 2.5, 5.0, 10.0, 20.0)
    ]
    return rows
