"""The seed's grid of calibration viewpoints (section 2.3), and the volume in which the error is judged."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from runtime.config import CalibrationSettings
from runtime.optics.views import stack_from_eye
from runtime.records import F64

RADII_CM = (40, 50, 60)
PHI_DEG = (70, 80, 90)  # from the vertical
THETA_DEG = (80, 90, 100)  # around it, 90: straight before the display
IPD_M = 0.060


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Where the midpoint of the eyes should be."""

    radius_cm: int
    phi_deg: int
    theta_deg: int

    @property
    def name(self) -> str:
        return f"R{self.radius_cm}-phi{self.phi_deg}-theta{self.theta_deg}"

    @property
    def midpoint_m(self) -> F64:
        """(3,) frame `stack`: x = R sin(phi) sin(theta), y = R sin(phi) cos(theta), z = R cos(phi)."""
        return spherical_m(self.radius_cm / 100, phi_deg=self.phi_deg, theta_deg=self.theta_deg)

    def eyes_m(self, ipd_m: float = IPD_M) -> F64:
        """(2, 3) left and right eye, level, square to the line to the stack's centre; frame `stack`."""
        return eyes_at(self.midpoint_m, ipd_m)


def spherical_m(radius_m: float, *, phi_deg: float, theta_deg: float) -> F64:
    """(3,) point in `stack` from the seed's polar angles."""
    phi, theta = np.radians(phi_deg), np.radians(theta_deg)
    return radius_m * np.array([np.sin(phi) * np.sin(theta), np.sin(phi) * np.cos(theta), np.cos(phi)])


def eyes_at(midpoint_m: F64, ipd_m: float = IPD_M) -> F64:
    """(2, 3) left and right eye about a midpoint, level, square to the line to the stack's centre; frame `stack`."""
    right = stack_from_eye(midpoint_m)[:3, 0]
    return midpoint_m + np.outer([-ipd_m / 2, ipd_m / 2], right)


def viewing_place_m(viewing: CalibrationSettings) -> F64:
    """(3,) the middle of where viewers stand, frame `stack`: what a registration is exact for."""
    up_deg = sum(viewing.viewing_up_deg) / 2
    return spherical_m(sum(viewing.viewing_m) / 2, phi_deg=90 - up_deg, theta_deg=90)


def grid() -> tuple[Viewpoint, ...]:
    """The 27 viewpoints, nearest first, row by row."""
    return tuple(Viewpoint(*values) for values in product(RADII_CM, PHI_DEG, THETA_DEG))


def viewing_volume_m() -> F64:
    """(125, 3) points in `stack` that stand for where viewers are: 0.3 to 0.9 m away, 25 degrees to each side."""
    radii, phis, thetas = np.linspace(0.3, 0.9, 5), np.linspace(60, 100, 5), np.linspace(65, 115, 5)
    return np.array([spherical_m(r, phi_deg=p, theta_deg=t) for r, p, t in product(radii, phis, thetas)])
