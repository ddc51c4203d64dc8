"""Calibration viewpoints of section 2.3 of EyeReal, extended to any distance, and the viewing volume."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from runtime.config import CalibrationSettings
from runtime.optics.views import stack_from_eye
from runtime.records import F64

USUAL = CalibrationSettings()  # R 40 to 60 cm, phi 70 to 90 degrees from the vertical, theta 80 to 100 degrees
IPD_M = 0.060  # the paper's distance between the eyes, used if the configuration has no value


@dataclass(frozen=True, slots=True)
class Viewpoint:
    """Position of the midpoint between the eyes that a calibration requires, in spherical coordinates."""

    radius_cm: int  # distance from the stack's origin
    phi_deg: int  # angle from the vertical
    theta_deg: int  # angle about the vertical; 90 degrees is in front of the display

    @property
    def name(self) -> str:
        return f"R{self.radius_cm}-phi{self.phi_deg}-theta{self.theta_deg}"

    @property
    def midpoint_m(self) -> F64:
        """Position (3,) in `stack`: x = R sin(phi) sin(theta), y = R sin(phi) cos(theta), z = R cos(phi)."""
        return spherical_m(self.radius_cm / 100, phi_deg=self.phi_deg, theta_deg=self.theta_deg)

    def eyes_m(self, ipd_m: float = IPD_M) -> F64:
        """Eyes (2, 3) in `stack`, on a horizontal line perpendicular to the line of sight to the centre."""
        right = stack_from_eye(self.midpoint_m)[:3, 0]
        return self.midpoint_m + np.outer([-ipd_m / 2, ipd_m / 2], right)


def spherical_m(radius_m: float, *, phi_deg: float, theta_deg: float) -> F64:
    """Convert a radius and the EyeReal supplement's polar angles to a point (3,) in `stack`."""
    phi, theta = np.radians(phi_deg), np.radians(theta_deg)
    return radius_m * np.array([np.sin(phi) * np.sin(theta), np.sin(phi) * np.cos(theta), np.cos(phi)])


def viewing_place_m(viewing: CalibrationSettings) -> F64:
    """Return the middle (3,) of the viewing range in `stack`. The panels are registered for this point."""
    up_deg = sum(viewing.viewing_up_deg) / 2
    return spherical_m(sum(viewing.viewing_m) / 2, phi_deg=90 - up_deg, theta_deg=90)


def grid(viewing: CalibrationSettings = USUAL) -> tuple[Viewpoint, ...]:
    """Return the 27 viewpoints of a viewing range, nearest first; the default range gives EyeReal's."""
    low_deg, high_deg = viewing.viewing_up_deg
    radii_cm = np.rint(100 * np.linspace(*viewing.viewing_m, 3)).astype(int)
    phi_deg = np.rint(90 - np.linspace(high_deg, low_deg, 3)).astype(int)
    theta_deg = np.rint(90 + viewing.viewing_side_deg * np.array([-1, 0, 1])).astype(int)
    return tuple(Viewpoint(*values) for values in product(radii_cm.tolist(), phi_deg.tolist(), theta_deg.tolist()))


def viewing_volume_m(viewing: CalibrationSettings = USUAL) -> F64:
    """Return points (125, 3) in the `stack` frame that span the viewers' range of movement. It reaches
    from 0.75 times the nearest to 1.5 times the farthest viewpoint's distance, and 15 degrees farther to each side and
    10 up and down: by default from 0.3 to 0.9 m and 25 degrees to each side.
    """
    (near_m, far_m), (low_deg, high_deg) = viewing.viewing_m, viewing.viewing_up_deg
    side_deg = viewing.viewing_side_deg + 15
    radii, thetas = np.linspace(0.75 * near_m, 1.5 * far_m, 5), np.linspace(90 - side_deg, 90 + side_deg, 5)
    phis = np.linspace(80 - high_deg, 100 - low_deg, 5)
    return np.array([spherical_m(r, phi_deg=p, theta_deg=t) for r, p, t in product(radii, phis, thetas)])
