"""What eyes see of displayed layers, in two ways, as one mean squared error (docs/contracts.md, Error).

*Light*, the figure to quote: a panel's pixel is a square of one colour, and an eye makes of a pixel of its picture the
mean intensity over that pixel and over its pupil, which is focused on the centre panel. It is estimated by two
independent sets of rays at random places; the mean of the product of both sets' errors is an unbiased estimate of the
squared error, whereas the mean of one set's squares would contain the variance of its own rays. *One ray*, as published
evaluations have it: through the pixel's centre and the pupil's, panels sampled bilinearly.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from runtime.optics.malus import intensity_from_phase
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import Rays, checked_eye, pupil_points
from runtime.optics.rpu import panel_from_image
from runtime.optics.stack import PanelStack
from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen
from runtime.optics.views import stack_from_eye
from runtime.records import F32, F64, U8

RINGS = 9  # of points, of which each ray of light takes one: 271, as good as a disc
TABLE = 16  # entries a code value, of the table that sums along bilinear rays are looked up in


class Sampling(NamedTuple):
    """Along which rays the squared error is measured."""

    rays: int = 2  # of light, along and down a pixel, in each of its two sets; 0: one ray, bilinear
    pupil_mm: float = PUPIL_MM  # diameter, of light; 0: a point
    step: int = 1  # every `step`-th pixel of every `step`-th row


LIGHT = Sampling()
ONE_RAY = Sampling(rays=0, pupil_mm=0.0)


class View(NamedTuple):
    """One eye's picture, and the geometry of its rays."""

    target: F32  # (h, w, 3) intensities
    centre_from_image: F64  # (3, 3) pixels of the centre panel
    panels_from_centre: F64  # (points of the pupil, N, 3, 3) pixels of the panels
    toward: F64  # (3,) times (u, v, 1): negative for a ray that goes towards the panels
    first_ray: int  # its number


def squared_error(
    layers: U8,
    targets: Sequence[F32],
    stack: PanelStack,
    *,
    solved_for_m: F64,
    eyes_m: F64,
    fov_deg: float,
    sampling: Sampling,
) -> float:
    """Mean squared error of what eyes (2, 3) see against what those solved for (2, 3) should: carried, as `carried`.

    layers: (N, H, W, 3 or 4) code values, rear to front; targets: (h, w, 3) intensities for each eye solved for, of
    pictures `fov_deg` wide. A pixel counts whose rays all cross every panel half a pixel inside. Of light that is
    nearly perfect it can be less than 0, by the rays' noise.
    Raises ValueError for an eye that is not before every panel, or where no pixel counts.
    """
    of_rows, cores, step = _kernel(), len(os.sched_getaffinity(0)), sampling.step
    codes = np.ascontiguousarray(layers)
    fine = 1 if sampling.rays else TABLE
    table = intensity_from_phase(np.arange(255 * fine * stack.count + 1, dtype=np.float32) / np.float32(255 * fine))
    calls = []
    for side, (nominal, true, target) in enumerate(zip(solved_for_m, eyes_m, targets, strict=True)):
        view = view_of(side, nominal, true, target, stack, fov_deg=fov_deg, pupil_mm=sampling.pupil_mm)
        rows = range(0, len(target), step * -(-len(target) // (4 * cores * step)))
        calls += [
            (codes, view, table, sampling.rays, step, stack.tilt is not None, first, last)
            for first, last in zip(rows, [*rows[1:], len(target)], strict=True)
        ]
    with ThreadPoolExecutor(cores) as pool:
        total, counted = map(sum, zip(*pool.map(lambda call: of_rows(*call), calls), strict=True))
    if counted == 0:
        raise ValueError("no ray of these eyes crosses every panel")
    return float(total / counted)


def view_of(
    side: int, nominal_m: F64, true_m: F64, target: F32, stack: PanelStack, *, fov_deg: float, pupil_mm: float
) -> View:
    """The rays of one of the eyes. Raises ValueError for one that is not before every panel."""
    height, width = target.shape[:2]
    rays = Rays.of_eye(checked_eye(nominal_m, stack), width_px=width, height_px=height, fov_deg=fov_deg)
    centre = panel_from_image(rays.from_stack, stack.panel(stack.count // 2))
    pupil = pupil_points(pupil_mm / 1e3, rings=RINGS if pupil_mm > 0 else 0)
    ends = [checked_eye(true_m + place, stack) for place in pupil @ stack_from_eye(nominal_m)[:3, :2].T]
    return View(target, centre, panels_from_centre(np.array(ends), stack), rays.toward(), first_ray(side))


def first_ray(side: int) -> int:
    """The number of an eye's first ray: no ray is both eyes'."""
    return side << 40


def panels_from_centre(true_m: F64, stack: PanelStack) -> F64:
    """(..., N, 3, 3) where the lines from eyes (..., 3) through the centre panel's pixels cross each panel's layer."""
    centre = stack.panel(stack.count // 2)
    x, y, z = np.moveaxis(true_m[..., None], -2, 0)
    share = (np.array(stack.x_m) - x) / (centre.x_m - x)
    matrices = np.zeros((*share.shape, 3, 3))
    matrices[..., 0, 0] = matrices[..., 1, 1] = share
    matrices[..., 0, 2] = (y - centre.left_m) / centre.pitch_u_m * (1 - share)
    matrices[..., 1, 2] = (centre.top_m - z) / centre.pitch_v_m * (1 - share)
    matrices[..., 2, 2] = 1
    if stack.tilt is not None:
        for place in np.ndindex(*share.shape):
            moved = layer_from_seen(stack, place[-1], true_m[place[:-1]])
            matrices[place] = layer_pixels_from_seen(stack.panel(place[-1]), moved) @ matrices[place]
    return matrices


def random_bits(ray: Any) -> Any:
    """Of a ray, by its number (splitmix64): 24 for its place along the pixel, 24 down, 16 for the pupil's point."""
    bits = np.uint64(ray) * np.uint64(0x9E3779B97F4A7C15)
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


def ray_of(bits: Any, points: Any) -> Any:
    """Where a ray crosses its part of a pixel, along and down in [0, 1), and at which point of the pupil it ends."""
    part = np.uint64(0xFFFFFF)
    along, down = (bits & part) * 2.0**-24, (bits >> np.uint64(24) & part) * 2.0**-24
    return along, down, np.int64(bits >> np.uint64(48)) * points >> 16


@cache
def _kernel() -> Any:
    """The compiled loop: sum of the squared error over some rows of one eye's picture, and of how many numbers."""
    from numba import config, njit  # noqa: PLC0415 - half a second that only this needs

    bits_of, place_of = njit(random_bits), njit(ray_of)

    @njit(nogil=True, error_model="numpy", fastmath={"contract"}, cache=bool(config.CACHE_DIR))  # type: ignore
    def of_rows(codes, view, table, rays, step, tilted, first, last):  # type: ignore
        height, width = codes.shape[1:3]
        centre, panels, toward = view.centre_from_image, view.panels_from_centre, view.toward
        half, one = np.float32(0.5), np.float32(1)
        a_set, sets = max(rays * rays, 1), 2 if rays else 1
        share, seen = one / np.float32(a_set), np.empty((2, 3), np.float32)
        part_px, columns, points = 1.0 / max(rays, 1), view.target.shape[1], len(panels)
        total, counted = 0.0, 0
        for row in range(first, last, step):
            for column in range(0, columns, step):
                seen[:], counts = 0, True
                number = view.first_ray + (row * columns + column) * a_set * sets
                part_u, part_v, own = 0, 0, 0  # of the pixel, and which of the sets
                for ray in range(a_set * sets):
                    u, v, point = column + 0.5, row + 0.5, 0
                    if rays:
                        along, down, point = place_of(bits_of(number + ray), points)
                        u, v = column + (part_u + along) * part_px, row + (part_v + down) * part_px
                    counts = counts and toward[0] * u + toward[1] * v + toward[2] < 0
                    weight = 1 / (centre[2, 0] * u + centre[2, 1] * v + centre[2, 2])
                    a = (centre[0, 0] * u + centre[0, 1] * v + centre[0, 2]) * weight
                    b = (centre[1, 0] * u + centre[1, 1] * v + centre[1, 2]) * weight
                    red, green, blue = half, half, half  # rounded, where the table is looked into
                    for n in range(panels.shape[1]):
                        x = panels[point, n, 0, 0] * a + panels[point, n, 0, 2]
                        y = panels[point, n, 1, 1] * b + panels[point, n, 1, 2]
                        if tilted:
                            x, y = x + panels[point, n, 0, 1] * b, y + panels[point, n, 1, 0] * a
                            weight = 1 / (
                                panels[point, n, 2, 0] * a + panels[point, n, 2, 1] * b + panels[point, n, 2, 2]
                            )
                            x, y = x * weight, y * weight
                        counts = counts and 0.5 < x < width - 0.5 and 0.5 < y < height - 0.5
                        if not counts:
                            break
                        if rays:
                            i, j = np.uint32(y), np.uint32(x)
                            red += codes[n, i, j, 0]
                            green += codes[n, i, j, 1]
                            blue += codes[n, i, j, 2]
                            continue
                        i, j = np.uint32(y - 0.5), np.uint32(x - 0.5)
                        down_share, right_share = np.float32(y - 0.5 - i), np.float32(x - 0.5 - j)
                        for k in range(4):
                            weight_y = down_share if k > 1 else one - down_share
                            weight_x = right_share if k & 1 else one - right_share
                            part = weight_y * weight_x * np.float32(TABLE)
                            below, beside = i + np.uint32(k > 1), j + np.uint32(k & 1)
                            red += part * codes[n, below, beside, 0]
                            green += part * codes[n, below, beside, 1]
                            blue += part * codes[n, below, beside, 2]
                    if not counts:
                        break
                    seen[own, 0] += table[int(red)]
                    seen[own, 1] += table[int(green)]
                    seen[own, 2] += table[int(blue)]
                    part_u += 1
                    if part_u == rays:
                        part_u, part_v = 0, part_v + 1
                    if part_v == rays and rays:
                        part_v, own = 0, own + 1
                if counts:
                    other = seen[sets - 1]
                    for channel in range(3):
                        target = view.target[row, column, channel]
                        total += (seen[0, channel] * share - target) * (other[channel] * share - target)
                    counted += 3
        return total, counted

    return of_rows
