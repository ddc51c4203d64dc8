"""Rays through real panels, traced from the eye to the backlight: where they cross panels, and their
light.

The directions in which panels scatter light are drawn at random.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from runtime.optics.real.cells import DESIGN_NM, STEPS, Cell, rotator
from runtime.optics.real.panels import Placement, RealPanels, Timing
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8

Ints = NDArray[np.int64]
FRAMES = 6  # latest frames that still influence a panel's state, at most
LEAST_WEIGHT = 1e-4  # older frames that have less weight together are left out
MOMENTS = 4  # moments of a refresh over which light is averaged
ORDERS = 6.0  # diffraction is drawn up to this many times the angle of a slit's first dark line


@dataclass(frozen=True, slots=True)
class Crossings:
    """Points where rays cross each panel, in pixels. Arrays have shape (N, P), rear panel first."""

    u: F64
    v: F64
    slope: F64  # (N, 2, P) tangents to the right and up of the rays in front of each panel, in air


def crossings(
    start_m: F64, through_m: F64, stack: PanelStack, real: RealPanels, random: np.random.Generator
) -> Crossings:
    """Trace rays from points of the pupil (P, 3), through points of the assumed middle panel (P, 3), to
    every panel. Positions are in frame `stack`. `random` is unused if no panel scatters.
    """
    x, y, z = (np.array(part) for part in start_m.T)
    right = (through_m[:, 1] - y) / (through_m[:, 0] - x)  # dy/dx
    up = (through_m[:, 2] - z) / (through_m[:, 0] - x)
    count, rays = stack.count, len(x)
    u, v, slope = np.empty((count, rays)), np.empty((count, rays)), np.empty((count, 2, rays))
    optics = real.optics
    for n in reversed(range(count)):
        mounted = real.placed(n)
        plane = stack.x_m[n] + mounted.depth_mm / 1e3
        sides = 1 if n == count - 1 else 2
        if optics.reflectance and n < count - 1:
            gap = stack.x_m[n + 1] - stack.x_m[n]
            twice = random.random(rays) < optics.reflectance**2
            y, z = y - right * 2 * gap * twice, z - up * 2 * gap * twice
        along, across = _in_glass(right, up, x - plane, sides * optics.glass_mm / 1e3, optics.index)
        x, y, z = _cross(x, y, z, along, across, plane, mounted)
        u[n], v[n] = _pixels(y, z, stack, mounted)
        slope[n] = right, up
        right, up = _scattered(right, up, stack, real, random)
    return Crossings(u, v, slope)


def _in_glass(right: F64, up: F64, distance_m: F64, glass_m: float, index: float) -> tuple[F64, F64]:
    """Return the mean slopes of rays over a distance of which a part is glass (Snell's law)."""
    if glass_m == 0.0:
        return right, up
    share = np.minimum(glass_m / np.maximum(distance_m, 1e-9), 1.0)
    steep = right * right + up * up
    bent = 1.0 / np.sqrt(index**2 * (1.0 + steep) - steep)
    factor = 1.0 - share + share * bent
    return right * factor, up * factor


def _cross(x: F64, y: F64, z: F64, right: F64, up: F64, plane_m: float, mounted: Placement) -> tuple[F64, F64, F64]:
    """Return where rays meet a panel's plane."""
    to_right, to_up = mounted.tilt_right_mrad / 1e3, mounted.tilt_up_mrad / 1e3
    if to_right == 0.0 and to_up == 0.0:
        return np.full_like(x, plane_m), y + right * (plane_m - x), z + up * (plane_m - x)
    level = plane_m + to_right * (y - right * x) + to_up * (z - up * x)
    crossed = level / (1.0 - to_right * right - to_up * up)
    return crossed, y + right * (crossed - x), z + up * (crossed - x)


def _pixels(y: F64, z: F64, stack: PanelStack, mounted: Placement) -> tuple[F64, F64]:
    """Return the pixel positions of points of a panel."""
    if mounted != Placement():
        y, z = y - mounted.right_mm / 1e3, z - mounted.up_mm / 1e3
        c, s = math.cos(mounted.rotation_mrad / 1e3), math.sin(mounted.rotation_mrad / 1e3)
        y, z = (c * y + s * z) / mounted.scale, (c * z - s * y) / mounted.scale
    return (y / stack.width_m + 0.5) * stack.width_px, (0.5 - z / stack.height_m) * stack.height_px


def _scattered(
    right: F64, up: F64, stack: PanelStack, real: RealPanels, random: np.random.Generator
) -> tuple[F64, F64]:
    """Return the slopes behind a panel that scatters and diffracts."""
    optics = real.optics
    if optics.haze:
        share, angles = random.random(len(right)), random.standard_normal((2, len(right)))
        spread = np.where(share < optics.haze, math.radians(optics.haze_deg), 0.0)
        right, up = right + angles[0] * spread, up + angles[1] * spread
    if optics.diffracts:
        open_m = subpixel_m(stack, optics.aperture)
        orders = [diffraction_orders(random.random(len(right))) for _ in range(2)]
        right = right + orders[0] * (DESIGN_NM * 1e-9 / open_m[0])
        up = up + orders[1] * (DESIGN_NM * 1e-9 / open_m[1])
    return right, up


def subpixel_m(stack: PanelStack, aperture: float) -> tuple[float, float]:
    """Return the open width and height of a subpixel, which is a third of a pixel wide."""
    side = math.sqrt(aperture)
    return stack.width_m / stack.width_px / 3 * side, stack.height_m / stack.height_px * side


@lru_cache(maxsize=1)
def _diffraction_table() -> tuple[F64, F64]:
    orders = np.linspace(-ORDERS, ORDERS, 8193)
    share = np.cumsum(np.sinc(orders) ** 2)
    return share / share[-1], orders


def diffraction_orders(random: F64) -> F64:
    """Return angles in wavelength/width, distributed as behind a slit (sinc²), from uniform numbers."""
    return np.asarray(np.interp(random, *_diffraction_table()))


class Tables:
    """Cells and layers, prepared to compute the light of many rays."""

    def __init__(self, layers: U8, stack: PanelStack, real: RealPanels) -> None:
        """Prepare layers (N, H, W, 3 or 4), rear to front, for panels that `real` describes."""
        self.stack, self.real = stack, real
        self._flat = [np.ascontiguousarray(layer[..., :3].reshape(-1, 3)) for layer in layers]
        cells = [real.cell(n) for n in range(stack.count)]
        self._angles: list[F32] | None = None
        if all(cell.is_rotator for cell in cells):
            self._angles = [cell.angles_rad().astype(np.float32) for cell in cells]
            self._analyser = math.radians(real.analyser_deg - 90.0)
        else:
            axis = rotator(math.radians(90.0 - real.analyser_deg))  # turns the analyser's axis to y
            self._jones = [cell.jones().astype(np.complex64) for cell in cells]
            self._jones[-1] = np.asarray(axis @ self._jones[-1], np.complex64)
        self._blocked = np.float32(black_level(cells, real.lighting.polarizer_contrast))
        self._moments = moments(stack, real.timing)
        self._full = np.ones(3, np.float32)
        if self._angles is None:
            self._full = self._full_white()

    def light(self, crossed: Crossings, eye_x_m: float) -> tuple[F32, F32]:
        """Return each ray's light (P, 3), and its light through white panels, (P, 3) or (1, 1). `eye_x_m`,
        the eye's distance from the origin, determines how the alignment moves the layers.
        """
        white = self._white(crossed)
        if len(white) == 1:
            return np.asarray(white * self._share(crossed, eye_x_m), np.float32), np.asarray(white, np.float32)
        passes = white.any(axis=1)  # most rays meet a black line or a filter of another colour
        light = np.zeros((len(white), 3), np.float32)
        through = Crossings(crossed.u[:, passes], crossed.v[:, passes], crossed.slope[..., passes])
        light[passes] = white[passes] * self._share(through, eye_x_m)
        return light, np.asarray(white, np.float32)

    def _share(self, crossed: Crossings, eye_x_m: float) -> F32:
        """Return the share of light (P, 3) that the polarization lets through, relative to full white."""
        share = sum(
            (self._polarized(self._values(crossed, lags, eye_x_m)) for lags in self._moments),
            start=np.zeros((crossed.u.shape[1], 3), np.float32),
        ) / np.float32(len(self._moments))
        return np.asarray(self._blocked + (1 - self._blocked) * share / self._full, np.float32)

    def _full_white(self) -> F32:
        """Return the light (3,) of full white in each band: the middle panel at 0, the others equal, as solved in
        uniform areas. Eyes adapt to a tint, so light is relative to this white, unless it is less than half as bright
        as it should be.
        """
        count = self.stack.count
        entry = round(255 * STEPS / (count - 1))
        values = [np.full((1, 3), 0 if n == count // 2 else entry, np.int64) for n in range(count)]
        full = self._polarized(values)[0]
        return np.asarray(np.where(full > 0.5, full, 1.0), np.float32)

    def _values(self, crossed: Crossings, lags: Lags, eye_x_m: float) -> list[Ints]:
        """Return each panel's table entries (P, 3) at a moment of the refresh."""
        return [self._panel_values(n, crossed, lags, eye_x_m) for n in range(self.stack.count)]

    def _panel_values(self, n: int, crossed: Crossings, lags: Lags, eye_x_m: float) -> Ints:
        width, height = self.stack.width_px, self.stack.height_px
        u, v = crossed.u[n].astype(np.float32), crossed.v[n].astype(np.float32)
        row = _limited(v, height) * width
        if lags.is_none:
            return np.asarray(STEPS * self._flat[n][row + _limited(u, width)].astype(np.int64))
        step_px = frame_step_px(self.stack, self.real.timing, n, eye_x_m)
        weights, first = lags.of(n, crossed.v[n] / height)
        behind = lags.behind(n, first)
        total = np.zeros((len(u), 3), np.float32)
        for frame in range(weights.shape[0]):
            column = _limited(u + ((behind + frame) * step_px).astype(np.float32), width)
            total += weights[frame].astype(np.float32)[:, None] * self._flat[n][row + column]
        return np.rint(STEPS * total).astype(np.int64)

    def _polarized(self, values: Sequence[Ints]) -> F32:
        """Return the share of light (P, 3) that the polarization lets through ideal polarizers."""
        if self._angles is not None:
            total = np.zeros(values[0].shape, np.float32)
            for angles, entries in zip(self._angles, values, strict=True):
                total += angles[entries]
            return np.asarray(np.sin(total - np.float32(self._analyser)) ** 2)
        bands = []
        for band in range(3):
            first = self._jones[0][values[0][:, band], band]
            ex, ey = first[:, 0, 0], first[:, 1, 0]
            for jones, entries in zip(self._jones[1:], values[1:], strict=True):
                m = jones[entries[:, band], band]
                ex, ey = m[:, 0, 0] * ex + m[:, 0, 1] * ey, m[:, 1, 0] * ex + m[:, 1, 1] * ey
            bands.append(np.abs(ey) ** 2)
        return np.stack(bands, -1).astype(np.float32)

    def _white(self, crossed: Crossings) -> F32:
        """Return the light of rays through white panels: backlight, filters and apertures."""
        optics, falloff = self.real.optics, self.real.lighting.falloff
        white = np.ones((1, 1), np.float32)
        if falloff:
            place = crossed.u[0] / self.stack.width_px - 0.5, crossed.v[0] / self.stack.height_px - 0.5
            white = (1.0 - falloff * 2.0 * (place[0] ** 2 + place[1] ** 2)).astype(np.float32)[:, None]
        if optics.filters is None:
            return white
        side = math.sqrt(optics.aperture)
        for n, has_filters in enumerate(optics.filters):
            third = crossed.u[n] * 3
            stripe = np.floor(third)
            is_open = np.abs(third - stripe - 0.5) < side / 2
            is_open &= np.abs(crossed.v[n] - np.floor(crossed.v[n]) - 0.5) < side / 2
            passed = is_open[:, None]
            if has_filters:
                passed = passed & (np.mod(stripe, 3)[:, None] == np.arange(3))
            white = white * passed
        return white


def _limited(place: F32, count: int) -> Ints:
    """Return the pixels that positions lie in, limited to `count` pixels."""
    return np.minimum(np.maximum(place.astype(np.int64), 0), count - 1)


def black_level(cells: Sequence[Cell], polarizer_contrast: float) -> float:
    """Return the light of crossed polarization, divided by that of parallel polarization. Half of what
    cells depolarize passes. Polarizers pass 1/`polarizer_contrast` when crossed.
    """
    polarized = math.prod(1.0 - cell.depolarized for cell in cells)
    leak = 0.0 if math.isinf(polarizer_contrast) else 1.0 / polarizer_contrast
    black, white = ((1.0 - polarized) / 2, (1.0 + polarized) / 2)
    return (black + leak * white) / (white + leak * black)


@dataclass(frozen=True, slots=True)
class Lags:
    """Contributions of each of the latest frames at a moment of the refresh. Times are in refreshes."""

    moment: float  # time since the first panel updated the row
    timing: Timing
    late: tuple[float, ...]  # each panel's delay

    @property
    def is_none(self) -> bool:
        """True if the panels show the latest frame."""
        return self.timing.is_still

    def starts(self, row_share: F64) -> F64:
        """Return when each panel updates rows (P,) at 0 (top) to 1, (N, P), relative to the middle row.
        The result is (N, 1) if all rows are updated at once, and so are the other methods' results.
        """
        bottom_up = self.timing.bottom_up or (False,) * len(self.late)
        down = self.timing.scan * (row_share - 0.5) if self.timing.scan else np.zeros(1)
        return np.stack([late + (-down if up else down) for late, up in zip(self.late, bottom_up, strict=True)])

    def of(self, index: int, row_share: F64) -> tuple[F64, F64]:
        """Return a panel's weights of frames (frames, P), newest first, and the newest one's age (P,), by
        row.
        """
        starts = self.starts(row_share)
        start = starts[index] - starts.min(axis=0)
        newest = np.ceil(start - self.moment).clip(0.0)
        age = self.moment - start + newest
        response = self.timing.response_ms * self.timing.rate_hz / 1e3
        if response == 0.0:
            return np.ones((1, len(age))), newest
        fading, whole = np.exp(-age / response), math.exp(-1.0 / response)
        older = min(FRAMES - 2, math.ceil(-response * math.log(LEAST_WEIGHT)))
        weights = [1 - fading] + [fading * (1 - whole) * whole**k for k in range(older)]
        return np.stack([*weights, fading * whole**older]), newest

    def behind(self, index: int, newest: F64) -> F64:
        """Return how far the head is past the place that a panel's newest frames (P,) are aligned to, in
        refreshes. A frame is aligned to the middle of the refresh that the first panel shows it, plus
        `allowed_ms`.
        """
        allowed_ms = self.timing.allowed_ms[index] if self.timing.allowed_ms else 0.0
        return newest + self.moment - 0.5 - allowed_ms * self.timing.rate_hz / 1e3


def moments(stack: PanelStack, timing: Timing) -> list[Lags]:
    """Return the panels' states at moments of a refresh, or one state if time has no effect."""
    late = tuple(ms * timing.rate_hz / 1e3 for ms in timing.late_ms) or (0.0,) * stack.count
    places = [0.0] if timing.is_still else (np.arange(MOMENTS) + 0.5) / MOMENTS
    return [Lags(float(place), timing, late) for place in places]


def frame_step_px(stack: PanelStack, timing: Timing, index: int, eye_x_m: float) -> float:
    """Return by how many pixels to the right the alignment moves a panel's picture per refresh."""
    count = stack.count
    reference = (stack.x_m[(count - 1) // 2] + stack.x_m[count // 2]) / 2
    shift_m = (stack.x_m[index] - reference) / (eye_x_m - reference) * timing.step_m
    return float(shift_m / stack.width_m * stack.width_px)
