"""The person's way through the viewpoints: what each key does, and when a pair is good enough to keep."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from calib.capture import EyeWindow, Measured
from calib.guidance import rough_similarity, way_to
from calib.keys import Key
from calib.pairs import CapturedPair, PairsFile
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_S
from runtime.records import F64, EyePoints

GUIDE_NS = NS_PER_S // 2  # between two words of guidance


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
    ) -> None:
        """chart: has `show(viewpoint)` and `caption(text)`; None: the person follows the charts elsewhere."""
        self._file, self._say, self._chart = file, say, chart
        self._left = [v for v in viewpoints if again or v.name not in file.viewpoints]
        self._window, self._max_spread_m = EyeWindow(window_s), max_spread_m
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
        if capture_ns - self._guided_ns >= GUIDE_NS and not self.finished:
            self._tell_way(capture_ns)

    def press(self, key: Key | None) -> None:
        """Do what a key says; None: nothing was pressed."""
        if key is None or self.finished:
            return
        if key is Key.QUIT:
            self.finished = True
        elif key is Key.ACCEPT:
            self._accept()
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

    def _accept(self) -> None:
        viewpoint = self._left[self._index]
        result = accept(self._window.measure(), viewpoint, max_spread_m=self._max_spread_m)
        if isinstance(result, str):
            self._say(f"{viewpoint.name}: not taken: {result}")
            return
        self._file.accept(replace(result, sensor_serial=self._serial))
        self._accepted += 1
        self._rough = rough_similarity(*self._file.points())
        self._say(f"{viewpoint.name}: taken, spread {result.spread_mm:.1f} mm, {len(self._file)} pairs in all")
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
        if name in places:
            self._go(places.index(name) - self._index)

    def _tell_way(self, now_ns: int) -> None:
        """Where to move, as soon as three pairs tell roughly where the camera stands."""
        measured = self._window.measure()
        if self._rough is None or measured is None:
            return
        self._guided_ns = now_ns
        eyes_m = self._rough.points(measured.midpoint_m[None])[0]
        way = way_to(self._left[self._index].midpoint_m, eyes_m) or "here: till the lines fuse; hold still, Enter"
        if way != self._guide:
            self._guide = way
            self._say(way)
            if self._chart is not None:
                self._chart.caption(way)

    def _go(self, step: int) -> None:
        index = min(max(self._index + step, 0), len(self._left) - 1)
        if index != self._index:
            self._index = index
            self._window.clear()
            self._announce()

    def _announce(self) -> None:
        viewpoint = self._left[self._index]
        x, y, z = viewpoint.midpoint_m
        self._say(
            f"{viewpoint.name} ({self._index + 1} of {len(self._left)}): {x * 100:.0f} cm before the display, "
            f"{abs(y) * 100:.0f} cm to its {'right' if y > 0 else 'left'}, {z * 100:.0f} cm up; "
            "Enter: fused, n: next, p: previous, u: undo, q: stop"
        )
        if self._chart is not None:
            self._chart.show(viewpoint)
