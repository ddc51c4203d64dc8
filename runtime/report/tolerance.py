"""Cost in light of each imperfection of real panels, on layers solved for ideal panels."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from runtime.config import ModelSettings
from runtime.evaluation.displayed import on_panels_raster
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.carried import expected_errors
from runtime.optics.light import LIGHT
from runtime.optics.quality import psnr_db
from runtime.optics.real.cells import Cell, Curve
from runtime.optics.real.light import RealSampling, Sight, real_light
from runtime.optics.real.panels import Lighting, Optics, Placement, RealPanels, Timing
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.report.pairs import StillPair

PIXELS = 4000  # pixels of a picture that are measured, about; a quarter of them at displaced eyes
PIXELS_FIRST = 600  # for the first version of the page
PASSED = 6.0  # rays that pass all panels in each set of a pixel's rays, about
SIGMA_MM = 1.0
HEAD_M_S = 0.1  # speed of the head where time matters
Make = Callable[[float, PanelStack], RealPanels]
PanelMaker = Callable[[PanelStack], RealPanels]
T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Imperfection:
    """One way in which real panels differ from ideal ones."""

    name: str
    unit: str  # unit of `sizes`, "" for a choice
    sizes: tuple[float, ...]  # the first is that of ideal panels
    assumed: float  # size with ordinary monitors that are mounted by hand and not calibrated
    left: float  # size that is left after `remedy`
    remedy: str  # what reduces it from `assumed` to `left`, or empty
    make: Make  # panels with this imperfection alone
    note: str = ""
    make_left: Make | None = None  # panels after the remedy, of the size `assumed`; None: those of the size `left`
    choices: tuple[str, ...] = ()  # names of `sizes`, for a choice
    is_avoided: bool = False  # the stack does not have it, because other panels are ordered

    def named(self, size: float) -> str:
        """Return a size with its unit, or the name of a choice."""
        if self.choices:
            return self.choices[self.sizes.index(size)]
        return f"{size:.3g} {self.unit}" if size != self.sizes[0] else "none"

    def after(self, stack: PanelStack) -> RealPanels:
        """Return the panels after the remedy."""
        return self.make_left(self.assumed, stack) if self.make_left else self.make(self.left, stack)


@dataclass(frozen=True)
class Subject:
    """Layers for a pair, and the error of their light on ideal panels."""

    pair: StillPair
    layers: U8
    ideal_error: float  # mean squared error of the light on ideal panels, measured with many more rays

    @property
    def sight(self) -> Sight:
        return Sight(self.pair.eyes_m, self.pair.images, self.pair.fov_deg, SIGMA_MM)

    def sampling(self, pixels: int) -> RealSampling:
        """Return rays through about `pixels` pixels of each picture."""
        height, width = self.pair.images[0].shape[:2]
        return RealSampling(step=max(1, math.ceil(math.sqrt(height * width / pixels))), thinned=True)


@dataclass
class Cost:
    """Measured cost of an imperfection."""

    imperfection: Imperfection
    light_db: list[float] = field(default_factory=list)  # for each size
    assumed_db: float = math.nan  # light at the assumed size
    left_db: float = math.nan  # light at the size that is left

    def costs_1_db_at(self, ideal_db: float) -> float | None:
        """Return the size that costs 1 dB, interpolated, or None if no size does or it is a choice."""
        if not self.imperfection.unit:
            return None
        return falls_at(self.imperfection.sizes, [ideal_db - db for db in self.light_db], 1.0)


def falls_at(sizes: Sequence[float], costs_db: Sequence[float], by_db: float) -> float | None:
    """Return the first size that costs `by_db`, interpolated, or None if no measured size does."""
    for n in range(1, len(costs_db)):
        if costs_db[n] >= by_db:
            share = (by_db - costs_db[n - 1]) / (costs_db[n] - costs_db[n - 1])
            return float(sizes[n - 1] + (sizes[n] - sizes[n - 1]) * min(max(share, 0.0), 1.0))
    return None


def solved(pair: StillPair, model: str = "balanced") -> Subject:
    """Compute the layers for a pair, and their light on ideal panels.

    Light is compared with the pictures at the panels' resolution, as `solve` does.
    """
    predictor = load_predictor(model, pair.stack, ModelSettings(backend="cpu"))
    try:
        left, right = pair.images
        layers = solve_still(
            left, right, eyes_m=pair.eyes_m, fov_deg=pair.fov_deg, predictor=predictor, eye_sigma_mm=SIGMA_MM
        ).layers
    finally:
        predictor.close()
    codes = np.ascontiguousarray(layers[..., :3])
    pair = replace(pair, images=tuple(on_panels_raster(picture, pair.stack) for picture in pair.images))
    return Subject(pair, codes, ideal_error(pair, codes))


def ideal_error(pair: StillPair, layers: U8) -> float:
    """Return the mean squared error of the light on ideal panels, for a tracking error of 1 mm."""
    height, width = pair.images[0].shape[:2]
    step = 1 if height * width <= 640 * 360 else 2
    at: Any = {"eyes_m": pair.eyes_m, "fov_deg": pair.fov_deg, "sigmas_mm": (SIGMA_MM,)}
    errors = expected_errors(layers, pair.images, pair.stack, sampling=LIGHT._replace(step=step), **at)
    return float(errors[SIGMA_MM][0])


class Bench:
    """Measures imperfections on solved pairs: the ideal panels' light plus the error that each adds. Both
    terms of the added error use the same rays, so that a few thousand pixels suffice.
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        self.subjects = subjects
        self.ideal_db = psnr_db(float(np.mean([subject.ideal_error for subject in subjects])))
        self._same_rays: dict[tuple[int, RealSampling], float] = {}  # error of ideal panels, by subject

    def light(self, make: PanelMaker, pixels: int) -> float:
        """Return the light in dB on panels that `make` describes for a stack."""
        errors = []
        for number, subject in enumerate(self.subjects):
            panels, sampling = make(subject.pair.stack), subject.sampling(pixels)
            if panels.optics.filters is not None:  # few rays pass, so trace more of them
                sampling = sampling._replace(rays=math.ceil(math.sqrt(PASSED / panels.optics.passed)))
            key = (number, sampling)
            if key not in self._same_rays:
                self._same_rays[key] = self._error(subject, RealPanels(), sampling)
            errors.append(subject.ideal_error + self._error(subject, panels, sampling) - self._same_rays[key])
        return psnr_db(float(np.mean(errors)))

    def first(self, imperfections: Sequence[Imperfection]) -> Iterator[Cost]:
        """Measure each imperfection at its assumed size and at its size after the remedy, with few pixels."""
        yield from self._each(imperfections, lambda one: self._cost(one, (), PIXELS_FIRST))

    def curves(self, imperfections: Sequence[Imperfection]) -> Iterator[Cost]:
        """Measure each imperfection at all sizes."""
        yield from self._each(imperfections, lambda one: self._cost(one, one.sizes, PIXELS))

    def _error(self, subject: Subject, panels: RealPanels, sampling: RealSampling) -> float:
        return real_light(subject.layers, subject.pair.stack, panels, subject.sight, sampling).error

    def lights(self, makes: Sequence[PanelMaker], pixels: int) -> Iterator[float]:
        """Yield the light of several panels, measured at the same time."""
        yield from self._each(makes, lambda make: self.light(make, pixels))

    def _each(self, items: Sequence[T], measure: Callable[[T], R]) -> Iterator[R]:
        with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
            yield from pool.map(measure, items)

    def _cost(self, one: Imperfection, sizes: Sequence[float], pixels: int) -> Cost:
        lights = {one.sizes[0]: self.ideal_db}
        for size in (*sizes, one.assumed):
            if size not in lights:
                lights[size] = self.light(partial(one.make, size), pixels)
        same = one.make_left is None and one.left in lights
        left_db = lights[one.left] if same else self.light(one.after, pixels)
        return Cost(one, [lights[size] for size in sizes], lights[one.assumed], left_db)


def together(imperfections: Sequence[Imperfection], stack: PanelStack, *, left: bool) -> RealPanels:
    """Return panels with all imperfections at their assumed sizes, or with what remedies leave of them.

    Those that are avoided are left out.
    """
    real = RealPanels()
    for one in imperfections:
        if one.is_avoided:
            continue
        real = merged(real, one.after(stack) if left else one.make(one.assumed, stack), stack.count)
    return real


def merged(first: RealPanels, second: RealPanels, count: int) -> RealPanels:
    """Return panels with the imperfections of both. Where both change a field, the second counts."""
    cells = tuple(_changed(first.cell(n), second.cell(n), Cell()) for n in range(count))
    placement = tuple(_changed(first.placed(n), second.placed(n), Placement()) for n in range(count))
    return RealPanels(
        cells,
        placement,
        _changed(first.optics, second.optics, Optics()),
        _changed(first.lighting, second.lighting, Lighting()),
        _changed(first.timing, second.timing, Timing()),
        second.analyser_deg if second.analyser_deg != 90.0 else first.analyser_deg,
    )


def _changed(first: Any, second: Any, ideal: Any) -> Any:
    fields = {name: getattr(second, name) for name in type(ideal).__slots__}
    return replace(first, **{name: value for name, value in fields.items() if value != getattr(ideal, name)})


def _front(**fields: float) -> Callable[[int], tuple[Placement, ...]]:
    return lambda count: (*(Placement() for _ in range(count - 1)), Placement(**fields))


def _front_off(name: str, scale: float = 1.0, base: float = 0.0) -> Make:
    def make(size: float, stack: PanelStack) -> RealPanels:
        return RealPanels(placement=_front(**{name: base + scale * size})(stack.count))

    return make


def _shift(size: float, stack: PanelStack) -> RealPanels:
    return RealPanels(placement=_front(right_mm=size * stack.width_m / stack.width_px * 1e3)(stack.count))


def _apparent_gaps(mm: float, stack: PanelStack) -> RealPanels:
    """Panels whose layers appear, through the glass and from the front, where the solver assumes them."""
    nearer = mm * (1 - 1 / Optics().index)  # how much nearer things behind a layer of glass appear
    depths = [-nearer * (1 + 2 * (stack.count - 1 - n)) for n in range(stack.count)]
    return RealPanels(placement=tuple(Placement(depth_mm=depth) for depth in depths), optics=Optics(glass_mm=mm))


def _cells(**fields: Any) -> RealPanels:
    return RealPanels(cells=(Cell(**fields),))


def cell_at(white_deg: float, black_deg: float, curve: Curve) -> Cell:
    """Return a rotator with a range of angles, and a grey curve calibrated in a way."""
    return Cell(white_deg=white_deg, black_deg=black_deg, curve=curve)


def _contrast(percent: float) -> float:
    return 100.0 / percent if percent else math.inf


def filters_of(stack: PanelStack) -> tuple[bool, ...]:
    """Return which panels have colour filters."""
    return stack.colour or (True,) * stack.count


def monitor_share(stack: PanelStack) -> float:
    """Return full white's luminance, as a share of the rear monitor's alone."""
    return float(APERTURE ** (stack.count - 1) * FILTERED ** sum(filters_of(stack)[1:]))


def _pixels(choice: float, stack: PanelStack) -> RealPanels:
    filters = {0: None, 1: None, 2: (False,) * stack.count, 3: filters_of(stack)}[int(choice)]
    return RealPanels(optics=Optics(filters=filters, aperture=APERTURE if choice else 1.0, diffracts=bool(choice)))


def _room(lux: float, stack: PanelStack) -> RealPanels:
    return RealPanels(lighting=Lighting(room_lux=lux, white_cd_m2=MONITOR_CD_M2 * monitor_share(stack)))


def cell_choice(choice: float, count: int) -> RealPanels:
    """Return panels of rotators (0), retarders between quarter-wave films (1), twisted nematic cells (2),
    half-wave plates (3), or those with every other panel inverted and the analyser turned to match (4).
    """
    if choice == 4:
        plates = tuple(Cell("half-wave", inverted=n % 2 == 1) for n in range(count))
        return RealPanels(cells=plates, analyser_deg=90.0 * (1 - count // 2 % 2))
    kinds = ("rotator", "variable-retarder", "twisted-nematic", "half-wave")
    return RealPanels(cells=(Cell(kinds[int(choice)]),))  # type: ignore[arg-type]


def late_front(ms: float, stack: PanelStack, *, allowed: bool = False, head_m_s: float = HEAD_M_S) -> RealPanels:
    """Return panels whose front one is late. If `allowed`, the alignment allows for it."""
    late = (0.0,) * (stack.count - 1) + (ms,)
    return RealPanels(timing=Timing(head_m_s=head_m_s, late_ms=late, allowed_ms=late if allowed else ()))


def slow_panels(ms: float, stack: PanelStack, *, allowed: bool = False, head_m_s: float = HEAD_M_S) -> RealPanels:
    """Return panels of a time constant. If `allowed`, the alignment allows for their mean delay."""
    late = (ms,) * stack.count if allowed else ()
    return RealPanels(timing=Timing(head_m_s=head_m_s, response_ms=ms, allowed_ms=late))


def _upside_down(percent: float, stack: PanelStack) -> RealPanels:
    return RealPanels(timing=Timing(scan=percent / 100, bottom_up=(False,) * (stack.count - 1) + (True,)))


APERTURE = 0.6  # open share of a subpixel's area
FILTERED = 0.85 / 3  # share of the light that a colour filter transmits
MONITOR_CD_M2 = 300.0  # luminance of full white on the rear monitor alone
REGISTRATION = "registration (calibrate panels)"
# The assumed sizes describe three 27-inch monitors that are mounted by hand (docs/planning.md says where from).
IMPERFECTIONS = (
    Imperfection("shift of the front panel", "px", (0, 0.125, 0.25, 0.5, 1, 2), 1.6, 0.1, REGISTRATION, _shift),
    Imperfection(
        "rotation of the front panel", "mrad", (0, 0.25, 0.5, 1, 2, 4), 1.0, 0.05, REGISTRATION,
        _front_off("rotation_mrad"),
    ),
    Imperfection(
        "size of the front panel", "%", (0, 0.02, 0.05, 0.1, 0.2, 0.5), 0.02, 0.005, REGISTRATION,
        _front_off("scale", 0.01, 1.0),
    ),
    Imperfection(
        "tilt of the front panel", "mrad", (0, 1, 2, 5, 10, 20), 3.0, 0.5, REGISTRATION,
        _front_off("tilt_right_mrad"),
    ),
    Imperfection(
        "distance of the front panel", "mm", (0, 0.25, 0.5, 1, 2, 4), 1.0, 0.2, "measured x_m", _front_off("depth_mm")
    ),
    Imperfection(
        "glass on each side of a panel", "mm", (0, 0.25, 0.5, 0.7, 1, 2), 0.7, 0.7, "x_m of the apparent gaps",
        lambda mm, _: RealPanels(optics=Optics(glass_mm=mm)), make_left=_apparent_gaps,
    ),
    Imperfection(
        "full white short of 90 degrees", "deg", (0, 2, 5, 10, 15, 20), 5.0, 5.0, "calibrate grey --white-deg",
        lambda deg, _: _cells(white_deg=90.0 - deg),
        make_left=lambda deg, _: _cells(white_deg=90.0 - deg, curve="angle"),
    ),
    Imperfection(
        "dark state that turns", "deg", (0, 1, 2, 4, 8, 12), 2.0, 2.0, "calibrate grey --black-deg",
        lambda deg, _: _cells(black_deg=deg), make_left=lambda deg, _: _cells(black_deg=deg, curve="angle"),
    ),
    Imperfection(
        "grey curve off by a gamma", "%", (0, 2, 5, 10, 20, 30), 10.0, 1.0, "calibrate grey",
        lambda percent, _: _cells(gamma_ratio=1 + percent / 100),
    ),
    Imperfection(
        "grey levels missing", "bits", (0, 1, 2, 3, 4), 0.0, 0.0, "", lambda bits, _: _cells(bits=8 - int(bits)),
        "2 bits missing: a 6-bit panel without temporal dithering",
    ),
    Imperfection(
        "black of a cell, of its white", "%", (0, 0.05, 0.1, 0.2, 0.5, 1, 3), 0.1, 0.1, "",
        lambda percent, _: _cells(contrast=_contrast(percent)), "0.1 %: a contrast of 1000:1",
    ),
    Imperfection(
        "leak of the polarizers", "%", (0, 0.02, 0.05, 0.1, 0.5, 2), 0.02, 0.02, "",
        lambda percent, _: RealPanels(lighting=Lighting(polarizer_contrast=_contrast(percent))),
    ),
    Imperfection(
        "residual retardance", "nm", (0, 2, 5, 10, 20, 40), 5.0, 5.0, "",
        lambda nm, _: _cells(retardance_nm=nm),
    ),
    Imperfection(
        "kind of cell", "", (0, 1, 2, 3, 4), 2.0, 1.0, "order rotators or retarders",
        lambda choice, stack: cell_choice(choice, stack.count),
        "retarders of one domain; twisted nematic at the first minimum; half-wave plates that turn (IPS)",
        choices=("rotators", "retarders", "twisted nematic", "half-wave plates", "these, alternately inverted"),
        is_avoided=True,
    ),
    Imperfection(
        "pixels", "", (0, 1, 2, 3), 3.0, 3.0, "", _pixels,
        f"open area {APERTURE:.0%}; other filters need other panels and another stack.colour",
        choices=("none", "diffraction", "and black lines", "and the stack's filters"),
    ),
    Imperfection(
        "haze of each panel", "%", (0, 1, 2, 5, 10, 25), 1.0, 1.0, "",
        lambda percent, _: RealPanels(optics=Optics(haze=percent / 100)), "25 %: with the monitor's matt film left on",
    ),
    Imperfection(
        "reflectance of each surface", "%", (0, 1, 4.3, 8, 12), 4.3, 4.3, "",
        lambda percent, _: RealPanels(optics=Optics(reflectance=percent / 100)), "4.3 %: uncoated glass",
    ),
    Imperfection(
        "light of the room", "lx", (0, 5, 10, 20, 50, 100), 10.0, 10.0, "", _room,
        f"the rear monitor alone has {MONITOR_CD_M2:g} cd/m²",
    ),
    Imperfection(
        "backlight darker in the corners", "%", (0, 5, 10, 20, 30, 50), 20.0, 20.0, "",
        lambda percent, _: RealPanels(lighting=Lighting(falloff=percent / 100)),
    ),
    Imperfection(
        "response (time constant)", "ms", (0, 1, 2, 5, 10, 20), 2.5, 2.5, "loop.scanout_ms includes it",
        slow_panels, "head moving at 0.1 m/s, 60 Hz", partial(slow_panels, allowed=True),
    ),
    Imperfection(
        "front panel updated late", "ms", (0, 2, 4, 8, 12, 16), 8.0, 8.0, "delay_ms of the panel",
        late_front, "head moving at 0.1 m/s, 60 Hz", partial(late_front, allowed=True),
    ),
    Imperfection(
        "front panel upside down", "% of a refresh", (0, 25, 50, 75, 100), 0.0, 0.0, "",
        _upside_down, "time from its first row's update, below, to its last one's; head moving at 0.1 m/s, 60 Hz",
    ),
)  # fmt: skip
