"""What eyes see of displayed layers, in two ways, as one mean squared error (docs/contracts.md, Error).

*Light*, the figure to quote: a panel's pixel is an even box, and an eye makes of a pixel of its picture the mean
intensity of `RAYS` by `RAYS` rays through it, each through the nearest pixel of every panel. *One ray*, as published
evaluations have it: through the pixel's centre, panels sampled bilinearly.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any

import numpy as np

from runtime.optics.malus import intensity_from_phase
from runtime.optics.retina import Rays, checked_eye
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen
from runtime.records import F32, F64, U8

RAYS = 3  # along and down a picture's pixel
TABLE = 16  # entries a code value, of the table that sums along bilinear rays are looked up in


def squared_error(
    layers: U8,
    targets: Sequence[F32],
    stack: PanelStack,
    *,
    solved_for_m: F64,
    eyes_m: F64,
    fov_deg: float,
    rays: int,
    step: int = 1,
) -> float:
    """Mean squared error of what eyes (2, 3) see against what those solved for (2, 3) should: carried, as `carried`.

    layers: (N, H, W, 3 or 4) code values, rear to front; targets: (h, w, 3) intensities for each eye solved for, of
    pictures `fov_deg` wide; rays: along and down a pixel, of light; 0: one ray, bilinear; step: only every
    so-manieth pixel of every so-manieth row. A pixel counts whose rays all cross every panel half a pixel inside.
    Raises ValueError for an eye that is not before every panel, or where no pixel counts.
    """
    of_rows, cores = _kernel(), len(os.sched_getaffinity(0))
    codes = np.ascontiguousarray(layers)
    fine = 1 if rays else TABLE
    table = intensity_from_phase(np.arange(255 * fine * stack.count + 1, dtype=np.float32) / np.float32(255 * fine))
    calls = []
    for nominal, true, target in zip(solved_for_m, eyes_m, targets, strict=True):
        height, width = target.shape[:2]
        view = Rays.of_eye(checked_eye(nominal, stack), width_px=width, height_px=height, fov_deg=fov_deg)
        centre = panel_from_image(view.from_stack, stack.panel(stack.count // 2))
        panels = panels_from_centre(checked_eye(true, stack), stack)
        rows = range(0, height, step * -(-height // (4 * cores * step)))
        calls += [
            (codes, target, centre, panels, stack.tilt is not None, view.toward(), table, rays, step, first, last)
            for first, last in zip(rows, [*rows[1:], height], strict=True)
        ]
    with ThreadPoolExecutor(cores) as pool:
        total, counted = map(sum, zip(*pool.map(lambda call: of_rows(*call), calls), strict=True))
    if counted == 0:
        raise ValueError("no ray of these eyes crosses every panel")
    return float(total / counted)


def panels_from_centre(true_m: F64, stack: PanelStack) -> F64:
    """(N, 3, 3) where the lines from an eye through the centre panel's pixels cross each panel's layer."""
    centre = stack.panel(stack.count // 2)
    own_pixel = np.array(
        [(true_m[1] - centre.left_m) / centre.pitch_u_m, (centre.top_m - true_m[2]) / centre.pitch_v_m]
    )
    matrices = np.zeros((stack.count, 3, 3))
    for index, x_m in enumerate(stack.x_m):
        share = (x_m - true_m[0]) / (centre.x_m - true_m[0])
        matrices[index] = np.diag([share, share, 1.0])
        matrices[index, :2, 2] = own_pixel * (1 - share)
        if stack.tilt is not None:
            moved = layer_pixels_from_seen(stack.panel(index), layer_from_seen(stack, index, true_m))
            matrices[index] = moved @ matrices[index]
    return matrices


@cache
def _kernel() -> Any:
    """The compiled loop: sum of the squared error over some rows of one eye's picture, and of how many numbers."""
    from numba import config, njit  # noqa: PLC0415 - half a second that only this needs

    @njit(nogil=True, error_model="numpy", fastmath={"contract"}, cache=bool(config.CACHE_DIR))  # type: ignore
    def of_rows(codes, target, centre, panels, tilted, toward, table, rays, step, first, last):  # type: ignore
        height, width = codes.shape[1:3]
        along, half, one = max(rays, 1), np.float32(0.5), np.float32(1)
        share = one / np.float32(along * along)
        total, counted = 0.0, 0
        for row in range(first, last, step):
            for column in range(0, target.shape[1], step):
                red, green, blue, counts = np.float32(0), np.float32(0), np.float32(0), True
                for ray in range(along * along):
                    down = ray // along
                    u, v = column + (ray - down * along + 0.5) / along, row + (down + 0.5) / along
                    counts = counts and toward[0] * u + toward[1] * v + toward[2] < 0
                    weight = 1 / (centre[2, 0] * u + centre[2, 1] * v + centre[2, 2])
                    a = (centre[0, 0] * u + centre[0, 1] * v + centre[0, 2]) * weight
                    b = (centre[1, 0] * u + centre[1, 1] * v + centre[1, 2]) * weight
                    r, g, bl = half, half, half  # rounded, where the table is looked into
                    for n in range(panels.shape[0]):
                        x = panels[n, 0, 0] * a + panels[n, 0, 1] * b + panels[n, 0, 2]
                        y = panels[n, 1, 0] * a + panels[n, 1, 1] * b + panels[n, 1, 2]
                        if tilted:
                            weight = 1 / (panels[n, 2, 0] * a + panels[n, 2, 1] * b + panels[n, 2, 2])
                            x, y = x * weight, y * weight
                        counts = counts and 0.5 < x < width - 0.5 and 0.5 < y < height - 0.5
                        if not counts:
                            break
                        if rays:
                            i, j = np.uint32(y), np.uint32(x)
                            r += codes[n, i, j, 0]
                            g += codes[n, i, j, 1]
                            bl += codes[n, i, j, 2]
                            continue
                        i, j = np.uint32(y - 0.5), np.uint32(x - 0.5)
                        down_share, right_share = np.float32(y - 0.5 - i), np.float32(x - 0.5 - j)
                        for k in range(4):
                            weight_y = down_share if k > 1 else one - down_share
                            weight_x = right_share if k & 1 else one - right_share
                            part = weight_y * weight_x * np.float32(TABLE)
                            below, beside = i + np.uint32(k > 1), j + np.uint32(k & 1)
                            r += part * codes[n, below, beside, 0]
                            g += part * codes[n, below, beside, 1]
                            bl += part * codes[n, below, beside, 2]
                    if not counts:
                        break
                    red, green, blue = red + table[int(r)], green + table[int(g)], blue + table[int(bl)]
                if counts:
                    total += (red * share - target[row, column, 0]) ** 2
                    total += (green * share - target[row, column, 1]) ** 2
                    total += (blue * share - target[row, column, 2]) ** 2
                    counted += 3
        return total, counted

    return of_rows
