"""The person's way through the viewpoints: what each key does, and when a pair is good enough to keep."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.capture import EyeWindow, Measured
from calib.guidance import rough_similarity, way_to
from calib.keys import Key
from calib.pairs import CapturedPair, PairsFile
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_S
from runtime.records import F64, EyePoints

HERE = "here: till the lines fuse; then hold still, or Enter"
GUIDE_NS = NS_PER_S // 2  # between two words of guidance
HOLD_S = 1.5  # eyes that were still for so long are taken without a key
DRIFT_M = 0.005  # that still eyes may wander meanwhile: noise and breath
REACH_M = 0.06  # of the viewpoint, as the pairs so far tell it: nearer, holding still means that the lines fuse
MOVED_M = 0.02  # since the last pair or its undoing: a person who has not moved does not mean this viewpoint


def accept(measured: Measured | None, viewpoint: Viewpoint, *, max_spread_m: float) -> CapturedPair | str:
    """The pair, or why there is none."""
    if measured is None:
        return "the sensor sees no pair of eyes"
    if measured.spread_m > max_spread_m:
        return f"the eyes moved or scattered by {measured.spread_m * 1e3:.1f} mm: hold still"
    return captured(measured, viewpoint.midpoint_m, viewpoint.name)


def captured(measured: Measured, stack_m: F64, name: str) -> CapturedPair:
    """A measured midpoint with its true place (3,) in `stack`, as a row of the file."""
    x, y, z = measured.midpoint_m.tolist()
    u, v, w = stack_m.tolist()
    return CapturedPair(
        sensor_m=(x, y, z),
        stack_m=(u, v, w),
        viewpoint=name,
        spread_mm=measured.spread_m * 1e3,
        samples=measured.samples,
        separation_m=measured.separation_m,
        accepted_at=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


class Walk:
    """The person's way through the viewpoints: what each key does. No clock, no threads."""

    def __init__(
        self,
        file: PairsFile,
        viewpoints: Sequence[Viewpoint],
        *,
        again: bool,
        window_s: float,
        max_spread_m: float,
        say: Callable[[str], None],
        chart: Any = None,
        hold_s: float = HOLD_S,
    ) -> None:
        """chart: has `show(viewpoint)` and `caption(text)`; None: the person follows the charts elsewhere.

        hold_s: how long eyes are still before they are taken by themselves, as soon as three pairs tell roughly where
        they are; 0: never.
        """
        self._file, self._say, self._chart = file, say, chart
        self._left = [v for v in viewpoints if again or v.name not in file.viewpoints]
        self._window, self._max_spread_m = EyeWindow(window_s), max_spread_m
        self._held = EyeWindow(hold_s) if hold_s else None
        self._before_m: F64 | None = None  # where the eyes were when this viewpoint came up, frame `sensor`
        self._index = 0
        self._serial = ""
        self._accepted = 0
        self._rough = rough_similarity(*file.points())
        self._guided_ns = 0
        self._guide = ""
        self.finished = not self._left

    @property
    def current(self) -> Viewpoint:
        """The viewpoint that is shown."""
        return self._left[self._index]

    def begin(self) -> None:
        """Announce the first viewpoint."""
        if self.finished:
            self._say("every viewpoint has its pair already")
        else:
            self._announce()

    def see(self, capture_ns: int, eyes: EyePoints | None, *, serial: str) -> None:
        """Take in a sample in frame `sensor`."""
        self._window.add(capture_ns, eyes)
        self._serial = serial
        if self._held is not None and not self.finished:
            self._held.add(capture_ns, eyes)
            if self._holds_still():
                self._accept(self._held, how="held still, ")
        if capture_ns - self._guided_ns >= GUIDE_NS and not self.finished:
            self._tell_way(capture_ns)

    def press(self, key: Key | None) -> None:
        """Do what a key says; None: nothing was pressed."""
        if key is None or self.finished:
            return
        if key is Key.QUIT:
            self.finished = True
        elif key is Key.ACCEPT:
            self._accept(self._window)
        elif key is Key.UNDO:
            self._undo()
        elif key in (Key.NEXT, Key.RIGHT):
            self._go(1)
        elif key in (Key.PREVIOUS, Key.LEFT):
            self._go(-1)

    def summary(self) -> dict[str, Any]:
        """What came of it."""
        names = self._file.viewpoints
        return {
            "file": str(self._file.path),
            "pairs": len(self._file),
            "accepted": self._accepted,
            "skipped": [viewpoint.name for viewpoint in self._left if viewpoint.name not in names],
        }

    def _holds_still(self) -> bool:
        """Whether a person stands about where they should, has come there, and does not move any more."""
        if self._held is None or self._rough is None or not self._held.still(DRIFT_M):
            return False
        measured = self._held.measure()
        if measured is None or measured.spread_m > self._max_spread_m:
            return False
        if self._before_m is not None and np.linalg.norm(measured.midpoint_m - self._before_m) < MOVED_M:
            return False
        off_m = self._rough.points(measured.midpoint_m[None])[0] - self._left[self._index].midpoint_m
        return float(np.linalg.norm(off_m)) <= REACH_M

    def _accept(self, window: EyeWindow, *, how: str = "") -> None:
        viewpoint = self._left[self._index]
        result = accept(window.measure(), viewpoint, max_spread_m=self._max_spread_m)
        if isinstance(result, str):
            self._say(f"{viewpoint.name}: not taken: {result}")
            return
        self._file.accept(replace(result, sensor_serial=self._serial))
        self._accepted += 1
        self._rough = rough_similarity(*self._file.points())
        self._say(f"{viewpoint.name}: {how}taken, spread {result.spread_mm:.1f} mm, {len(self._file)} pairs in all")
        if self._index + 1 == len(self._left):
            self.finished = True
        else:
            self._go(1)

    def _undo(self) -> None:
        name = self._file.undo()
        if not name:
            self._say("nothing to undo")
            return
        self._rough = rough_similarity(*self._file.points())
        self._accepted = max(0, self._accepted - 1)
        self._say(f"{name}: taken back, {len(self._file)} pairs in all")
        places = [viewpoint.name for viewpoint in self._left]
        self._forget()
        if name in places:
            self._go(places.index(name) - self._index)

    def _tell_way(self, now_ns: int) -> None:
        """Where to move, as soon as three pairs tell roughly where the camera stands."""
        measured = self._window.measure()
        if self._rough is None or measured is None:
            return
        self._guided_ns = now_ns
        eyes_m = self._rough.points(measured.midpoint_m[None])[0]
        way = way_to(self._left[self._index].midpoint_m, eyes_m) or HERE
        if way != self._guide:
            self._guide = way
            self._say(way)
            if self._chart is not None:
                self._chart.caption(way)

    def _go(self, step: int) -> None:
        index = min(max(self._index + step, 0), len(self._left) - 1)
        if index != self._index:
            self._index = index
            self._forget()
            self._announce()

    def _forget(self) -> None:
        """What was seen so far does not belong to the viewpoint that comes."""
        measured = self._window.measure()
        if measured is not None:
            self._before_m = measured.midpoint_m
        self._window.clear()
        if self._held is not None:
            self._held.clear()

    def _announce(self) -> None:
        viewpoint = self._left[self._index]
        x, y, z = viewpoint.midpoint_m
        self._say(
            f"{viewpoint.name} ({self._index + 1} of {len(self._left)}): {x * 100:.0f} cm before the display, "
            f"{abs(y) * 100:.0f} cm to its {'right' if y > 0 else 'left'}, {z * 100:.0f} cm up; "
            f"Enter: fused{', or hold still' if self._held is not None and self._rough is not None else ''}, n: next, "
            "p: previous, u: undo, q: stop"
        )
        if self._chart is not None:
            self._chart.show(viewpoint)
