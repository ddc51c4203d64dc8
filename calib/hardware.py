"""What setting up touches: keys, monitors, panels, a camera, a depth sensor. The real ones, or a simulated display."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from textwrap import wrap
from typing import Any

import cv2
import numpy as np
from rich.console import Console
from rich.text import Text

from calib.charts import Charts
from calib.display import PanelDisplay, grey_layers, message_layers, open_display
from calib.keys import Key
from calib.photographs import photographs
from calib.placed import PlacedPanel, misplaced
from calib.simulator import Exposure, Scene, by_hand, camera_from_stack, camera_rays, phone, photograph
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from runtime.config import Settings
from runtime.errors import InputError, PanelLost
from runtime.eyes.demo_geometry import demo_sensor_from_stack
from runtime.eyes.detect import EyeFinder
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.panels.card import alone, identity_card
from runtime.panels.monitors import Monitor
from runtime.panels.window import every_monitor
from runtime.records import F64, U8, EyePoints
from runtime.sensor.registry import open_sensor
from runtime.sensor.worker import OPEN_TIMEOUT_S, SensorWorker

Poll = Callable[[], Key | None]
Say = Callable[[str], None]
Named = tuple[str, U8]  # a photograph (h, w), and what to call it
Sample = tuple[int, EyePoints | None, str]  # when it was taken, eyes in frame `sensor`, the sensor's serial
POLL_NS = 20 * NS_PER_MS
TERMINAL_COLUMNS = 72  # of a picture in a terminal
CARD_CHARACTERS = 32  # of a line on a card


class SetupHardware:
    """A display, its monitors on X11, its sensor; photographs from a folder; a person at the keys."""

    simulated = False

    def __init__(self, keys: Poll, *, photos: Path = Path("photos")) -> None:
        """keys: of the terminal; those of the panels' windows count besides."""
        self._keys, self._photos = keys, photos
        self._clock = MonotonicClock()
        self._display: PanelDisplay | None = None  # whatever windows are open: only one owner at a time
        self._charts: Charts | None = None
        self._bound: Any = None  # the output settings that words are shown on
        self._cards: tuple[list[U8], tuple[Monitor, ...]] = ([], ())
        self._worker: SensorWorker | None = None

    def poll(self) -> Key | None:
        """A key that was pressed in the terminal or on a panel's window, which stays alive by being asked."""
        return self._keys() or (self._display.key() if self._display is not None else None)

    def key(self) -> Key:
        """Wait for a key."""
        while (key := self.poll()) is None:
            self.wait()
        return key

    def wait(self) -> None:
        """A moment."""
        self._clock.sleep_until_ns(self._clock.now_ns() + POLL_NS)

    def monitors(self) -> tuple[Monitor, ...]:
        """The active monitors. Raises InputError."""
        self.let_go()
        try:
            panels, cards, monitors = every_monitor()
        except PanelLost as error:
            raise InputError("monitors", "", str(error)) from None
        self._display, self._cards = PanelDisplay(panels), (cards, monitors)
        return monitors

    def show_card(self, number: int, words: Sequence[str]) -> None:
        """Monitor `number` shows its identity card with words as it is sent, the others are clear."""
        cards, monitors = self._cards
        height, width = cards[number].shape[:2]
        lines = [line for text in words for line in wrap(text, CARD_CHARACTERS)]
        card = identity_card(width, height, title=monitors[number].connector, lines=lines)
        if self._display is not None:
            self._display.show(alone([*cards[:number], card, *cards[number + 1 :]], number))

    def show_words(self, settings: Settings, lines: Sequence[str]) -> None:
        """Words on the panels, where they are bound already."""
        if settings.output.kind == "offscreen" or not settings.output.panels:
            return
        try:
            if self._display is None or self._bound != settings.output:
                self.let_go()
                self._display, self._bound = open_display(settings), settings.output
            self._display.show(message_layers(settings.stack.stack(), lines))
        except (InputError, PanelLost):
            self.let_go()  # the terminal has the same words

    def photographs(self, settings: Settings, pictures: U8, *, panel: int | None, say: Say) -> Iterator[Named]:
        """Photographs of what the bare panels show (N, H, W): the boards, or the grey chart of one panel.

        Raises InputError, PanelLost.
        """
        self.let_go()
        folder = self._photos if panel is None else self._photos / f"grey-{panel}"
        count = "8 to 20 photographs of the boards" if panel is None else "two or three photographs of it"
        self._display = open_display(settings, grey_curve=panel is None)
        try:
            self._display.show(grey_layers(pictures))
            say(f"put {count} into {folder}, then Enter (q: stop)")
            while (key := self.key()) is not Key.ACCEPT:
                if key is Key.QUIT:
                    raise InputError("photographs", "", "stopped before there were any")
        finally:
            self.let_go()
        return photographs(folder)

    def open_sensor(self, settings: Settings) -> str:
        """Start the sensor and wait for it; returns what it is. Raises InputError."""
        self._stop_sensor()
        open_sensor(settings.sensor, self._clock)  # refuses unknown names before anything starts
        worker = SensorWorker(
            lambda: open_sensor(settings.sensor, self._clock),
            settings.sensor,
            self._clock,
            lambda: EyeFinder(settings).find,
        )
        worker.start()
        self._worker = worker
        until_ns = self._clock.now_ns() + round(OPEN_TIMEOUT_S * NS_PER_S)
        while worker.capabilities is None:
            if worker.error is not None:
                raise worker.error
            if self._clock.now_ns() > until_ns:
                reason = worker.reason or "does not answer"
                self._stop_sensor()
                raise InputError("sensor", "driver", f"{settings.sensor.driver}: {reason}")
            self.wait()
        if worker.capabilities.in_stack_frame:
            self._stop_sensor()
            raise InputError("sensor", "driver", "its eyes are in the stack's frame already: nothing to calibrate")
        return f"{settings.sensor.driver} {worker.serial}".strip()

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        """The newest sample, if there is one that was not returned before.

        standing_at: where the person is asked to stand; a simulated one does.
        """
        if self._worker is None:
            return None
        if self._worker.error is not None:
            raise self._worker.error
        frames = self._worker.take()
        return (frames[-1].capture_ns, frames[-1].eyes, self._worker.serial) if frames else None

    def chart(self, settings: Settings) -> Callable[[Viewpoint], None] | None:
        """What shows a viewpoint's chart while capturing; None: nobody sees any."""
        self.let_go()
        charts, display = Charts(settings), open_display(settings, registered=True)
        self._charts, self._display = charts, display
        return lambda viewpoint: display.show(charts.layers(viewpoint))

    def close(self) -> None:
        """Give everything back. May be called twice."""
        self.let_go()
        self._stop_sensor()

    def let_go(self) -> None:
        """Close whatever windows are open, and the model that draws for them."""
        for part in (self._display, self._charts):
            if part is not None:
                part.close()
        self._display = self._bound = self._charts = None

    def _stop_sensor(self) -> None:
        if self._worker is not None:
            self._worker.close()
            self._worker = None


# How a simulated display was put together: carefully, by hand.
SHIFT_M, TURN_DEG, GAP_M = 0.002, 0.25, 0.0005
SENSOR_NOISE_M = 0.003
STANDING_M = 0.002  # how exactly a person finds the place where the lines fuse, an axis
SENSOR_NS = NS_PER_S // 30
ARRIVED = 16  # samples that are there when the person is: half a second
PHOTOGRAPHS, BOARD_SIZE = 8, 0.8  # of a phone's 12 megapixels: width and height
GREY_PLACES, GREY_SIZE = ((1.45, 0.0, 0.0), (1.5, 0.2, 0.1)), 0.7  # in widths of the display
GREY_GAMMA, GREY_SPREAD = 2.2, 0.2  # of the light that a panel's monitor makes of a grey, about


class SimulatedHardware(SetupHardware):
    """A display that is not there: its panels are off, its monitors mixed up, and a person stands where asked to.

    The terminal says what a person would see. The depth sensor stands where the built-in recording's does, so that
    `run` can replay that afterwards.
    """

    simulated = True

    def __init__(self, keys: Poll, stack: PanelStack, *, say: Say, seed: int = 0) -> None:
        super().__init__(keys)
        self._random = np.random.default_rng(seed)
        self.true_panels: tuple[PlacedPanel, ...] = misplaced(
            stack, shift_m=SHIFT_M, turn_deg=TURN_DEG, gap_m=GAP_M, random=self._random
        )
        # Monitor k is panel order[k]; some stand on their heads, some are seen from behind.
        self.order = self._random.permutation(stack.count).tolist()
        self.mounted = [
            (int(self._random.choice([0, 180])), str(self._random.choice(["none", "horizontal"])))
            for _ in range(stack.count)
        ]
        self.grey_gammas = GREY_GAMMA + self._random.uniform(-1, 1, stack.count) * GREY_SPREAD
        self._stack, self._say = stack, say
        self._seen_ns = 0  # when the newest sample was taken
        self._next_ns = 0  # when the next one comes, by the clock
        self._here: tuple[str, Any] = ("", np.zeros(3))
        self._waiting = 0  # samples that need no waiting for

    def monitors(self) -> tuple[Monitor, ...]:
        width, height = self._stack.width_px, self._stack.height_px
        return tuple(
            Monitor(f"SIM-{n}", f"S{n}", "simulated", n * width, 0, width, height, 60.0)
            for n in range(self._stack.count)
        )

    def show_card(self, number: int, words: Sequence[str]) -> None:
        """In the terminal: the card as it stands before the person, and which panel it is on."""
        rotation_deg, mirror = self.mounted[number]
        lines = [line for text in words for line in wrap(text, CARD_CHARACTERS)]
        card = identity_card(self._stack.width_px, self._stack.height_px, title=f"SIM-{number}", lines=lines)
        seen = card[::-1, ::-1] if rotation_deg else card
        show_in_terminal(seen[:, ::-1] if mirror != "none" else seen)
        self._say(
            f"(simulated: it is panel {self.order[number]}; its arrow points {'down' if rotation_deg else 'up'}, its "
            f"writing {'is mirrored' if mirror != 'none' else 'reads rightly'})"
        )

    def show_words(self, settings: Settings, lines: Sequence[str]) -> None:
        """The terminal has them."""

    def phase_of(self, panel: int, grey: F64) -> F64:
        """(...) the phase that a panel truly has where it is sent a grey in [0, 1]."""
        return phase_from_intensity(np.asarray(grey, dtype=np.float64) ** self.grey_gammas[panel], branch=1)

    def photographs(self, settings: Settings, pictures: U8, *, panel: int | None, say: Say) -> Iterator[Named]:
        stack, codes = settings.stack.stack(), np.arange(256) / 255
        turned = [np.rint(255 * self.phase_of(index, codes)).astype(np.uint8) for index in range(stack.count)]
        phases = np.stack([turn[picture] for turn, picture in zip(turned, pictures, strict=True)])
        scene = Scene(stack, self.true_panels, phases)
        if panel is None:
            lens, exposure = phone(random=self._random, size=BOARD_SIZE), Exposure()
            poses = by_hand(PHOTOGRAPHS, stack, random=self._random)
        else:
            lens = phone(random=self._random, size=GREY_SIZE)
            exposure = Exposure(dark=0.004, gain=0.85, samples=3)
            places = np.array(GREY_PLACES) * stack.width_m
            poses = [camera_from_stack(place, towards_m=np.zeros(3)) for place in places]
        say(f"(simulated: {len(poses)} photographs by hand, with a phone)")
        rays = camera_rays(lens)
        for number, pose in enumerate(poses, start=1):
            yield f"photograph {number}", photograph(scene, lens, pose, exposure, random=self._random, rays=rays)

    def open_sensor(self, settings: Settings) -> str:
        return "a simulated sensor, where the built-in recording's stands"

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        """A sample 30 times a second; half a second of them at once where the person has just come."""
        if self._here[0] != standing_at.name:
            self._here = (standing_at.name, self._random.normal(scale=STANDING_M, size=3))
            self._waiting = ARRIVED
        if self._waiting:
            self._waiting -= 1
        elif self._clock.now_ns() < self._next_ns:
            return None
        self._next_ns = self._clock.now_ns() + SENSOR_NS
        self._seen_ns += SENSOR_NS  # evenly, however busy the machine is
        eyes_m = standing_at.eyes_m() + self._here[1]
        to_sensor = demo_sensor_from_stack()
        seen = eyes_m @ to_sensor[:3, :3].T + to_sensor[:3, 3]
        seen = seen + self._random.normal(scale=SENSOR_NOISE_M, size=(2, 3))
        return self._seen_ns, EyePoints(seen, np.ones(2)), "demo"

    def chart(self, settings: Settings) -> Callable[[Viewpoint], None] | None:
        return None


def show_in_terminal(picture: U8) -> None:
    """A picture (h, w, 4) as coloured half blocks, where stdout is a terminal."""
    if not sys.stdout.isatty():
        return
    rows = round(TERMINAL_COLUMNS * picture.shape[0] / picture.shape[1] / 2) * 2
    small = cv2.resize(np.ascontiguousarray(picture[..., :3]), (TERMINAL_COLUMNS, rows), interpolation=cv2.INTER_AREA)
    text = Text()
    for above, below in zip(small[::2].tolist(), small[1::2].tolist(), strict=True):
        for (r, g, b), (s, h, c) in zip(above, below, strict=True):
            text.append("▀", style=f"rgb({r},{g},{b}) on rgb({s},{h},{c})")
        text.append("\n")
    Console().print(text)
