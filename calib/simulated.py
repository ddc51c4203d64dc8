"""Simulate the display, the sensor and the user for `setup --simulate`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from calib.hardware import Named, Poll, Sample, Say, SetupHardware
from calib.photographs import photographs
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.errors import InputError
from runtime.eyes.calibration import demo_sensor_from_stack
from runtime.optics.stack import PanelStack
from runtime.panels.monitors import Monitor
from runtime.records import U8, EyePoints

SENSOR_NOISE_M = 0.003  # standard deviation of each coordinate measured by the simulated depth camera
STANDING_M = 0.002  # standard deviation, per axis, of the user's position when the lines appear fused
SAMPLES_HERE = 16  # number of sensor samples per viewpoint, at 30 samples per second


class SimulatedHardware(SetupHardware):
    """Simulated monitors in random order, a depth sensor, and a user at each viewpoint. The sensor has
    the built-in recording's pose, so the configuration can be tried with `run --replay demo`.
    """

    simulated = True

    def __init__(
        self, keys: Poll, stack: PanelStack, *, say: Say, photos: Path = Path("photos"), seed: int = 0
    ) -> None:
        super().__init__(keys, photos=photos)
        self._random = random = np.random.default_rng(seed)
        # Monitor k is panel order[k]. Some panels are upside down, and some are mounted back to front.
        self.order = random.permutation(stack.count).tolist()
        self.mounted = [(int(random.choice([0, 180])), str(random.choice(["none", "horizontal"]))) for _ in self.order]
        self._stack, self._say = stack, say
        self._seen_ns = self._left = 0  # capture time of the newest sample; number of samples left at this viewpoint
        self._here, self._off_m = "", np.zeros(3)

    def monitors(self) -> tuple[Monitor, ...]:
        width, height = self._stack.width_px, self._stack.height_px
        return tuple(
            Monitor(f"SIM-{n}", f"S{n}", "simulated", n * width, 0, width, height, 60.0)
            for n in range(self._stack.count)
        )

    def show_card(self, number: int, words: Sequence[str]) -> None:
        rotation_deg, mirror = self.mounted[number]
        self._say(
            f"(simulated: this is panel {self.order[number]}, the arrow points {'down' if rotation_deg else 'up'} and "
            f"the text is {'mirrored' if mirror != 'none' else 'not mirrored'})"
        )

    def photographs(self, settings: Settings, pictures: U8, *, panel: int | None, say: Say) -> Iterator[Named]:
        folder = self._photos if panel is None else self._photos / f"grey-{panel}"
        if not folder.is_dir():
            raise InputError(
                folder, "", "contains no photographs because the display is simulated; press n to skip this step"
            )
        return photographs(folder, colour=panel is not None)

    def open_sensor(self, settings: Settings) -> str:
        return "a simulated sensor, placed as in the built-in recording"

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        if self._here != standing_at.name:
            self._here, self._off_m = standing_at.name, self._random.normal(scale=STANDING_M, size=3)
            self._left = SAMPLES_HERE
        if not self._left:
            return None
        self._left -= 1
        self._seen_ns += NS_PER_S // 30
        to_sensor = demo_sensor_from_stack()
        seen = (standing_at.eyes_m() + self._off_m) @ to_sensor[:3, :3].T + to_sensor[:3, 3]
        return (
            self._seen_ns,
            EyePoints(seen + self._random.normal(scale=SENSOR_NOISE_M, size=(2, 3)), np.ones(2)),
            "demo",
        )

    def chart(self, settings: Settings) -> Callable[[Viewpoint], None] | None:
        return None
