"""Reference for an eye's view along another eye's rays, carried on the centre panel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from runtime.optics.light import panels_from_centre
from runtime.optics.retina import Rays, Retina, through_layers
from runtime.optics.stack import PanelStack


def seen_along(
    nominal_m: Any, true_m: Any, layers: Any, stack: PanelStack, *, width_px: int, height_px: int, fov_deg: float,
    moved: Callable[[int, Any], Any] = lambda _, places: places,
) -> Retina:  # fmt: skip
    """By an eye at `true_m`, through the centre panel's points that the nominal eye's rays cross.

    moved: what (rays, 2) places on a panel truly are, by its index.
    """
    true, centre = np.asarray(true_m, np.float64), stack.panel(stack.count // 2)
    rays = Rays.of_eye(nominal_m, width_px=width_px, height_px=height_px, fov_deg=fov_deg)

    def positions(rows: slice) -> Any:
        for index, matrix in enumerate(panels_from_centre(true, stack)):
            u, v = rays.on(centre, rows, moved=matrix)
            places = moved(index, np.column_stack([u.ravel(), v.ravel()]))
            yield places[:, 0].reshape(u.shape), places[:, 1].reshape(v.shape)

    return through_layers(layers, positions, rays.toward_panels(), stack)
