"""What setting up touches: monitors, panels, a camera, a depth sensor. The real ones, or a simulated display."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np

from calib.bare_panels import BarePanels
from calib.board import board_layers
from calib.capture_run import eye_finder
from calib.chart_files import ChartDisplay, Drawer
from calib.charts import alone
from calib.detect_marks import SeenMarks, find_marks
from calib.grey_chart import grey_chart
from calib.keys import Key, WindowKeys, first_of
from calib.message import message_layers
from calib.photo_live import one_picture, open_video, take_live
from calib.photo_run import look_at, photograph_files, read_photograph
from calib.photo_trial import simulated_photographs
from calib.placed import PlacedPanel, in_frame_of, misplaced
from calib.simulator import Exposure, Scene, camera_from_stack, phone, photograph, smaller
from calib.viewpoints import IPD_M, Viewpoint
from runtime.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from runtime.commands.identify import alone as card_alone
from runtime.commands.identify import every_monitor
from runtime.config import Settings
from runtime.errors import InputError, PanelLost
from runtime.eyes.demo_geometry import demo_sensor_from_stack
from runtime.optics.malus import phase_from_intensity
from runtime.optics.stack import PanelStack
from runtime.panels.card import identity_card
from runtime.panels.monitors import Monitor
from runtime.records import F64, U8, EyePoints, PanelFrame
from runtime.sensor.registry import open_sensor
from runtime.sensor.worker import SensorWorker

Poll = Callable[[], Key | None]
Say = Callable[[str], None]
GREY_PHOTOGRAPHS = 2
POLL_NS = 20 * NS_PER_MS
CARD_CHARACTERS = 32  # of a line on a card


@dataclass(frozen=True, slots=True)
class Sample:
    """What the sensor saw at one instant, frame `sensor`."""

    capture_ns: int
    eyes: EyePoints | None
    serial: str


class World(ABC):
    """Everything outside the program that the steps need."""

    simulated: bool

    @abstractmethod
    def monitors(self) -> tuple[Monitor, ...]:
        """The active monitors. Raises InputError."""

    @abstractmethod
    def show_card(self, number: int, words: Sequence[str]) -> None:
        """Monitor `number` shows its identity card with words as it is sent, the others are clear."""

    @abstractmethod
    def show_words(self, settings: Settings, lines: Sequence[str]) -> None:
        """Words on the panels, where they are bound already."""

    @abstractmethod
    def photographs(self, settings: Settings, *, poll: Poll, say: Say) -> tuple[list[SeenMarks], str]:
        """Photographs of the boards, their marks found, and what to call them. Raises InputError."""

    @abstractmethod
    def grey_photographs(self, settings: Settings, panel: int, *, poll: Poll, say: Say) -> list[tuple[str, U8]]:
        """Photographs (h, w) of a panel's grey chart, each with its name. Raises InputError."""

    @abstractmethod
    def open_sensor(self, settings: Settings) -> str:
        """Start the sensor and wait for it; answers what it is. Raises InputError."""

    @abstractmethod
    def sample(self, standing_at: Viewpoint) -> Sample | None:
        """The newest sample, if there is one that was not answered before.

        standing_at: where the person is asked to stand; a simulated one does.
        """

    @abstractmethod
    def chart(self, settings: Settings) -> Any:
        """What shows charts and captions while capturing (`ChartDisplay`); None: nobody sees any."""

    @abstractmethod
    def wait(self) -> None:
        """A moment, so that nothing spins."""

    @abstractmethod
    def keys(self) -> Key | None:
        """A key that was pressed on a panel's window."""

    @abstractmethod
    def close(self) -> None:
        """Give everything back. May be called twice."""


class RealWorld(World):
    """A display, its monitors on X11; photographs from a folder or a video device."""

    simulated = False

    def __init__(self, *, photos: Path | None, device: str | None) -> None:
        self._photos, self._device = photos, device
        self._clock = MonotonicClock()
        self._cards: tuple[Any, list[U8], tuple[Monitor, ...]] | None = None
        self._card: tuple[tuple[int, tuple[str, ...]], U8] | None = None  # the one that was shown last, and of what
        self._panels: Any = None
        self._bound: Any = None
        self._window_keys: Any = None
        self._worker: Any = None
        self._find: Any = None
        self._number = 0

    def monitors(self) -> tuple[Monitor, ...]:
        self._let_go()
        try:
            panels, cards, monitors = every_monitor()
        except PanelLost as error:
            raise InputError("monitors", "", str(error)) from None
        self._cards = (panels, cards, monitors)
        self._watch(panels)
        return monitors

    def show_card(self, number: int, words: Sequence[str]) -> None:
        assert self._cards is not None
        panels, cards, monitors = self._cards
        wanted = (number, tuple(words))
        if self._card is None or self._card[0] != wanted:
            height, width = cards[number].shape[:2]
            lines = [line for text in words for line in wrap(text, CARD_CHARACTERS)]
            self._card = wanted, identity_card(width, height, title=monitors[number].connector, lines=lines)
        shown = [self._card[1] if index == number else card for index, card in enumerate(cards)]
        self._number += 1
        panels.present(PanelFrame(self._number, card_alone(shown, number), self._number))

    def show_words(self, settings: Settings, lines: Sequence[str]) -> None:
        try:
            panels = self._bare(settings)
            if panels is not None:
                panels.show(message_layers(settings.stack.stack(), lines))
        except (InputError, PanelLost):
            self._let_go()  # the terminal has the same words

    def photographs(self, settings: Settings, *, poll: Poll, say: Say) -> tuple[list[SeenMarks], str]:
        stack = settings.stack.stack()
        panels = self._bare(settings)
        if panels is None:
            raise InputError("output", "panels", "are not bound to monitors yet: the step before this one")
        panels.show(board_layers(stack))
        if self._device is not None:

            def stop() -> bool:
                panels.again()
                return poll() in (Key.ACCEPT, Key.QUIT)

            return take_live(self._device, stack, wanted=12, say=say, stop=stop), self._device
        folder = self._photos or Path("photos")
        say(f"the boards are shown: put 8 to 20 photographs into {folder}, then Enter (q: stop)")
        while (key := poll()) is not Key.ACCEPT:
            if key is Key.QUIT:
                raise InputError("photographs", "", "stopped before there were any")
            panels.again()
        return look_at(photograph_files(folder), stack), str(folder)

    def grey_photographs(self, settings: Settings, panel: int, *, poll: Poll, say: Say) -> list[tuple[str, U8]]:
        self._let_go()
        stack = settings.stack.stack()
        video = None if self._device is None else open_video(self._device)
        panels = None
        try:
            panels = BarePanels(settings, stack, grey_curve=False)
            poll = first_of(poll, panels.keys.poll)
            panels.show(alone(grey_chart(stack, panel), stack, index=panel))
            found: list[tuple[str, U8]] = []
            folder = (self._photos or Path("photos")) / f"grey-{panel}"
            while len(found) < GREY_PHOTOGRAPHS:
                place = f"photograph {len(found) + 1} of {GREY_PHOTOGRAPHS}, each from another place"
                asked = place if video is not None else f"put two or three photographs of it into {folder}"
                say(f"panel {panel} shows its grey chart: {asked}, then Enter (q: stop)")
                while (key := poll()) is not Key.ACCEPT:
                    if key is Key.QUIT:
                        raise InputError("photographs", "", "stopped before there were enough")
                    panels.again()
                    if video is not None:
                        one_picture(video)  # else a buffer of old ones would be read
                if video is None:
                    return [(str(path), read_photograph(path)) for path in photograph_files(folder)]
                found.append((f"photograph {len(found) + 1}", one_picture(video)))
            return found
        finally:
            if panels is not None:
                panels.close()
            if video is not None:
                video.release()

    def open_sensor(self, settings: Settings) -> str:
        self._stop_sensor()
        open_sensor(settings.sensor, self._clock)  # refuses unknown names before anything starts
        worker = SensorWorker(lambda: open_sensor(settings.sensor, self._clock), settings.sensor, self._clock)
        worker.start()
        self._worker = worker
        until_ns = self._clock.now_ns() + round(settings.sensor.open_timeout_s * NS_PER_S)
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
        self._find = eye_finder(worker, settings)  # type: ignore[arg-type]
        return f"{settings.sensor.driver} {worker.serial}".strip()

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        if self._worker is None:
            return None
        if self._worker.error is not None:
            raise self._worker.error
        frame = self._worker.newest()
        return None if frame is None else Sample(frame.capture_ns, self._find(frame), self._worker.serial)

    def chart(self, settings: Settings) -> Any:
        self._let_go()
        ipd_m = settings.calibration.ipd_m or IPD_M
        drawer = Drawer(settings.stack.stack(), kind="solved", ipd_m=ipd_m, model="best", settings=settings.model)
        chart = ChartDisplay(settings, drawer)
        self._window_keys = chart.keys
        return chart

    def wait(self) -> None:
        self._clock.sleep_until_ns(self._clock.now_ns() + POLL_NS)
        if self._panels is not None:
            self._panels.again()

    def keys(self) -> Key | None:
        return self._window_keys.poll() if self._window_keys is not None else None

    def close(self) -> None:
        self._let_go()
        self._stop_sensor()

    def _bare(self, settings: Settings) -> Any:
        if settings.output.kind == "offscreen" or not settings.output.panels:
            return None
        if self._panels is None or self._bound != settings.output:
            self._let_go()
            self._panels, self._bound = BarePanels(settings, settings.stack.stack()), settings.output
            self._window_keys = self._panels.keys
        return self._panels

    def _watch(self, sink: Any) -> None:
        self._window_keys = WindowKeys(sink)

    def _let_go(self) -> None:
        """Close whatever windows are open: only one owner at a time."""
        self._window_keys = None
        if self._cards is not None:
            self._cards[0].close()
            self._cards = None
        if self._panels is not None:
            self._panels.close()
            self._panels = None

    def _stop_sensor(self) -> None:
        if self._worker is not None:
            self._worker.stop()
            self._worker = None


@dataclass(frozen=True, slots=True)
class Built:
    """How a simulated display was put together: carefully, by hand."""

    shift_m: float = 0.002
    turn_deg: float = 0.25
    gap_m: float = 0.0005
    sensor_noise_m: float = 0.003
    standing_m: float = 0.002  # how exactly a person finds the place where the lines fuse, an axis
    photographs: int = 8
    megapixels: float = 8.0
    grey_gamma: float = 2.2  # of what a panel's monitor makes of a grey: of its light, about
    grey_spread: float = 0.2


class SimulatedWorld(World):
    """A display that is not there: its panels are off, its monitors mixed up, and a person stands where asked to.

    The depth sensor stands where the built-in recording's does, so that `run` can replay that afterwards.
    """

    simulated = True

    def __init__(self, stack: PanelStack, *, seed: int = 0, built: Built | None = None) -> None:
        self.built = built or Built()
        self._random = np.random.default_rng(seed)
        self.truth: tuple[PlacedPanel, ...] = misplaced(
            stack, shift_m=self.built.shift_m, turn_deg=self.built.turn_deg, gap_m=self.built.gap_m,
            random=self._random,
        )  # fmt: skip
        # Monitor k is panel order[k]; some stand on their heads, some are seen from behind.
        self.order = self._random.permutation(stack.count).tolist()
        self.mounted = [
            (int(self._random.choice([0, 180])), str(self._random.choice(["none", "horizontal"])))
            for _ in range(stack.count)
        ]
        self.grey_gammas = self.built.grey_gamma + self._random.uniform(-1, 1, stack.count) * self.built.grey_spread
        self._stack = stack
        self._said: Say = lambda text: None
        self._now_ns = 0
        self._here: tuple[str, Any] = ("", np.zeros(3))

    def listen(self, say: Say) -> None:
        """Where to tell what a person would see."""
        self._said = say

    def true_panels(self) -> tuple[PlacedPanel, ...]:
        """The panels in the frame that a registration gives them."""
        reference = self._stack.count // 2
        return in_frame_of(self.truth, reference=reference, reference_x_m=self._stack.x_m[reference])

    def monitors(self) -> tuple[Monitor, ...]:
        width, height = self._stack.width_px, self._stack.height_px
        return tuple(
            Monitor(f"SIM-{n}", f"S{n}", "simulated", n * width, 0, width, height, 60.0)
            for n in range(self._stack.count)
        )

    def show_card(self, number: int, words: Sequence[str]) -> None:
        """Tells what a person would see of it, since nobody can look."""
        rotation_deg, mirror = self.mounted[number]
        self._said(
            f"(simulated: it is panel {self.order[number]}; its arrow points {'down' if rotation_deg else 'up'}, its "
            f"writing {'is mirrored' if mirror != 'none' else 'reads rightly'})"
        )

    def show_words(self, settings: Settings, lines: Sequence[str]) -> None:
        """Nobody would see them."""

    def photographs(self, settings: Settings, *, poll: Poll, say: Say) -> tuple[list[SeenMarks], str]:
        say(f"taking {self.built.photographs} simulated photographs by hand, with a phone ...")
        pictures = simulated_photographs(
            settings.stack.stack(), self.truth, count=self.built.photographs, megapixels=self.built.megapixels,
            random=self._random,
        )  # fmt: skip
        stack = settings.stack.stack()
        return [find_marks(p, stack, name=f"photograph {n + 1}") for n, p in enumerate(pictures)], "simulated"

    def phase_of(self, panel: int, grey: F64) -> F64:
        """(...) the phase that a panel truly has where it is sent a grey in [0, 1]."""
        return phase_from_intensity(np.asarray(grey, dtype=np.float64) ** self.grey_gammas[panel], branch=1)

    def grey_photographs(self, settings: Settings, panel: int, *, poll: Poll, say: Say) -> list[tuple[str, U8]]:
        say(f"taking {GREY_PHOTOGRAPHS} simulated photographs of panel {panel}'s grey chart ...")
        stack = settings.stack.stack()
        layers = np.zeros((stack.count, stack.height_px, stack.width_px), np.uint8)
        layers[panel] = np.rint(255 * self.phase_of(panel, np.arange(256) / 255)).astype(np.uint8)[
            grey_chart(stack, panel)
        ]
        scene = Scene(stack, self.truth, layers)
        lens = smaller(phone(random=self._random), 0.7)
        places = np.array([[1.45, 0.0, 0.0], [1.5, 0.2, 0.1]]) * stack.width_m
        exposure = Exposure(dark=0.004, gain=0.85, samples=3)
        return [
            (f"photograph {number + 1}", photograph(scene, lens, camera_from_stack(place, towards_m=np.zeros(3)),
                                                    exposure, random=self._random))
            for number, place in enumerate(places)
        ]  # fmt: skip

    def open_sensor(self, settings: Settings) -> str:
        return "a simulated sensor, where the built-in recording's stands"

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        if self._here[0] != standing_at.name:
            place = standing_at.midpoint_m + self._random.normal(scale=self.built.standing_m, size=3)
            self._here = (standing_at.name, place - standing_at.midpoint_m)
        eyes_m = standing_at.eyes_m() + self._here[1]
        to_sensor = demo_sensor_from_stack()
        seen = eyes_m @ to_sensor[:3, :3].T + to_sensor[:3, 3]
        seen = seen + self._random.normal(scale=self.built.sensor_noise_m, size=(2, 3))
        self._now_ns += round(NS_PER_S / 30)
        return Sample(self._now_ns, EyePoints(seen, np.ones(2)), "demo")

    def chart(self, settings: Settings) -> Any:
        return None

    def wait(self) -> None:
        """Simulated time needs no waiting for."""

    def keys(self) -> Key | None:
        return None

    def close(self) -> None:
        """There is nothing to give back."""
