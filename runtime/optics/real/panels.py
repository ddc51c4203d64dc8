"""Records of a real stack's imperfections. The defaults describe the solver's ideal panels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TypeVar

from runtime.optics.real.cells import Cell

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Placement:
    """Deviation of a panel from where the solver assumes it. Lengths refer to the liquid-crystal layer."""

    right_mm: float = 0.0  # shift to the viewer's right
    up_mm: float = 0.0
    depth_mm: float = 0.0  # towards the viewer
    rotation_mrad: float = 0.0  # rotation in the panel's plane, counter-clockwise as seen by the viewer
    scale: float = 1.0  # true pixel pitch divided by the assumed one
    tilt_right_mrad: float = 0.0  # how far the panel comes towards the viewer, per metre to the right
    tilt_up_mrad: float = 0.0


@dataclass(frozen=True, slots=True)
class Optics:
    """Effects of the panels on a ray, apart from turning its polarization."""

    glass_mm: float = 0.0  # thickness of the glass and films on each side of a panel's liquid-crystal layer
    index: float = 1.52  # refractive index of the glass (soda-lime and display glass at 540 nm)
    haze: float = 0.0  # share of the light that a panel scatters out of its direction
    haze_deg: float = 2.0  # standard deviation of the scattering angle, in air, along each axis
    diffracts: bool = False  # rays are deflected as by slits of a subpixel's open width and height
    filters: tuple[bool, ...] | None = None  # which panels have stripes of colour filters; None: no stripes at all
    aperture: float = 1.0  # open share of a subpixel's area
    reflectance: float = 0.0  # of each of the two surfaces that face each other across a gap

    @property
    def passed(self) -> float:
        """Share of the rays of a colour that meet no black line and no filter of another colour."""
        return math.prod(self.aperture / (3 if has_filters else 1) for has_filters in self.filters or ())


@dataclass(frozen=True, slots=True)
class Lighting:
    """Backlight, room and polarizers."""

    falloff: float = 0.0  # how much darker the backlight is in the corners than in the middle, as a share
    room_lux: float = 0.0  # illuminance on the display
    room_reflectance: float = 0.05  # share of the room's light that the display reflects diffusely
    white_cd_m2: float = 9.0  # luminance of full white through the stack, which the room's light competes with
    polarizer_contrast: float = math.inf  # parallel divided by crossed transmittance of the two polarizers

    @property
    def veil(self) -> float:
        """Luminance of reflected room light, divided by full white's (Lambertian reflection)."""
        return self.room_lux * self.room_reflectance / math.pi / self.white_cd_m2


@dataclass(frozen=True, slots=True)
class Timing:
    """Response of the panels while the alignment moves their pictures with a moving head."""

    rate_hz: float = 60.0  # refresh rate
    head_m_s: float = 0.1  # the head's speed to the right
    response_ms: float = 0.0  # time constant of the first-order response (10 % to 90 % takes 2.2 of them)
    scan: float = 0.0  # share of a refresh that passes from the first row's update to the last row's
    bottom_up: tuple[bool, ...] = ()  # which panels are updated from the bottom row, as one mounted upside down is
    late_ms: tuple[float, ...] = ()  # how much later than the others each panel is updated
    allowed_ms: tuple[float, ...] = ()  # delay of each panel that the alignment allows for (`delay_ms` of a panel)

    @property
    def step_m(self) -> float:
        """Distance that the head moves per refresh."""
        return self.head_m_s / self.rate_hz

    @property
    def is_still(self) -> bool:
        """True if time has no effect."""
        return self.head_m_s == 0.0 or (self.response_ms == 0.0 and self.scan == 0.0 and not any(self.late_ms))


@dataclass(frozen=True, slots=True)
class RealPanels:
    """A stack of real panels. `cells` and `placement` have one entry for all panels, or one each."""

    cells: tuple[Cell, ...] = (Cell(),)
    placement: tuple[Placement, ...] = (Placement(),)
    optics: Optics = field(default_factory=Optics)
    lighting: Lighting = field(default_factory=Lighting)
    timing: Timing = field(default_factory=Timing)
    analyser_deg: float = 90.0  # transmission axis of the front polarizer, from the rear polarizer's

    def cell(self, index: int) -> Cell:
        """Return a panel's cell. Panels are numbered from the rear."""
        return _of(self.cells, index)

    def placed(self, index: int) -> Placement:
        """Return a panel's deviation from its assumed place."""
        return _of(self.placement, index)

    def check(self, count: int) -> None:
        """Raise ValueError, naming the field, if a value is not possible or does not fit `count` panels."""
        lengths = {"cells": len(self.cells), "placement": len(self.placement)}
        for name, length in lengths.items():
            if length not in (1, count):
                raise ValueError(f"panels.{name}: must have 1 or {count} entries, but has {length}")
        timing = self.timing
        optional = {"optics.filters": self.optics.filters, "timing.late_ms": timing.late_ms}
        optional |= {"timing.bottom_up": timing.bottom_up, "timing.allowed_ms": timing.allowed_ms}
        for name, entries in optional.items():
            if entries and len(entries) != count:
                raise ValueError(f"panels.{name}: must have {count} entries, but has {len(entries)}")
        for cell in self.cells:
            try:
                cell.check()
            except ValueError as error:
                raise ValueError(f"panels.cells: {error}") from None
        optics, lighting = self.optics, self.lighting
        shares = {
            "optics.haze": optics.haze, "optics.aperture": optics.aperture, "optics.reflectance": optics.reflectance,
            "lighting.falloff": lighting.falloff, "lighting.room_reflectance": lighting.room_reflectance,
            "timing.scan": timing.scan,
        }  # fmt: skip
        for name, share in shares.items():
            if not 0 <= share <= 1:
                raise ValueError(f"panels.{name}: must be a share from 0 to 1, but is {share:g}")
        positive = {"optics.aperture": optics.aperture, "optics.index": optics.index, "timing.rate_hz": timing.rate_hz}
        for name, value in positive.items():
            if not 0 < value < math.inf:
                raise ValueError(f"panels.{name}: must be above 0, but is {value:g}")
        least = {"optics.glass_mm": optics.glass_mm, "timing.response_ms": timing.response_ms}
        for name, value in least.items():
            if not 0 <= value < math.inf:
                raise ValueError(f"panels.{name}: must be at least 0, but is {value:g}")


def _of(entries: tuple[T, ...], index: int) -> T:
    return entries[index if len(entries) > 1 else 0]
