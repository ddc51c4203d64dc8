"""A step that moves all panels by what the eyes see wrong, on panels whose pixels are even boxes.

The mathematics, which a shader writes the same way (all values from 0 to 1, one colour channel at a time):

1. *Rays.* One ray for every pixel p of the centre panel, for each eye and each place e that the eye may be at (sure
   eyes: one; unsure ones: sigma to the right and up, and to the left and down, in turn with the other diagonal). A box
   as wide as a pixel sees on another panel the mean of the two by two pixels that it overlaps, weighted by how much:
   that is a bilinear sample at the ray's middle. S_n(e): panel n's pixels from the centre panel's, as e sees them
   in line: a scale and a shift, or nearly so where panels are tilted.
2. *See.* s = x_0(S_0 p) + x_1(S_1 p) + x_2(S_2 p), I = sin²(pi/2·s), c = sin(pi·s) (the slope of I, but for pi/2).
3. *Compare.* G_e(p) = c·(I - T_e(p)), W_e(p) = c²; both 0 where the ray leaves a panel; G also fades towards the edges
   of a part of larger panels.
4. *Bring back.* For every pixel q of panel n, with S_n(e)^-1 and bilinear samples: N = sum over e of G_e, and
   D = sum over e of W_e, at least `floor` times the number of rays.
5. *Move.* With y_n what the rays saw: new x_n = clip(y_n - w·N / (3·pi/2·D), 0, 1), and new y_n = new x_n +
   b·(new x_n - x_n).

D is the separable majoriser of tomography (SQS; Erdogan and Fessler 1999) for three panels. Rays see the panels ahead
of where they are by b times their last change (Nesterov). Without clipping a mode of eigenvalue l (0 to 1) is damped
while w·l < 2·(1 + b) / (1 + 2·b): 1.5 for b = 0.5; larger first steps are safe only where few follow.

Rows of G and W live in a ring that stays in a core's cache: panels' rows follow as soon as the rays that cross them are
there, and write where the step before last lay.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from runtime.model.compiled.along import DRIFT_PX, new_layout, sample, sample_or, work_row, work_tiles
from runtime.model.compiled.loops import PASS, PIECE, TILE, U
from runtime.records import F32, F64, I16, U8
from runtime.support.threads import at_once

CENTRE = 1
FULL = 4080.0  # a panel's whole range in sixteenths of a code
INTENSITY = 64.0  # of a target's code, in 16 bits
SLOPED = 16384.0  # of a ring's G and W
MARGIN = 2 * PIECE  # numbers behind an image that whole pieces may read
NEAR_PX = 0.5  # a ray counts that crosses every panel so far inside its edge


@njit(**PASS)
def move_rows(
    panels,
    moved,
    last_step,
    sizes,
    targets,
    seen,
    back,
    same_centre,
    needs,
    fade_columns,
    fade_rows,
    step,
    momentum,
    floor,
    channels,
    first_row,
    end_row,
    rows_of,
    ring,
    seen_layout,
    back_layout,
    row,
    tiles,
):  # pragma: no cover
    """One step of the panels' rows that follow the centre panel's rays first_row to end_row.

    panels: (3, rows, numbers) int16, what the eyes see; moved: the same, written; last_step: (3, rows, numbers) int16,
    without momentum, read and written. sizes (3, 2): rows and pixels. targets: (2, rows, numbers) int16. seen, back:
    (rays, 3, 3, 3) panels' pixels from the centre's and the other way, of a weight of about 1. needs: (3, rows, 2)
    first and last of the centre's rows that a panel's row is seen through. rows_of: (3, 2) each panel's rows.
    ring: (rays, 2, rows, numbers) int16; row, tiles: to work in.
    """
    rays, size_of_tile = seen.shape[0], TILE // channels
    height, width = sizes[3, 0], sizes[3, 1]
    ring_rows = ring.shape[2]
    none, one, half, near = np.float32(0), np.float32(1), np.float32(0.5), 0.5
    turns, pi = np.float32(1 / (2 * FULL)), np.float32(np.pi)
    code, sloped = np.float32(1 / (255 * INTENSITY)), np.float32(SLOPED)
    full, least = np.float32(FULL), np.float32(floor * rays * SLOPED)
    size, speed = np.float32(step * FULL / (3 * np.pi / 2)), np.float32(momentum)
    at0, at1, at2 = rows_of[0, 0], rows_of[1, 0], rows_of[2, 0]
    for r in range(first_row, end_row):
        for e in range(rays):
            for tile in range((width + size_of_tile - 1) // size_of_tile):
                begin = tile * size_of_tile
                pixels = min(size_of_tile, width - begin)
                first, last = 0, pixels
                offset, sums = U(begin * channels), tiles[3]
                for n in range(3):
                    if n == CENTRE and same_centre:
                        continue
                    low, high = sample(
                        panels[n], sizes[n, 0], sizes[n, 0], sizes[n, 1], near, seen[e, n], r, tile, pixels, channels,
                        3 * e + n, seen_layout, row, tiles[n],
                    )  # fmt: skip
                    first, last = max(first, low), min(last, high)
                if same_centre:
                    for k in range(pixels * channels):
                        outer = tiles[0, U(k)] + tiles[2, U(k)]
                        sums[U(k)] = outer + np.float32(panels[CENTRE, U(r), U(k) + offset])
                else:
                    for k in range(pixels * channels):
                        sums[U(k)] = tiles[0, U(k)] + tiles[1, U(k)] + tiles[2, U(k)]
                line, side, fade = U(r % ring_rows), U(e % 2), fade_rows[U(r)]
                for k in range(pixels * channels):
                    half_turn = sums[U(k)] * turns
                    x = (half_turn - np.floor(half_turn + half)) * pi
                    y = x * x
                    sine = np.float32(1 / 362880) * y - np.float32(1 / 5040)
                    sine = (((sine * y + np.float32(1 / 120)) * y - np.float32(1 / 6)) * y + one) * x
                    cosine = np.float32(-1 / 3628800) * y + np.float32(1 / 40320)
                    cosine = (((cosine * y - np.float32(1 / 720)) * y + np.float32(1 / 24)) * y - half) * y + one
                    slope = np.float32(2) * sine * cosine
                    error = sine * sine - np.float32(targets[side, U(r), U(k) + offset]) * code
                    slope_by_fade = slope * sloped
                    error *= fade * fade_columns[U(k) + offset]
                    ring[U(e), U(0), line, U(k) + offset] = np.int16(np.int32(np.rint(slope_by_fade * error)))
                    ring[U(e), U(1), line, U(k) + offset] = np.int16(np.int32(slope_by_fade * slope))
                for k in range(first * channels):
                    ring[U(e), U(0), line, U(k) + offset] = 0
                    ring[U(e), U(1), line, U(k) + offset] = 0
                for k in range(last * channels, pixels * channels):
                    ring[U(e), U(0), line, U(k) + offset] = 0
                    ring[U(e), U(1), line, U(k) + offset] = 0
        for n in range(3):
            q = at0 if n == 0 else at1 if n == 1 else at2
            while q < rows_of[n, 1] and needs[n, q, 1] <= r:
                for tile in range((sizes[n, 1] + size_of_tile - 1) // size_of_tile):
                    begin = tile * size_of_tile
                    pixels = min(size_of_tile, sizes[n, 1] - begin)
                    offset, line = U(begin * channels), U(q)
                    total, weight = tiles[3], tiles[4]
                    if n == CENTRE and same_centre:
                        here = U(q % ring_rows)
                        for k in range(pixels * channels):
                            total[U(k)] = np.float32(ring[U(0), U(0), here, U(k) + offset])
                            weight[U(k)] = np.float32(ring[U(0), U(1), here, U(k) + offset])
                        for e in range(1, rays):
                            for k in range(pixels * channels):
                                total[U(k)] += np.float32(ring[U(e), U(0), here, U(k) + offset])
                                weight[U(k)] += np.float32(ring[U(e), U(1), here, U(k) + offset])
                    else:
                        for k in range(pixels * channels):
                            total[U(k)] = none
                            weight[U(k)] = none
                        for e in range(rays):
                            for part in range(2):  # what is wrong, and its weight
                                sample_or(
                                    ring[e, part], ring_rows, height, width, 0.0, back[e, n], q, tile, pixels, channels,
                                    3 * e + n, none, back_layout, row, tiles[5],
                                )  # fmt: skip
                                for k in range(pixels * channels):
                                    tiles[3 + part, U(k)] += tiles[5, U(k)]
                    for k in range(pixels * channels):
                        change = size * total[U(k)] / max(weight[U(k)], least)
                        now = min(max(np.float32(panels[U(n), line, U(k) + offset]) - change, none), full)
                        before = np.float32(last_step[U(n), line, U(k) + offset])
                        ahead = now + speed * (now - before)
                        last_step[U(n), line, U(k) + offset] = np.int16(np.int32(now + half))
                        moved[U(n), line, U(k) + offset] = np.int16(np.int32(np.floor(ahead + half)))
                q += 1
            if n == 0:
                at0 = q
            elif n == 1:
                at1 = q
            else:
                at2 = q


class Rays(NamedTuple):
    """Where one step looks: from each eye, and each place that it may be at."""

    seen: F64  # (rays, 3, 3, 3) panels' pixels from the centre panel's; left and right eyes in turn
    back: F64  # (rays, 3, 3, 3) the centre panel's pixels from theirs
    needs: NDArray[np.int32]  # (3, rows, 2) the centre panel's rows that a panel's row is seen through


def rays_of(seen: F64, sizes: NDArray[np.int64]) -> Rays:
    """seen: (rays, 3, 3, 3), last entries about 1; sizes (3, 2): rows and columns of the panels."""
    back: F64 = np.linalg.inv(seen).astype(np.float64)
    back /= back[..., 2:, 2:]
    needs = np.zeros((3, sizes[:3, 0].max(), 2), np.int32)
    for n, (height, width) in enumerate(sizes[:3]):
        q = np.arange(height) + 0.5
        ends = []
        for matrix in back[:, n]:
            for u in (0.0, float(width)):
                y, w = (row[0] * u + row[1] * q + row[2] for row in matrix[1:])
                ends.append(np.floor(y / w - 0.5))
        most = sizes[3, 0] - 1
        needs[n, :height, 0] = np.clip(np.min(ends, axis=0), 0, most)
        needs[n, :height, 1] = np.maximum.accumulate(np.clip(np.max(ends, axis=0) + 1, 0, most))
    return Rays(np.ascontiguousarray(seen), back, needs)


def fill(numbers: I16, codes: U8, unit: float) -> None:
    """(rows, numbers) of panels or targets by codes (h, w[, 3]) of so many of their units."""
    height, width = codes.shape[0], codes[0].size
    numbers[:height, :width] = cv2.LUT(codes, (np.arange(256) * unit).astype(np.int16)).reshape(height, width)


class JointState:
    """The panels between steps, and what steps work in."""

    def __init__(self, sizes: NDArray[np.int64], *, channels: int, threads: int) -> None:
        self.sizes, self.channels, self.threads = np.asarray(sizes, np.int64), channels, threads
        rows, columns = self.sizes.max(axis=0)
        shape = (3, rows + 1, columns * channels + MARGIN)
        self.panels, self._moved, self.last = (np.zeros(shape, np.int16) for _ in range(3))
        self.targets = np.zeros((2, rows + 1, columns * channels + MARGIN), np.int16)
        self._columns = columns

    def start(self) -> None:
        """Begin at `panels`: without momentum."""
        self.last[...] = self.panels

    def step(
        self,
        rays: Rays,
        *,
        size: float,
        momentum: float,
        floor: float,
        fade: tuple[F32, F32] | None = None,
        drift_px: float = DRIFT_PX,
    ) -> None:
        """fade: what errors are multiplied with, along the rays' columns and rows; drift_px: how far a ray may be taken
        to lie from its place, so that pieces of rows that are laid for one serve the next."""
        height = int(self.sizes[3, 0])
        count, threads = len(rays.seen), self.threads
        ring_rows = int((rays.needs[..., 1] - rays.needs[..., 0]).max()) + 2
        same = bool(np.array_equal(rays.seen[:, CENTRE], np.broadcast_to(np.eye(3), (count, 3, 3))))
        numbers = self._columns * self.channels + MARGIN
        columns, rows = fade if fade is not None else (np.ones(numbers, np.float32), np.ones(height, np.float32))
        scale = float(np.abs(np.concatenate([rays.seen, rays.back])[..., 0, 0]).max())

        def share(index: int) -> None:
            first, end = height * index // threads, height * (index + 1) // threads
            of = np.zeros((3, 2), np.int64)
            begin = first
            for n in range(3):
                last = rays.needs[n, : self.sizes[n, 0], 1]
                of[n] = (
                    np.searchsorted(last, [first, end])
                    if index + 1 < threads
                    else (np.searchsorted(last, first), len(last))
                )
                if of[n, 0] < of[n, 1]:
                    begin = min(begin, int(rays.needs[n, of[n, 0] : of[n, 1], 0].min()))
            layouts = (new_layout(3 * count, self._columns, self.channels, drift_px=drift_px) for _ in range(2))
            move_rows(
                self.panels, self._moved, self.last, self.sizes, self.targets, rays.seen, rays.back, same, rays.needs,
                columns, rows, size, momentum, floor, self.channels, begin, end, of,
                np.zeros((count, 2, ring_rows, numbers), np.int16),
                *layouts, work_row(scale), work_tiles(),
            )  # fmt: skip

        at_once(share, range(threads))
        self.panels, self._moved = self._moved, self.panels
