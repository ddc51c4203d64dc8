"""Read 3D Gaussian splats (Kerbl et al. 2023) from PLY files, project them and compute their colours."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.special import expit

from runtime.content.base import View
from runtime.content.camera import NEAREST_M
from runtime.content.ply import PlyHeader, read_elements
from runtime.errors import InputError
from runtime.records import F32, F64

log = logging.getLogger("phasestack.content")

LOW_PASS_PX2 = 0.3  # variance added to each projected splat, to keep small splats visible between pixels
ALPHA_MIN = 1 / 255  # smallest splat alpha that can change a pixel's 8-bit value
LARGEST_COORDINATE = 1e15  # products of two coordinates of this size still fit in float32
LARGEST_RELATIVE_SCALE = 100.0  # largest splat scale, as a multiple of the scene's extent
STRAY = 1.0  # percentage of splats excluded from bounds as outliers, at each end of each axis
FAINT = 0.1  # splats with at most this opacity are ignored in bounds
REACH = 2.0  # standard deviations of each splat included in bounds
AT_ONCE = 1 << 17  # number of splats processed or drawn together, to limit memory use
SAMPLED = 10_000  # approximate number of points used to estimate the spacing of points
DOTS, MOST_DOTS = 500, 200_000  # largest number of dots: per line on average, and for all lines together
FINEST_POINT, LARGEST_POINT = 5e-4, 0.01  # limits for a point's standard deviation, as a share of the scene's extent
FLAT_HARMONIC = 0.28209479177387814  # spherical harmonic of degree 0
COEFFICIENTS = (0, 9, 24, 45)  # numbers of f_rest properties for harmonics up to degree 0, 1, 2 and 3
SOLID = 0.3  # splats with a higher alpha count as a surface; two such splats hide half of the background
SQUARE = 0.89  # half the side of a square with the same area as a disc of radius 1
LARGEST_STEP = 7  # index of the largest square; its half side is 64 blocks
PACKED = [0, 1, 2, 4, 5, 8]  # row-major indices of a symmetric 3x3 matrix's stored elements

I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Gaussians:
    """A scene of n Gaussian splats in a common frame."""

    centres: F32  # (n, 3)
    covariances: F32  # (n, 6) elements xx, xy, xz, yy, yz, zz
    opacities: F32  # (n,) in [0, 1]
    harmonics: F32  # (n, k, 3) RGB coefficients for k = 1, 4, 9 or 16; directions are in the file's frame


@dataclass(frozen=True, slots=True)
class Splats:
    """The m splats visible to one eye, projected to ellipses in pixels, farthest first."""

    index: I64  # (m,) indices of the splats in the scene
    centres_px: F32  # (m, 2)
    major_px: F32  # (m, 2) one standard deviation along the longer axis
    minor_px: F32  # (m, 2) one standard deviation along the shorter axis
    reach: F32  # (m,) number of standard deviations at which alpha falls to 1/255
    opacities: F32  # (m,)
    nearness: F32  # (m,) inverse of the view's third coordinate, in 1/m


def load_gaussians(header: PlyHeader) -> Gaussians:
    """Read the usable splats in a PLY file that has the reference implementation's format. Raises
    InputError if the file is damaged or not binary, a property is missing, or no splat is visible.
    """
    path, table = header.path, read_elements(header)["vertex"]
    if not len(table):
        raise InputError(path, "vertex", "the file contains no splats")
    names = set(table.dtype.names or ())
    rest = sum(name.startswith("f_rest_") for name in names)
    if rest not in COEFFICIENTS:
        raise InputError(path, "f_rest", f"the file has {rest} such properties, but must have 0, 9, 24 or 45")

    def columns(*wanted: str) -> F32:
        """Return the named properties as columns of an array."""
        if missing := [name for name in wanted if name not in names]:
            raise InputError(path, missing[0], "the property is missing, so this is not a 3D Gaussian splat file")
        with np.errstate(over="ignore"):  # doubles beyond float32's range become infinite
            return np.column_stack([table[name] for name in wanted]).astype(np.float32)

    harmonics = np.empty((len(table), 1 + rest // 3, 3), np.float32)
    harmonics[:, 0] = columns(*(f"f_dc_{channel}" for channel in range(3)))
    for number in range(rest):
        channel, place = divmod(number, rest // 3)
        harmonics[:, 1 + place, channel] = columns(f"f_rest_{number}")[:, 0]
    return drawable(
        path,
        centres=columns("x", "y", "z"),
        log_scales=columns(*(f"scale_{axis}" for axis in range(3))),
        quaternions=columns(*(f"rot_{axis}" for axis in range(4))),
        logits=columns("opacity")[:, 0],
        harmonics=harmonics,
    )


def drawable(path: Path, *, centres: F32, log_scales: F32, quaternions: F32, logits: F32, harmonics: F32) -> Gaussians:
    """Return the splats that can be drawn, given centres (n, 3), natural logarithms of the deviations (n,
    3), rotations as quaternions (n, 4) in w, x, y, z order and of any length above 0, opacity logits (n,), and
    harmonics (n, k, 3).

    Splats that are not finite, have no rotation, or are much larger than the scene are dropped, and their number is
    logged. Raises InputError, which names `path`, if no visible splats remain.
    """
    with np.errstate(invalid="ignore"):  # comparisons with NaN are false
        usable = (np.abs(centres) < LARGEST_COORDINATE).all(1) & (quaternions != 0).any(1) & ~np.isnan(logits)
        for values in (quaternions, harmonics.reshape(len(centres), -1)):
            usable &= np.isfinite(values).all(1)
        some = centres[usable]
        extent = _extent(some) if len(some) else 0.0
        # The logarithm may be minus infinity, which trainers write for a disc's thickness.
        usable &= (log_scales < np.log(LARGEST_RELATIVE_SCALE * (extent or 1.0))).all(1)
    if not usable.all():
        log.warning("%s: ignoring %d of %d splats because they are not usable", path, (~usable).sum(), len(usable))
        centres, log_scales, quaternions = centres[usable], log_scales[usable], quaternions[usable]
        logits, harmonics = logits[usable], harmonics[usable]
    opacities = np.asarray(expit(logits.astype(np.float64)), dtype=np.float32)
    if not (opacities > ALPHA_MIN).any():
        raise InputError(path, "opacity", "no splat is visible")
    return Gaussians(centres, covariances_of(np.exp(log_scales), quaternions), opacities, harmonics)


def _extent(places: F32) -> float:
    """Return the longest side of a box that excludes one percent of positions at each end of each axis."""
    return float(np.ptp(np.percentile(places, [1, 99], axis=0), axis=0).max())


def flat_harmonics(colours: F32) -> F32:
    """Return degree-0 harmonics (n, 1, 3) for colours (n, 3) that look the same from all directions."""
    return np.asarray((colours - np.float32(0.5)) / np.float32(FLAT_HARMONIC), np.float32)[:, None]


def with_higher(flat: F32, higher: NDArray[Any], *, zero: float = 0.0, unit: float = 1.0) -> F32:
    """Append higher harmonics (n, k - 1, 3), encoded as value / unit + zero, to those of degree 0."""
    harmonics = np.empty((len(flat), 1 + higher.shape[1], 3), np.float32)
    harmonics[:, :1], harmonics[:, 1:] = flat, higher
    harmonics[:, 1:] -= np.float32(zero)
    harmonics[:, 1:] *= np.float32(unit)
    return harmonics


def dotted(ends: F32, colours: F32) -> tuple[F32, F32]:
    """Convert lines' ends (n, 2, 3) and colours to dense points (m, 3) with interpolated colours."""
    lengths = np.nan_to_num(np.linalg.norm(np.diff(ends.astype(np.float64), axis=1)[:, 0], axis=1))
    share = np.minimum(lengths / max(float(lengths.sum()), 1e-30), 1.0)
    counts = 2 + (share * min(DOTS * len(ends), MOST_DOTS)).astype(np.int64)
    line = np.repeat(np.arange(len(ends)), counts)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    share = ((np.arange(len(line)) - first) / (counts[line] - 1))[:, None].astype(np.float32)
    along = (values[line, 0] * (1 - share) + values[line, 1] * share for values in (ends, colours))
    return next(along), next(along)


def of_points(places: F32, colours: F32) -> Gaussians:
    """Convert points (n, 3) to small round splats that are about as large as the spacing between the
    points. Colours (n, 3) are 0-1. A point whose colour is NaN is coloured by its position, because nothing but an
    outline would be visible if all points had one colour.
    """
    low, high = np.percentile(places, [1, 99], axis=0)
    by_place = 0.25 + 0.7 * np.clip((places - low) / np.maximum(high - low, 1e-30), 0, 1)
    colours = np.where(np.isnan(colours), by_place, colours).astype(np.float32)
    some = places[:: max(1, len(places) // SAMPLED)].astype(np.float64)
    apart = np.median(cKDTree(places).query(some, k=2)[0][:, 1]) if len(places) > 1 else 1.0
    extent = _extent(places) or 1.0
    sigma = np.clip(apart / 2, extent * FINEST_POINT, extent * LARGEST_POINT)
    covariances = np.zeros((len(places), 6), np.float32)
    covariances[:, [0, 3, 5]] = sigma**2
    opaque = np.ones(len(places), np.float32)
    return Gaussians(places.astype(np.float32), covariances, opaque, flat_harmonics(colours))


def bounds(gaussians: Gaussians) -> tuple[F64, F64]:
    """Return the lowest and highest corner (3,) of the splats, without faint splats and outliers."""
    seen = gaussians.opacities > FAINT
    seen = seen if seen.any() else np.ones_like(seen)
    centres = gaussians.centres[seen].astype(np.float64)
    reach = REACH * np.sqrt(gaussians.covariances[seen][:, [0, 3, 5]].astype(np.float64))
    reach = np.minimum(reach, np.percentile(reach, 100 - STRAY, axis=0))
    low, high = np.percentile(centres - reach, STRAY, axis=0), np.percentile(centres + reach, 100 - STRAY, axis=0)
    return np.asarray(low), np.asarray(high)


def covariances_of(scales: F32, quaternions: F32) -> F32:
    """Return covariances R diag(s²) R^T, packed as (n, 6), of deviations s and quaternions w, x, y, z."""
    packed = np.empty((len(scales), 6), np.float32)
    for first in range(0, len(scales), AT_ONCE):
        rows = slice(first, first + AT_ONCE)
        rotation = Rotation.from_quat(quaternions[rows], scalar_first=True).as_matrix()
        spread = rotation * scales[rows].astype(np.float64)[:, None]
        packed[rows] = (spread @ spread.transpose(0, 2, 1)).reshape(-1, 9)[:, PACKED]
    return packed


def moved(gaussians: Gaussians, target_from_source: F64) -> Gaussians:
    """Transform splats to another frame by a 4x4 similarity. Harmonics stay in the file's frame."""
    linear = target_from_source[:3, :3]
    centres = gaussians.centres @ linear.T + target_from_source[:3, 3]
    packed = np.empty_like(gaussians.covariances)
    for first in range(0, len(packed), AT_ONCE):
        some = gaussians.covariances[first : first + AT_ONCE].astype(np.float64)
        turned = linear @ some[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3) @ linear.T
        packed[first : first + AT_ONCE] = turned.reshape(-1, 9)[:, PACKED]
    return Gaussians(centres.astype(np.float32), packed, gaussians.opacities, gaussians.harmonics)


def seen_splats(gaussians: Gaussians, view: View) -> Splats:
    """Project the splats in `stack` to first order (EWA, Zwicker et al. 2001), and sort them by distance.
    The view's 3x4 projection P may map to a panel's pixels or to those of an eye's image. Pixel coordinate u_i has the
    Jacobian (P_i - u_i P_3) / w. Splats nearer to the eye than `NEAREST_M` are left out.
    """
    projection = view.pixels_from_stack.astype(np.float32)
    homogeneous = gaussians.centres @ projection[:, :3].T + projection[:, 3]
    w = homogeneous[:, 2]
    shown = np.flatnonzero((w > NEAREST_M) & (gaussians.opacities > ALPHA_MIN))
    u, v = (homogeneous[shown, :2] / w[shown, None]).T
    p0, p1, p2 = projection[:, :3]
    weight = 1 / w[shown]
    j0 = (p0[:, None] - p2[:, None] * u) * weight
    j1 = (p1[:, None] - p2[:, None] * v) * weight
    xx, xy, xz, yy, yz, zz = gaussians.covariances[shown].T
    k0, k1 = xx * j0[0] + xy * j0[1] + xz * j0[2], xy * j0[0] + yy * j0[1] + yz * j0[2]
    k2 = xz * j0[0] + yz * j0[1] + zz * j0[2]
    a = j0[0] * k0 + j0[1] * k1 + j0[2] * k2 + LOW_PASS_PX2
    b = j1[0] * k0 + j1[1] * k1 + j1[2] * k2
    l0, l1 = xx * j1[0] + xy * j1[1] + xz * j1[2], xy * j1[0] + yy * j1[1] + yz * j1[2]
    l2 = xz * j1[0] + yz * j1[1] + zz * j1[2]
    c = j1[0] * l0 + j1[1] * l1 + j1[2] * l2 + LOW_PASS_PX2
    opacity = gaussians.opacities[shown]
    reach = np.sqrt(2 * np.log(opacity / np.float32(ALPHA_MIN)))
    half_u, half_v = reach * np.sqrt(a), reach * np.sqrt(c)
    inside = (u + half_u > 0) & (u - half_u < view.width_px) & (v + half_v > 0) & (v - half_v < view.height_px)
    keep = np.flatnonzero(inside)
    keep = keep[np.argsort(-w[shown[keep]], kind="stable")]
    a, b, c = a[keep], b[keep], c[keep]
    # This half-angle formula for the eigenvectors of [[a, b], [b, c]] is exact for b = 0.
    mean, swing = (a + c) / 2, np.hypot((a - c) / 2, b)
    angle = np.arctan2(b, (a - c) / 2) / 2
    cosine, sine = np.cos(angle), np.sin(angle)
    longer, shorter = np.sqrt(mean + swing), np.sqrt(np.maximum(mean - swing, 1e-6))
    return Splats(
        index=shown[keep],
        centres_px=np.column_stack([u[keep], v[keep]]),
        major_px=np.column_stack([cosine, sine]) * longer[:, None],
        minor_px=np.column_stack([-sine, cosine]) * shorter[:, None],
        reach=reach[keep],
        opacities=opacity[keep],
        nearness=weight[keep].astype(np.float32),
    )


def nearest_blocks(splats: Splats, view: View, *, every: int, first: tuple[int, int]) -> F32:
    """Return the inverse distances (h, w), in 1/m, to the nearest splats whose alpha exceeds `SOLID`, as
    `nearness` does. Each splat is treated as a square at the distance of its centre, as large as the area where alpha
    exceeds `SOLID`, except that half its side, in blocks, is rounded down to 0 or a power of two.
    """
    shape = -(-(view.height_px + first[1]) // every), -(-(view.width_px + first[0]) // every)
    solid = np.flatnonzero(splats.opacities > SOLID)  # farthest first
    (a, b), (c, d) = splats.major_px[solid].T, splats.minor_px[solid].T
    half_px = SQUARE * np.sqrt(abs(a * d - b * c) * 2 * np.log(splats.opacities[solid] / np.float32(SOLID)))
    step = np.clip(np.log2(half_px / np.float32(every)) + 1, 0, LARGEST_STEP).astype(np.int8)
    column, row = np.floor((splats.centres_px[solid] + np.array(first, np.float32)).T / np.float32(every))
    nearness = np.zeros(shape, np.float32)
    for number in np.flatnonzero(np.bincount(step)):
        some, reach = np.flatnonzero(step == number), (1 << number) >> 1
        u, v = np.clip(column[some], 0, shape[1] - 1), np.clip(row[some], 0, shape[0] - 1)
        near = (abs(u - column[some]) <= reach) & (abs(v - row[some]) <= reach)
        u, v, some = u[near].astype(np.intp), v[near].astype(np.intp), some[near]
        layer = np.zeros(shape, np.float32)
        layer[v, u] = splats.nearness[solid[some]]  # if a block has several splats, the last and nearest one wins
        np.maximum(nearness, cv2.dilate(layer, np.ones((2 * reach + 1,) * 2, np.uint8)), out=nearness)
    return nearness


def harmonic_basis(directions: F32, count: int) -> F32:
    """Return the first `count` real spherical harmonics (n, count) for unit directions (n, 3)."""
    x, y, z = directions.T
    basis = [np.full_like(x, FLAT_HARMONIC)]
    if count > 1:
        c1 = np.float32(0.4886025119029199)
        basis += [-c1 * y, c1 * z, -c1 * x]
    if count > 4:
        xx, yy, zz = x * x, y * y, z * z
        c2, c20 = np.float32(1.0925484305920792), np.float32(0.31539156525252005)
        basis += [c2 * x * y, -c2 * y * z, c20 * (2 * zz - xx - yy), -c2 * x * z, c2 / 2 * (xx - yy)]
    if count > 9:
        c30, c31, c32 = np.float32(0.5900435899266435), np.float32(2.890611442640554), np.float32(0.4570457994644658)
        basis += [
            -c30 * y * (3 * xx - yy),
            c31 * x * y * z,
            -c32 * y * (4 * zz - xx - yy),
            np.float32(0.3731763325901154) * z * (2 * zz - 3 * xx - 3 * yy),
            -c32 * x * (4 * zz - xx - yy),
            c31 / 2 * z * (xx - yy),
            -c30 * x * (xx - 3 * yy),
        ]
    return np.stack(basis, axis=1)


def colours_towards(harmonics: F32, directions: F32) -> F32:
    """Return the colours (n, 3), clipped at 0, of harmonics (n, k, 3) in unit directions from the eye."""
    if harmonics.shape[1] == 1:
        return np.asarray(np.maximum(harmonics[:, 0] * np.float32(FLAT_HARMONIC) + np.float32(0.5), 0))
    basis = harmonic_basis(directions, harmonics.shape[1])
    return np.asarray(np.maximum(np.einsum("nk,nkc->nc", basis, harmonics) + np.float32(0.5), 0))
