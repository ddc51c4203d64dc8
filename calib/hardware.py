"""Access to the hardware used during setup: keys, monitors, panels, photographs and a depth sensor."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import wrap

from calib.charts import Charts
from calib.display import PanelDisplay, grey_layers, open_display
from calib.keys import Key
from calib.photographs import photographs
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from runtime.config import Settings
from runtime.errors import InputError, PanelLost
from runtime.eyes.detect import EyeFinder
from runtime.panels.card import alone, identity_card
from runtime.panels.monitors import Monitor
from runtime.panels.window import every_monitor
from runtime.records import U8, EyePoints, SensorFrame
from runtime.sensor.live import SensorProcess, SensorSetup
from runtime.sensor.polling import OPEN_TIMEOUT_S, SensorState
from runtime.sensor.registry import open_sensor

Poll = Callable[[], Key | None]
Say = Callable[[str], None]
Named = tuple[str, U8]  # name and pixels of a photograph: (h, w), or (h, w, 3) of a grey chart
Sample = tuple[int, EyePoints | None, str]  # capture time in ns, eyes in the sensor frame, the sensor's serial number
POLL_NS = 20 * NS_PER_MS  # interval between polls for keys and samples
CARD_CHARACTERS = 32  # maximum number of characters per line on an identity card


class SetupHardware:
    """Real hardware: monitors on X11, a sensor, a folder of photographs and the keyboard. At most one set
    of windows and one sensor are open at a time, and `close` releases everything.
    """

    simulated = False

    def __init__(self, keys: Poll, *, photos: Path = Path("photos")) -> None:
        """Open nothing yet; `keys` returns the terminal's next key, `photos` is where the user puts photographs."""
        self._keys, self._photos = keys, photos
        self._clock = MonotonicClock()
        self._display: PanelDisplay | None = None  # the windows that are open
        self._charts: Charts | None = None
        self._cards: tuple[list[U8], tuple[Monitor, ...]] = ([], ())
        self._worker: SensorProcess | None = None
        self._frames: list[SensorFrame] = []  # received, but not yet returned by `sample`

    def poll(self) -> Key | None:
        """Return the next key of the terminal or a panel's window, or None; keep the windows responsive."""
        return self._keys() or (self._display.key() if self._display is not None else None)

    def key(self) -> Key:
        """Wait for a key press and return the key."""
        while (key := self.poll()) is None:
            self.wait()
        return key

    def wait(self) -> None:
        """Sleep until it is time to poll for keys and samples again."""
        self._clock.sleep_until_ns(self._clock.now_ns() + POLL_NS)

    def monitors(self) -> tuple[Monitor, ...]:
        """Open a window on every active monitor and return the monitors. Raises InputError if that fails."""
        self.let_go()
        try:
            panels, cards, monitors = every_monitor()
        except PanelLost as error:
            raise InputError("monitors", "", str(error)) from None
        self._display, self._cards = PanelDisplay(panels), (cards, monitors)
        return monitors

    def show_card(self, number: int, words: Sequence[str]) -> None:
        """Show a card with lines of text, wrapped, on one of `monitors`, and clear the others."""
        cards, monitors = self._cards
        height, width = cards[number].shape[:2]
        lines = [line for text in words for line in wrap(text, CARD_CHARACTERS)]
        card = identity_card(width, height, title=monitors[number].connector, lines=lines)
        if self._display is not None:
            self._display.show(alone([*cards[:number], card, *cards[number + 1 :]], number))

    def photographs(self, settings: Settings, pictures: U8, *, panel: int | None, say: Say) -> Iterator[Named]:
        """Show (N, H, W) grey pictures without registration, wait for the user's photographs and return them.
        `panel` is the one that shows the grey chart, with no grey curve, or None for the boards. Raises InputError if
        the user stopped or no photograph is readable, and PanelLost.
        """
        self.let_go()
        folder = self._photos if panel is None else self._photos / f"grey-{panel}"
        count = "8 to 20 photographs of the boards" if panel is None else "two or three photographs of the chart"
        self._display = open_display(settings, grey_curve=panel is None)
        try:
            self._display.show(grey_layers(pictures))
            say(f"put {count} into {folder} and press Enter, or press q to stop")
            while (key := self.key()) is not Key.ACCEPT:
                if key is Key.QUIT:
                    raise InputError(
                        "photographs", "", "no photographs were taken; put them into the folder before pressing Enter"
                    )
        finally:
            self.let_go()
        return photographs(folder, colour=panel is not None)

    def open_sensor(self, settings: Settings) -> str:
        """Start the sensor, wait until it works, and return its name and serial number. Raises InputError."""
        self._stop_sensor()
        make_driver = partial(open_sensor, settings.sensor, self._clock)
        worker = SensorProcess(SensorSetup(make_driver, settings.sensor, self._clock, partial(EyeFinder, settings)))
        self._worker = worker
        worker.start()
        until_ns = self._clock.now_ns() + round(OPEN_TIMEOUT_S * NS_PER_S)
        while worker.state is not SensorState.RUNNING:
            if worker.error is not None:
                raise worker.error
            if self._clock.now_ns() > until_ns:
                reason = worker.reason or "the sensor does not answer"
                self._stop_sensor()
                raise InputError("sensor", "driver", f"{settings.sensor.driver}: {reason}")
            self.wait()
        if worker.capabilities.in_stack_frame:
            self._stop_sensor()
            raise InputError("sensor", "driver", "delivers eyes in the stack frame and needs no calibration")
        return f"{settings.sensor.driver} {worker.serial}".strip()

    def sample(self, standing_at: Viewpoint) -> Sample | None:
        """Return the sensor's next sample, or None. Only the simulation uses `standing_at`."""
        if self._worker is None:
            return None
        if self._worker.error is not None:
            raise self._worker.error
        if not self._frames:
            self._frames = self._worker.take()
        if not self._frames:
            return None
        frame = self._frames.pop(0)
        return frame.capture_ns, frame.eyes, self._worker.serial

    def chart(self, settings: Settings) -> Callable[[Viewpoint], None] | None:
        """Return a function that shows a viewpoint's chart, or None if charts cannot be shown."""
        self.let_go()
        charts, display = Charts(settings), open_display(settings, registered=True)
        self._charts, self._display = charts, display
        return lambda viewpoint: display.show(charts.layers(viewpoint))

    def close(self) -> None:
        """Close the windows, the model and the sensor. Further calls have no effect."""
        self.let_go()
        self._stop_sensor()

    def let_go(self) -> None:
        """Close the windows and the model that computes the charts' layers."""
        for part in (self._display, self._charts):
            if part is not None:
                part.close()
        self._display = self._charts = None

    def _stop_sensor(self) -> None:
        if self._worker is not None:
            self._worker.close()
            self._worker, self._frames = None, []
