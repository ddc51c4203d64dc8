"""Guide the user through the calibration viewpoints and store a pair of points for each."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from calib.hardware import SetupHardware
from calib.keys import Key
from calib.pairs import PairRow, PairsFile
from calib.viewpoints import Viewpoint, grid
from runtime.clock import NS_PER_S, SimulatedClock
from runtime.config import Settings
from runtime.errors import InputError
from runtime.eyes.noise import MAD_TO_SIGMA
from runtime.eyes.tracker import CONFIDENCE_MIN
from runtime.records import F64, EyePoints
from runtime.sensor.registry import open_sensor
from runtime.sensor.samples import RecordedSamples

WINDOW_NS = NS_PER_S // 2  # length of the window whose samples are combined by their median
MAX_SPREAD_M = 0.010  # maximum motion or scatter of the eyes within the window
MIN_SAMPLES = 5  # minimum number of samples for a meaningful spread


def midpoint(eyes: EyePoints | None) -> F64 | None:
    """Return the midpoint (3,) between the eyes, or None if either eye was not measured with confidence."""
    if eyes is None or eyes.completed or eyes.confidence.min() < CONFIDENCE_MIN:
        return None
    middle = eyes.eyes_m.mean(axis=0)
    return middle if np.isfinite(middle).all() else None


class EyeWindow:
    """Midpoints between the eyes from the last half second. Their median gives a steady position."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, F64]] = deque()  # capture time and midpoint between the eyes

    def add(self, capture_ns: int, eyes: EyePoints | None) -> None:
        """Add a sample in the sensor frame, unless an eye is uncertain; drop any over half a second old."""
        middle = midpoint(eyes)
        if middle is not None:
            self._samples.append((capture_ns, middle))
        while self._samples and self._samples[0][0] <= capture_ns - WINDOW_NS:
            self._samples.popleft()

    def measure(self) -> tuple[F64, float] | None:
        """Return the median position (3,) in `sensor` and the RMS scatter, in metres, or None if too few."""
        if len(self._samples) < MIN_SAMPLES:
            return None
        points = np.array([point for _, point in self._samples])
        centre = np.median(points, axis=0)
        mad_m = np.median(np.abs(points - centre), axis=0) * MAD_TO_SIGMA
        return centre, float(np.linalg.norm(mad_m))


class Walk:
    """Guide for a user who moves from viewpoint to viewpoint and accepts a pair of points at each. The
    caller supplies samples and key presses; this class has neither a clock nor threads.
    """

    def __init__(
        self,
        file: PairsFile,
        viewpoints: Sequence[Viewpoint],
        *,
        say: Callable[[str], None],
        chart: Callable[[Viewpoint], None] | None = None,
    ) -> None:
        """Start with the first viewpoint that has no pair in `file` yet. `chart` shows a viewpoint's chart."""
        self._file, self._say, self._chart = file, say, chart
        self._left = [v for v in viewpoints if v.name not in file.viewpoints]
        self._window = EyeWindow()
        self._index = 0
        self._serial = ""
        self._accepted = 0
        self.finished = not self._left

    @property
    def current(self) -> Viewpoint:
        """Viewpoint that the user is currently asked to move to."""
        return self._left[self._index]

    def begin(self) -> None:
        """Announce the first viewpoint."""
        if self.finished:
            self._say("every viewpoint already has a pair")
        else:
            self._announce()

    def see(self, capture_ns: int, eyes: EyePoints | None, serial: str) -> None:
        """Add a sample in the sensor frame, along with the sensor's serial number."""
        if self.finished:
            return
        self._serial = serial
        self._window.add(capture_ns, eyes)

    def press(self, key: Key | None) -> None:
        """Accept a pair, change the viewpoint or stop, depending on the key. Does nothing if it is None."""
        if self.finished:
            return
        match key:
            case Key.QUIT:
                self.finished = True
            case Key.ACCEPT:
                self._accept()
            case Key.NEXT | Key.RIGHT:
                self._go(1)
            case Key.PREVIOUS | Key.LEFT:
                self._go(-1)

    def summary(self) -> dict[str, Any]:
        """Return the pair counts and the skipped viewpoints, for the command to report."""
        names = self._file.viewpoints
        return {
            "file": str(self._file.path),
            "pairs": len(self._file),
            "accepted": self._accepted,
            "skipped": [viewpoint.name for viewpoint in self._left if viewpoint.name not in names],
        }

    def _accept(self) -> None:
        viewpoint, seen = self.current, self._window.measure()
        if seen is None:
            self._say(f"{viewpoint.name}: rejected because the sensor does not see both eyes")
            return
        middle_m, spread_m = seen
        spread = f"{spread_m * 1e3:.1f}"
        if spread_m > MAX_SPREAD_M:
            self._say(f"{viewpoint.name}: rejected because the eye positions varied by {spread} mm; hold still")
            return
        self._file.accept(
            PairRow.of(middle_m, viewpoint.midpoint_m, viewpoint.name, serial=self._serial, spread_mm=spread)
        )
        self._accepted += 1
        self._say(f"{viewpoint.name}: accepted with a spread of {spread} mm; {len(self._file)} pairs so far")
        if self._index + 1 == len(self._left):
            self.finished = True
        else:
            self._go(1)

    def _go(self, step: int) -> None:
        index = min(max(self._index + step, 0), len(self._left) - 1)
        if index != self._index:
            self._index = index
            self._window = EyeWindow()  # drops the previous viewpoint's samples
            self._announce()

    def _announce(self) -> None:
        viewpoint = self.current
        x, y, z = viewpoint.midpoint_m
        if self._chart is not None:
            self._chart(viewpoint)
        self._say(
            f"{viewpoint.name} ({self._index + 1} of {len(self._left)}): {x * 100:.0f} cm in front of the display, "
            f"{abs(y) * 100:.0f} cm to its {'right' if y > 0 else 'left'}, {z * 100:.0f} cm up; "
            f"press Enter when the lines fuse, n for the next viewpoint, p for the previous viewpoint, or q to stop"
        )


def capture_live(
    out: Path, settings: Settings, hardware: SetupHardware, *, show: bool, say: Callable[[str], None]
) -> dict[str, Any]:
    """Guide the user through the viewpoints in front of the display, and add pairs to the CSV file `out`.
    `show` puts the charts on the panels. Raises InputError for the file, the sensor or the panels, and FatalError if
    the sensor failed permanently.
    """
    file = PairsFile(out)
    say(f"sensor: {hardware.open_sensor(settings)}")
    try:
        chart = hardware.chart(settings) if show else None
        walk = Walk(file, grid(settings.calibration), say=say, chart=chart)
        walk.begin()
        while not walk.finished:
            while not walk.finished and (sample := hardware.sample(walk.current)) is not None:
                walk.see(*sample)
            key = hardware.poll()
            if key is None:
                hardware.wait()
            walk.press(key)
        return walk.summary()
    finally:
        hardware.let_go()


def capture_recording(out: Path, settings: Settings, *, source: str) -> dict[str, Any]:
    """Write a pair for every sample in a recording, or `demo`, that includes the true eye positions, to
    the CSV file `out`. Raises InputError if no sample has both the true eye positions and confidently measured eyes.
    """
    chosen = settings.sensor.model_copy(update={"driver": "replay", "source": source, "loop": False})
    samples = RecordedSamples(open_sensor(chosen, SimulatedClock()))
    file, pairs, known = PairsFile(out), [], False
    with closing(samples):
        for frame in samples.arrived(sys.maxsize):
            if frame.true_eyes_m is None:
                continue
            known = True
            middle = midpoint(frame.eyes)
            if middle is not None:
                name = f"at {frame.capture_ns / NS_PER_S:.3f} s"
                pairs.append(PairRow.of(middle, frame.true_eyes_m.mean(axis=0), name, serial=samples.serial))
    if not pairs:
        problem = "the sample contains no usable eyes" if known else "the recording contains no true eye positions"
        raise InputError(source, "", f"{problem}; capture from the live sensor instead")
    file.accept(*pairs)
    return {"file": str(out), "pairs": len(file), "accepted": len(pairs)}
