"""Shift, rotate and scale any source's scene, by applying the opposite transformation to the eye.

The source need not support placement. The view's projection multiplied by the placement is simply another projection,
for an eye whose position is given in the scene's frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import PLACING, ContentSettings
from runtime.content.base import ContentInfo, ContentSource, ForwardingSource, View
from runtime.content.presets import rotation_matrix
from runtime.records import F64

NS_PER_MIN = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Placing:
    """Placement p_stack = offset + scale · R · p_scene; R is `rotation_deg`, then the turntable."""

    scale: float = 1.0
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # frame `stack`
    rotation_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # about the fixed axes x, y and z, in this order
    turntable_per_min: float = 0.0  # revolutions about the vertical axis
    convergence_m: float = 0.0  # how far the right view is moved to the right of the left one
    comfort_deg: float = 0.0  # limit for the depth of stereo pictures; 0 for none

    def rotation(self, time_ns: int) -> F64:
        """Return the 3x3 rotation from the scene's frame to `stack` at a given time."""
        # Whole revolutions are removed first, to keep precision on a clock that has run for months.
        period_ns = NS_PER_MIN / self.turntable_per_min if self.turntable_per_min else np.inf
        turntable = rotation_matrix((0.0, 0.0, 360.0 * (time_ns % period_ns) / period_ns), "xyz")
        return turntable @ rotation_matrix(self.rotation_deg, "xyz")

    def stack_from_scene(self, time_ns: int) -> F64:
        """Return the 4x4 similarity from the scene's frame to `stack` at a given time."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.scale * self.rotation(time_ns)
        matrix[:3, 3] = self.offset_m
        return matrix


def placing_of(settings: ContentSettings) -> Placing:
    """Return the placement specified by the settings."""
    return Placing(**{name: getattr(settings, name) for name in PLACING})


def placed_source(source: ContentSource, placing: Placing) -> ContentSource:
    """Return a source that shows `source` with a placement that replaces any earlier one."""
    if isinstance(source, PlacedSource):
        source = source.source
    return source if placing == Placing() else PlacedSource(source, placing)


class PlacedSource(ForwardingSource):
    """Source that shows another source at a different position, orientation and scale."""

    def __init__(self, source: ContentSource, placing: Placing) -> None:
        """Create the source, which takes ownership of `source` and closes it."""
        self.source, self.placing = source, placing

    @property
    def info(self) -> ContentInfo:  # type: ignore[override]
        """The placed scene's properties. Some differ from the original scene's."""
        return _moved(self.source.info, self.placing)

    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        """Return the source and the time unchanged, and the view transformed to the scene's frame."""
        matrix = self.placing.stack_from_scene(time_ns)
        matrix[1, 3] += (view.side - 0.5) * self.placing.convergence_m
        turn = matrix[:3, :3] / self.placing.scale
        eye = turn.T @ (view.eye_m - matrix[:3, 3]) / self.placing.scale
        lit = turn if view.display_from_view is None else view.display_from_view @ turn
        moved = replace(
            view,
            eye_m=eye,
            pixels_from_stack=view.pixels_from_stack @ matrix,
            display_from_view=lit,
            comfort_deg=self.placing.comfort_deg or view.comfort_deg,
        )
        return self.source, moved, time_ns

    def revision(self, *, time_ns: int) -> int:
        return time_ns if self.placing.turntable_per_min else super().revision(time_ns=time_ns)


def _moved(info: ContentInfo, placing: Placing) -> ContentInfo:
    still = not placing.turntable_per_min
    # A flat scene stays flat only if it remains in the middle panel's plane.
    is_flat = still and placing.rotation_deg[1:] == (0.0, 0.0) and placing.offset_m[0] == placing.convergence_m == 0.0
    return replace(info, moving=info.moving or not still, flat_x_m=info.flat_x_m if is_flat else None)
