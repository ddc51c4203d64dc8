"""Jones matrices of liquid-crystal cells, for each panel value and wavelength band.

A Jones matrix acts on the column vector (E_x, E_y) of light that travels from the backlight to the viewer. The rear
polarizer transmits x. A cell absorbs nothing, so its matrix is unitary. Common phase factors are omitted.

Sources: twisted nematic cells, Gooch and Tarry, J. Phys. D 8 (1975) 1575; with a voltage applied, Lu and Saleh, Opt.
Eng. 29 (1990) 240: the twist stays linear while the tilt of the molecules reduces the birefringence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.records import F64

C128 = NDArray[np.complex128]
BANDS_NM = (610.0, 540.0, 460.0)  # dominant wavelengths of the red, green and blue bands
DESIGN_NM = 540.0  # the cells' design wavelength
FIRST_MINIMUM = math.sqrt(3.0)  # Mauguin parameter of the first Gooch-Tarry minimum
STEPS = 4  # entries of a table per 8-bit code

Curve = Literal["linear", "intensity", "angle"]
Kind = Literal["rotator", "twisted-nematic", "half-wave", "variable-retarder"]


@dataclass(frozen=True, slots=True)
class Cell:
    """Liquid-crystal cell, by default the solver's ideal rotator. For other kinds, `black_deg` and
    `white_deg` limit the angle by which the cell turns light that is polarized as the rear polarizer transmits it.
    """

    kind: Kind = "rotator"
    white_deg: float = 90.0  # rotation at full white
    black_deg: float = 0.0  # rotation at black
    curve: Curve = "linear"  # how panel values become angles (`angles_rad`)
    gamma_ratio: float = 1.0  # true exponent of the grey curve divided by the assumed one
    bits: int = 8  # grey levels: 2**bits
    mauguin: float = FIRST_MINIMUM  # 2·d·Δn/λ of a twisted nematic cell without voltage, at DESIGN_NM
    retardance_nm: float = 0.0  # residual linear retardance, as a path difference
    retardance_axis_deg: float = 45.0  # slow axis of the residual retardance, from x towards y
    contrast: float = math.inf  # full white divided by black, of this cell between crossed ideal polarizers
    inverted: bool = False  # the panel shows 1 - value

    def check(self) -> None:
        """Raise ValueError, naming the field, if a value is not possible."""
        for name, value, known in (("kind", self.kind, get_args(Kind)), ("curve", self.curve, get_args(Curve))):
            if value not in known:
                raise ValueError(f"{name}: {value!r} is unknown; use {', '.join(known)}")
        for name, is_possible, wanted in (
            ("black_deg", -90 <= self.black_deg <= 90, "must be from -90 to 90"),
            ("white_deg", -180 <= self.white_deg <= 180, "must be from -180 to 180"),
            ("gamma_ratio", 0 < self.gamma_ratio < math.inf, "must be above 0"),
            ("bits", 1 <= self.bits <= 8, "must be from 1 to 8"),
            ("mauguin", 0 < self.mauguin < math.inf, "must be above 0"),
            ("contrast", self.contrast >= 1, "must be at least 1"),
        ):
            if not is_possible:
                raise ValueError(f"{name}: {wanted}, but is {getattr(self, name):g}")

    @property
    def depolarized(self) -> float:
        """Share of the light that the cell depolarizes, which limits its contrast."""
        return 0.0 if math.isinf(self.contrast) else 2.0 / (self.contrast + 1.0)

    @property
    def is_rotator(self) -> bool:
        """True if the cell only turns the polarization, by the same angle in all bands."""
        return self.kind == "rotator" and self.retardance_nm == 0.0

    def angles_rad(self) -> F64:
        """Return the rotation for each entry of the table, from panel value 0 to 1.

        A linear curve is that of a panel whose full range is taken for 0 to 90 degrees. Calibrated by intensity, black
        and full white are taken for 0 and 90 degrees, and the intensities between them are right. Calibrated by angle,
        every angle within the panel's range is right, and others are clipped.
        """
        values = np.linspace(0.0, 1.0, 255 * STEPS + 1)
        if self.inverted:
            values = 1.0 - values
        if self.bits < 8:
            levels = 2**self.bits - 1
            values = np.rint(values * levels) / levels
        shown = values**self.gamma_ratio
        black, white = math.radians(self.black_deg), math.radians(self.white_deg)
        if self.curve == "angle":
            return np.asarray((shown * math.pi / 2).clip(black, white))
        if self.curve == "intensity":
            low, high = math.sin(black) ** 2, math.sin(white) ** 2
            return np.asarray(np.arcsin(np.sqrt(low + (high - low) * np.sin(shown * math.pi / 2) ** 2)))
        return np.asarray(black + (white - black) * shown)

    def jones(self) -> C128:
        """Return the Jones matrices, shape (1021, 3, 2, 2): panel values by bands (`BANDS_NM`)."""
        angles = self.angles_rad()
        bands = [self._jones(angles, wavelength_nm) for wavelength_nm in BANDS_NM]
        return np.stack(bands, axis=1)

    def _jones(self, angles_rad: F64, wavelength_nm: float) -> C128:
        if self.kind == "rotator":
            cell = rotator(angles_rad)
        elif self.kind == "variable-retarder":
            cell = retarder_between_quarter_waves(angles_rad, DESIGN_NM / wavelength_nm)
        elif self.kind == "half-wave":
            cell = retarder(math.pi * DESIGN_NM / wavelength_nm, angles_rad / 2)
        else:
            cell = twisted_nematic(math.pi / 2, twisted_retardance(angles_rad, self.mauguin, wavelength_nm))
        if self.retardance_nm == 0.0:
            return cell
        delta = 2 * math.pi * self.retardance_nm / wavelength_nm
        return np.asarray(retarder(delta, math.radians(self.retardance_axis_deg)) @ cell)


def rotator(angle_rad: ArrayLike) -> C128:
    """Return the matrices (..., 2, 2) that turn the polarization by an angle from x towards y."""
    angle = np.asarray(angle_rad, np.float64)
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2), np.complex128)


def retarder(delta_rad: ArrayLike, axis_rad: ArrayLike) -> C128:
    """Return matrices (..., 2, 2) of retarders with slow axis `axis_rad` from x to y and this lag."""
    delta, axis = np.broadcast_arrays(np.asarray(delta_rad, np.float64), np.asarray(axis_rad, np.float64))
    c, s = np.cos(delta / 2), np.sin(delta / 2)
    along, across = np.cos(2 * axis), np.sin(2 * axis)
    rows = [np.stack([c - 1j * s * along, -1j * s * across], -1), np.stack([-1j * s * across, c + 1j * s * along], -1)]
    return np.asarray(np.stack(rows, -2))


def retarder_between_quarter_waves(angle_rad: ArrayLike, dispersion: float = 1.0) -> C128:
    """Return the (..., 2, 2) matrices of retarders at 0° between plates of `dispersion` quarter waves at
    ±45°.

    This is how a cell with vertical or parallel alignment becomes a rotator: a retardance of twice `angle_rad` turns
    any polarization by that angle, without residue where the plates are exact. The cell's own dispersion is left out
    because its grey curve is calibrated in each band.
    """
    first, last = (retarder(math.pi / 2 * dispersion, side * math.pi / 4) for side in (1, -1))
    return np.asarray(last @ retarder(2 * np.asarray(angle_rad, np.float64), 0.0) @ first)


def twisted_nematic(twist_rad: ArrayLike, beta_rad: ArrayLike) -> C128:
    """Return (..., 2, 2) matrices of cells with this twist from x to y and retardance π·d·Δn/λ."""
    twist, beta = np.broadcast_arrays(np.asarray(twist_rad, np.float64), np.asarray(beta_rad, np.float64))
    gamma = np.sqrt(twist**2 + beta**2)
    sine = np.sinc(gamma / math.pi)  # sin(gamma)/gamma, 1 at 0
    diagonal, turned = np.cos(gamma) - 1j * beta * sine, twist * sine
    rows = [np.stack([diagonal, turned + 0j], -1), np.stack([-turned + 0j, diagonal.conj()], -1)]
    return np.asarray(rotator(twist) @ np.stack(rows, -2))


def twisted_retardance(angles_rad: F64, mauguin: float, wavelength_nm: float) -> F64:
    """Return the half-retardances beta of a cell with a twist of 90 degrees, for each panel value.

    The voltages are those at which a cell at the first Gooch-Tarry minimum (at `DESIGN_NM`) has the intensities
    sin²(`angles_rad`) between crossed polarizers, calibrated in this band. It transmits 1 - (twist·sin(gamma)/gamma)²
    there, with gamma² = twist² + beta². Retardance is proportional to thickness; `mauguin` is the parameter without
    voltage, at `DESIGN_NM`.
    """
    betas = np.linspace(0.0, math.pi / 2 * FIRST_MINIMUM * min(DESIGN_NM / wavelength_nm, 1.0), 4096)
    gamma = np.sqrt((math.pi / 2) ** 2 + betas**2)
    intensity = np.maximum.accumulate(1.0 - (math.pi / 2 * np.sinc(gamma / math.pi)) ** 2)
    wanted = np.sin(angles_rad) ** 2 * intensity[-1]
    return np.asarray(np.interp(wanted, intensity, betas) * (mauguin / FIRST_MINIMUM))
