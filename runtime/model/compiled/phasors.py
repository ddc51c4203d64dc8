"""The simultaneous step: all panels move by what bundles of rays see wrong, on panels whose pixels are even boxes.

`model_export.light` is the reference, docs/mathematics.md ("A step") has the equations (L1) to (L5); this is the same
in fixed point. Each ray set (an eye at one of the places that it may be at) is compared row by row: bilinear samples of
the panels' phasors, their product Z, the error e of (1 - Re Z)/2, and what goes back to the panels, (Im Z)² and e times
the other panels' product. Those rows live in a ring: rows of panels follow as soon as the rays that cross them are
compared.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from runtime.model.compiled.along import DRIFT_PX, Layout, new_layout, sample, sample_or, work_row, work_tiles
from runtime.model.compiled.loops import PASS, PIECE, TILE, U
from runtime.records import F64, I16, U8
from runtime.support.threads import at_once, on_rows

FULL = 4080.0  # a panel's whole range in sixteenths of a code
INTENSITY = 64.0  # of a target's code, in 16 bits
UNIT = 32767.0  # of phasors, and of what goes back to the panels
FIELDS = 7  # that go back: the squared slope, and for each panel a real and an imaginary part
MARGIN = 2 * PIECE  # numbers behind an image that whole pieces may read
NEAR_PX = 0.5  # a ray counts that crosses every panel so far inside its edge


class Rays(NamedTuple):
    """Where one step looks: from each eye, and each place that it may be at."""

    seen: F64  # (rays, 3, 3, 3) panels' pixels from those of the rays; left and right eyes in turn
    back: F64  # (rays, 3, 3, 3) the rays' pixels from theirs
    needs: NDArray[np.int32]  # (3, rows, 2) first and last of the rays' rows that a panel's row is seen through


class Images(NamedTuple):
    """What a step works on: rows of numbers, channels beside each other, as 16-bit integers."""

    ahead: I16  # (3, rows, numbers) what the rays see
    moved: I16  # (3, rows, numbers) the same after the step
    last: I16  # (3, rows, numbers) without momentum, read and written
    phasors: I16  # (3, 2, rows, numbers) cosine and sine of what the rays see
    targets: I16  # (2, rows, numbers) left and right eye's
    sizes: NDArray[np.int64]  # (4, 2) rows and pixels of each panel, and of the rays
    channels: int


class Kind(NamedTuple):
    """How far a step goes."""

    size: float
    momentum: float
    floor: float


class Share(NamedTuple):
    """What one thread does of a step, and works in."""

    first: int  # of the rays' rows
    end: int
    rows: NDArray[np.int64]  # (3, 2) each panel's rows
    ring: I16  # (rays, FIELDS, rows, numbers)
    seen_layout: Layout
    back_layout: Layout
    row: Any  # (numbers,) float32
    tiles: Any  # (10, numbers) float32


@njit(**PASS)
def to_phasors(panel, phasors, first, last, width):  # pragma: no cover
    """Rows first to last of a panel (rows, numbers), as cosine and sine of exp(i·pi·x): (2, rows, numbers)."""
    turn, one, half, unit = np.float32(np.pi / FULL), np.float32(1), np.float32(0.5), np.float32(UNIT)
    middle = np.float32(FULL / 2)
    for v in range(first, last):
        for k in range(width):
            t = (np.float32(panel[U(v), U(k)]) - middle) * turn  # series about the middle of the range
            y = t * t
            sine = np.float32(-1 / 39916800) * y + np.float32(1 / 362880)
            sine = (((sine * y - np.float32(1 / 5040)) * y + np.float32(1 / 120)) * y - np.float32(1 / 6)) * y + one
            cosine = np.float32(1 / 479001600) * y - np.float32(1 / 3628800)
            cosine = ((cosine * y + np.float32(1 / 40320)) * y - np.float32(1 / 720)) * y + np.float32(1 / 24)
            cosine = (cosine * y - half) * y + one
            phasors[U(0), U(v), U(k)] = np.int16(np.int32(np.rint(-unit * sine * t)))
            phasors[U(1), U(v), U(k)] = np.int16(np.int32(np.rint(unit * cosine)))


@njit(**PASS)
def compare_row(images, rays, share, e, r):  # pragma: no cover
    """What ray set e sees wrong along row r, into the ring."""
    channels, tiles, ring = images.channels, share.tiles, share.ring
    size_of_tile, width, line, side = TILE // channels, images.sizes[3, 1], U(r % ring.shape[2]), U(e % 2)
    unit, per_unit = np.float32(UNIT), np.float32(1 / UNIT)
    half, code = np.float32(0.5), np.float32(1 / (255 * INTENSITY))
    for tile in range((width + size_of_tile - 1) // size_of_tile):
        pixels = min(size_of_tile, width - tile * size_of_tile)
        first, last, offset = 0, pixels, U(tile * size_of_tile * channels)
        for n in range(3):
            for part in range(2):
                low, high = sample(
                    images.phasors[n, part], images.sizes[n, 0], images.sizes[n, 0], images.sizes[n, 1], NEAR_PX,
                    rays.seen[e, n], r, tile, pixels, channels, 3 * e + n, share.seen_layout, share.row,
                    tiles[2 * n + part],
                )  # fmt: skip
            first, last = max(first, low), min(last, high)
        for k in range(pixels * channels):
            a, b = tiles[0, U(k)] * per_unit, tiles[1, U(k)] * per_unit
            p, q = tiles[2, U(k)] * per_unit, tiles[3, U(k)] * per_unit
            u, v = tiles[4, U(k)] * per_unit, tiles[5, U(k)] * per_unit
            re, im = p * u - q * v, p * v + q * u
            slope = a * im + b * re
            error = half - half * (a * re - b * im) - np.float32(images.targets[side, U(r), U(k) + offset]) * code
            error *= unit
            at = U(k) + offset
            ring[U(e), U(0), line, at] = np.int16(np.int32(slope * slope * unit))
            ring[U(e), U(1), line, at] = np.int16(np.int32(np.rint(error * re)))
            ring[U(e), U(2), line, at] = np.int16(np.int32(np.rint(error * im)))
            ring[U(e), U(3), line, at] = np.int16(np.int32(np.rint(error * (a * u - b * v))))
            ring[U(e), U(4), line, at] = np.int16(np.int32(np.rint(error * (a * v + b * u))))
            ring[U(e), U(5), line, at] = np.int16(np.int32(np.rint(error * (a * p - b * q))))
            ring[U(e), U(6), line, at] = np.int16(np.int32(np.rint(error * (a * q + b * p))))
        for field in range(FIELDS):
            for k in range(first * channels):
                ring[U(e), U(field), line, U(k) + offset] = 0
            for k in range(max(first, last) * channels, pixels * channels):
                ring[U(e), U(field), line, U(k) + offset] = 0


@njit(**PASS)
def move_row(images, rays, kind, share, n, q):  # pragma: no cover
    """Row q of panel n, moved by what all rays through it see wrong."""
    channels, tiles, ring = images.channels, share.tiles, share.ring
    count, ring_rows, size_of_tile = ring.shape[0], ring.shape[2], TILE // channels
    height, width, line = images.sizes[3, 0], images.sizes[3, 1], U(q)
    none, half, full = np.float32(0), np.float32(0.5), np.float32(FULL)
    least, speed = np.float32(kind.floor * count * UNIT), np.float32(kind.momentum)
    size = np.float32(kind.size * FULL / (3 * np.pi / 2) / UNIT)
    for tile in range((images.sizes[n, 1] + size_of_tile - 1) // size_of_tile):
        pixels = min(size_of_tile, images.sizes[n, 1] - tile * size_of_tile)
        offset = U(tile * size_of_tile * channels)
        for part in range(3):
            for k in range(pixels * channels):
                tiles[U(part), U(k)] = none
        for e in range(count):
            for part in range(3):  # the squared slope, the real and the imaginary part
                sample_or(
                    ring[e, 2 * n + part if part else 0], ring_rows, height, width, 0.0, rays.back[e, n], q, tile,
                    pixels, channels, 3 * e + n, none, share.back_layout, share.row, tiles[3],
                )  # fmt: skip
                for k in range(pixels * channels):
                    tiles[U(part), U(k)] += tiles[3, U(k)]
        for k in range(pixels * channels):
            cosine = np.float32(images.phasors[U(n), U(0), line, U(k) + offset])
            sine = np.float32(images.phasors[U(n), U(1), line, U(k) + offset])
            change = size * (sine * tiles[1, U(k)] + cosine * tiles[2, U(k)]) / max(tiles[0, U(k)], least)
            now = min(max(np.float32(images.ahead[U(n), line, U(k) + offset]) - change, none), full)
            ahead = now + speed * (now - np.float32(images.last[U(n), line, U(k) + offset]))
            images.last[U(n), line, U(k) + offset] = np.int16(np.int32(now + half))
            images.moved[U(n), line, U(k) + offset] = np.int16(np.int32(np.floor(ahead + half)))


@njit(**PASS)
def move_rows(images, rays, kind, share):  # pragma: no cover
    """One thread's share of a step."""
    at0, at1, at2 = share.rows[0, 0], share.rows[1, 0], share.rows[2, 0]
    for r in range(share.first, share.end):
        for e in range(share.ring.shape[0]):
            compare_row(images, rays, share, e, r)
        while at0 < share.rows[0, 1] and rays.needs[0, at0, 1] <= r:
            move_row(images, rays, kind, share, 0, at0)
            at0 += 1
        while at1 < share.rows[1, 1] and rays.needs[1, at1, 1] <= r:
            move_row(images, rays, kind, share, 1, at1)
            at1 += 1
        while at2 < share.rows[2, 1] and rays.needs[2, at2, 1] <= r:
            move_row(images, rays, kind, share, 2, at2)
            at2 += 1


def rays_of(seen: F64, sizes: NDArray[np.int64]) -> Rays:
    """seen: (rays, 3, 3, 3), last entries about 1; sizes: (4, 2) rows and columns of the panels and of the rays."""
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


class PhasorState:
    """The panels between steps, and what steps work in."""

    def __init__(self, sizes: NDArray[np.int64], *, channels: int, threads: int) -> None:
        self.sizes, self.channels, self.threads = np.asarray(sizes, np.int64), channels, threads
        rows, columns = self.sizes.max(axis=0)
        shape = (rows + 1, columns * channels + MARGIN)
        self.panels, self._moved, self.last = (np.zeros((3, *shape), np.int16) for _ in range(3))
        self._phasors, self.targets = np.zeros((3, 2, *shape), np.int16), np.zeros((2, *shape), np.int16)
        self._columns = columns

    def start(self) -> None:
        """Begin at `panels`: without momentum."""
        self.last[...] = self.panels

    def step(self, rays: Rays, *, size: float, momentum: float, floor: float, drift_px: float = DRIFT_PX) -> None:
        """drift_px: how far a ray may be taken to lie from its place, so that pieces of a row serve the next one."""
        height, count, numbers = int(self.sizes[3, 0]), len(rays.seen), self.panels.shape[2]
        ring_rows = int((rays.needs[..., 1] - rays.needs[..., 0]).max()) + 2
        scale = float(np.abs(np.concatenate([rays.seen, rays.back])[..., 0, 0]).max())
        images = Images(
            self.panels, self._moved, self.last, self._phasors, self.targets, self.sizes, self.channels
        )  # fmt: skip
        for n, panel in enumerate(self.panels):
            whole = panel, self._phasors[n]

            def convert(first: int, last: int, whole: tuple[I16, I16] = whole) -> None:
                to_phasors(*whole, first, last, numbers)

            on_rows(convert, int(self.sizes[n, 0]), threads=self.threads)

        def share(index: int) -> None:
            first, end = (height * k // self.threads for k in (index, index + 1))
            rows, begin = np.zeros((3, 2), np.int64), first
            for n in range(3):
                last = rays.needs[n, : self.sizes[n, 0], 1]
                rows[n] = (
                    np.searchsorted(last, [first, end]) if end < height else (np.searchsorted(last, first), len(last))
                )
                if rows[n, 0] < rows[n, 1]:
                    begin = min(begin, int(rays.needs[n, rows[n, 0] : rows[n, 1], 0].min()))
            layouts = [new_layout(3 * count, self._columns, self.channels, drift_px=drift_px) for _ in range(2)]
            ring = np.zeros((count, FIELDS, ring_rows, numbers), np.int16)
            part = Share(begin, end, rows, ring, *layouts, work_row(scale), work_tiles())
            move_rows(images, rays, Kind(size, momentum, floor), part)

        at_once(share, range(self.threads))
        self.panels, self._moved = self._moved, self.panels
