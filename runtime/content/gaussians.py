"""3D Gaussian splats (Kerbl et al. 2023) as arrays: read from a .ply, projected, coloured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from runtime.config import LimitSettings
from runtime.content.ply import Table, read_vertices
from runtime.errors import InputError
from runtime.records import F32, F64

LOW_PASS_PX2 = 0.3  # added to each splat's covariance: none falls between the pixels
LEAST_ALPHA = 1 / 255
LARGEST_RELATIVE_SCALE = 1000.0  # of a splat, in units of the scene's extent
FARTHEST_RELATIVE = 1e6  # of a splat from the middle, in units of the median distance
LARGEST_COEFFICIENT = 1e4  # of the harmonics: colours are blended as half floats, which end at 65504
COEFFICIENTS = {0: 1, 9: 4, 24: 9, 45: 16}  # f_rest properties: spherical harmonics a channel

I64 = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Gaussians:
    """A scene of n splats in one frame."""

    centres: F32  # (n, 3)
    covariances: F32  # (n, 6): xx, xy, xz, yy, yz, zz
    opacities: F32  # (n,) in [0, 1]
    harmonics: F32  # (n, k, 3), k = 1, 4, 9 or 16; directions in the file's own frame


@dataclass(frozen=True, slots=True)
class Splats:
    """What an eye sees of them: ellipses in pixels, farthest first."""

    index: I64  # (m,) which gaussian
    centres_px: F32  # (m, 2)
    major_px: F32  # (m, 2) one standard deviation along the longer axis
    minor_px: F32  # (m, 2)
    reach: F32  # (m,) standard deviations at which alpha falls to 1/255
    opacities: F32  # (m,)


def load_gaussians(path: Path, *, limits: LimitSettings | None = None) -> Gaussians:
    """Read a splat file as the reference implementation writes it.

    Raises InputError: unreadable, a property missing, values that aren't finite, absurd scales.
    """
    table = read_vertices(path, limits=limits)
    names = set(table.dtype.names or ())
    rest = [name for name in names if name.startswith("f_rest_")]
    needed = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    needed += ["rot_0", "rot_1", "rot_2", "rot_3"]
    for name in needed:
        if name not in names:
            raise InputError(path, name, "the property is missing: this is no 3D Gaussian splat file")
    if len(rest) not in COEFFICIENTS:
        raise InputError(path, "f_rest", f"{len(rest)} properties; 0, 9, 24 or 45 are needed")
    for index in range(len(rest)):
        if f"f_rest_{index}" not in names:
            raise InputError(path, f"f_rest_{index}", "the property is missing")
    if not len(table):
        raise InputError(path, "vertex", "there are none")

    def columns(prefix: str, count: int) -> F32:
        return _numbers(table, [f"{prefix}{index}" for index in range(count)], path, prefix.rstrip("_"))

    centres = _numbers(table, ["x", "y", "z"], path, "x, y, z")
    away = np.abs(centres.astype(np.float64) - np.median(centres, axis=0)).max(1)
    stray = int((away > FARTHEST_RELATIVE * np.median(away)).sum()) if np.median(away) > 0 else 0
    if stray:
        raise InputError(path, "x, y, z", f"{stray} splats are over {FARTHEST_RELATIVE:g} times the scene's size away")
    log_scales = columns("scale_", 3)
    extent = float(np.ptp(np.percentile(centres, [1, 99], axis=0), axis=0).max()) or 1.0
    limit = np.log(LARGEST_RELATIVE_SCALE * extent)
    for axis in range(3):
        absurd = int((log_scales[:, axis] > limit).sum())
        if absurd:
            raise InputError(
                path, f"scale_{axis}", f"{absurd} splats are over {LARGEST_RELATIVE_SCALE:g} times the scene"
            )
    higher = columns("f_rest_", len(rest)).reshape(len(table), 3, -1).transpose(0, 2, 1) if rest else None
    first = columns("f_dc_", 3)[:, None]
    harmonics = first if higher is None else np.ascontiguousarray(np.concatenate([first, higher], axis=1))
    glaring = int((np.abs(harmonics) > LARGEST_COEFFICIENT).any((1, 2)).sum())
    if glaring:
        raise InputError(path, "f_dc, f_rest", f"{glaring} splats have coefficients over {LARGEST_COEFFICIENT:g}")
    rotations = columns("rot_", 4)
    undirected = int((~rotations.any(1)).sum())
    if undirected:
        raise InputError(path, "rot", f"{undirected} of {len(table)} are no rotations: all four numbers are 0")
    opacity = _numbers(table, ["opacity"], path, "opacity")[:, 0].astype(np.float64)
    opacities = np.asarray(expit(opacity), dtype=np.float32)
    if not (opacities > LEAST_ALPHA).any():
        raise InputError(path, "opacity", "no splat can be seen")
    return Gaussians(centres, covariances_of(np.exp(log_scales), rotations), opacities, harmonics)


def _numbers(table: Table, names: list[str], path: Path, field: str) -> F32:
    """(n, len(names)) finite float32 columns of a table. Raises InputError."""
    with np.errstate(over="ignore"):  # a double beyond float32 becomes infinite, and is told
        values = np.column_stack([table[name] for name in names]).astype(np.float32)
    broken = int((~np.isfinite(values).all(1)).sum())
    if broken:
        raise InputError(path, field, f"{broken} of {len(values)} are not finite")
    return values


def covariances_of(scales: F32, quaternions: F32) -> F32:
    """(n, 6) R diag(s²) R^T of (n, 3) standard deviations and (n, 4) quaternions w, x, y, z of any length."""
    unit = quaternions / np.maximum(np.linalg.norm(quaternions, axis=1, keepdims=True), 1e-12)
    w, x, y, z = unit.T.astype(np.float64)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    spread = rotation * scales.T.astype(np.float64)[None]
    full = np.einsum("ikn,jkn->ijn", spread, spread)
    return np.stack([full[0, 0], full[0, 1], full[0, 2], full[1, 1], full[1, 2], full[2, 2]], axis=1).astype(np.float32)


def moved(gaussians: Gaussians, target_from_source: F64) -> Gaussians:
    """The same splats in another frame (4x4 similarity); harmonics stay in the file's directions."""
    linear = target_from_source[:3, :3]
    centres = gaussians.centres @ linear.T + target_from_source[:3, 3]
    full = gaussians.covariances.astype(np.float64)[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    turned = linear @ full @ linear.T
    packed = turned.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    return Gaussians(centres.astype(np.float32), packed.astype(np.float32), gaussians.opacities, gaussians.harmonics)


def seen_splats(
    gaussians: Gaussians, pixels_from_stack: F64, *, width_px: int, height_px: int, nearest_m: float = 1e-3
) -> Splats:
    """Project to first order about each centre (EWA, Zwicker et al. 2001), leave out what can't be seen, sort.

    A 3x4 projection of any kind will do: the Jacobian is (P_i - u_i P_3)/w, so a panel's own pixels are as good
    as an eye's image.
    """
    projection = pixels_from_stack.astype(np.float32)
    homogeneous = gaussians.centres @ projection[:, :3].T + projection[:, 3]
    w = homogeneous[:, 2]
    shown = np.flatnonzero((w > nearest_m) & (gaussians.opacities > LEAST_ALPHA))
    u, v = (homogeneous[shown, :2] / w[shown, None]).T
    p0, p1, p2 = projection[:, :3]
    weight = 1 / w[shown]
    j0 = (p0[:, None] - p2[:, None] * u) * weight
    j1 = (p1[:, None] - p2[:, None] * v) * weight
    xx, xy, xz, yy, yz, zz = gaussians.covariances[shown].T
    k0, k1, k2 = xx * j0[0] + xy * j0[1] + xz * j0[2], xy * j0[0] + yy * j0[1] + yz * j0[2], None
    k2 = xz * j0[0] + yz * j0[1] + zz * j0[2]
    a = j0[0] * k0 + j0[1] * k1 + j0[2] * k2 + LOW_PASS_PX2
    b = j1[0] * k0 + j1[1] * k1 + j1[2] * k2
    l0, l1, l2 = xx * j1[0] + xy * j1[1] + xz * j1[2], xy * j1[0] + yy * j1[1] + yz * j1[2], None
    l2 = xz * j1[0] + yz * j1[1] + zz * j1[2]
    c = j1[0] * l0 + j1[1] * l1 + j1[2] * l2 + LOW_PASS_PX2
    opacity = gaussians.opacities[shown]
    reach = np.sqrt(2 * np.log(opacity / np.float32(LEAST_ALPHA)))
    half_u, half_v = reach * np.sqrt(a), reach * np.sqrt(c)
    inside = (u + half_u > 0) & (u - half_u < width_px) & (v + half_v > 0) & (v - half_v < height_px)
    keep = np.flatnonzero(inside)
    keep = keep[np.argsort(-w[shown[keep]], kind="stable")]
    a, b, c = a[keep], b[keep], c[keep]
    # Eigenvectors of [[a, b], [b, c]] by the half-angle, which is exact where b = 0 too.
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
    )


def harmonic_basis(directions: F32, count: int) -> F32:
    """(n, count) real spherical harmonics, in the order and with the signs of the reference implementation."""
    x, y, z = directions.T
    basis = [np.full_like(x, 0.28209479177387814)]
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
    """(n, 3) colours, not below 0, of (n, k, 3) coefficients seen along (n, 3) unit directions from the eye."""
    if harmonics.shape[1] == 1:
        return np.asarray(np.maximum(harmonics[:, 0] * np.float32(0.28209479177387814) + np.float32(0.5), 0))
    basis = harmonic_basis(directions, harmonics.shape[1])
    return np.asarray(np.maximum(np.einsum("nk,nkc->nc", basis, harmonics) + np.float32(0.5), 0))
