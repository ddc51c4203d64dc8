"""Read Gaussian splats in glTF files (KHR_gaussian_splatting, also compressed as SPZ)."""

from __future__ import annotations

import numpy as np
from scipy.special import logit

from runtime.content.compressed_splats import spz_splats
from runtime.content.gaussians import FLAT_HARMONIC, Gaussians, drawable, flat_harmonics, harmonic_basis, moved
from runtime.content.gltf_file import GltfFile, Table
from runtime.content.parts import coded
from runtime.content.shapes import Origin, placed
from runtime.errors import InputError
from runtime.records import F32, F64

SPLATS = "KHR_gaussian_splatting"
SPZ = ("KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz")  # the second: a draft
NAMES = {SPLATS, *SPZ}  # extensions that this module reads
LINEAR = "lin_rec709_display"  # colour space in which colours are linear
LEFT_UP_FRONT = np.diag([-1.0, 1.0, -1.0, 1.0])  # glTF's axes from those that SPZ files have
DEGREES = {1: 3, 2: 5, 3: 7}  # number of harmonics of each degree
DIRECTIONS = 64  # directions used to turn harmonics; more than there are harmonics


def is_splats(primitive: Table) -> bool:
    """Return True if a primitive consists of Gaussian splats."""
    return SPLATS in primitive.get("extensions", {})


def read_splats(file: GltfFile, primitive: Table) -> Gaussians:
    """Read a primitive's splats, in the mesh's frame. Raises InputError."""
    own = primitive["extensions"][SPLATS]
    for name in SPZ:
        if name in own.get("extensions", {}):
            data, _ = file.view(own["extensions"][name]["bufferView"])
            return turned(spz_splats(file.path, bytes(data)), LEFT_UP_FRONT, Origin())

    def values(name: str) -> F32:
        attributes = primitive["attributes"]
        full = name if name == "POSITION" else f"{SPLATS}:{name}"
        if full not in attributes:
            raise InputError(file.path, full, "the attribute is missing")
        return np.asarray(file.accessor(attributes[full]), np.float32)

    scales, harmonics = values("SCALE"), [values("SH_DEGREE_0_COEF_0")]
    for degree, count in DEGREES.items():
        if f"{SPLATS}:SH_DEGREE_{degree}_COEF_0" not in primitive["attributes"]:
            break
        harmonics += [values(f"SH_DEGREE_{degree}_COEF_{k}") for k in range(count)]
    if own.get("colorSpace") == LINEAR:  # colours that depend on the direction are not converted
        harmonics = [flat_harmonics(coded(0.5 + FLAT_HARMONIC * harmonics[0]))[:, 0]]
    with np.errstate(all="ignore"):
        # Files from before the specification was ratified have logarithms, most of which are negative.
        logs = scales if (scales < 0).any() else np.log(scales)
        return drawable(
            file.path,
            centres=values("POSITION"),
            log_scales=logs,
            quaternions=np.roll(values("ROTATION"), 1, axis=1),
            logits=logit(values("OPACITY")[:, 0]),
            harmonics=np.stack(harmonics, axis=1),
        )


def turned(gaussians: Gaussians, matrix: F64, origin: Origin) -> Gaussians:
    """Transform splats by an affine matrix (4, 4), including their harmonics, and subtract `origin`."""
    centres, _ = placed(gaussians.centres, None, matrix, origin=origin)
    linear = np.eye(4)
    linear[:3, :3] = matrix[:3, :3]
    covariances = moved(gaussians, linear).covariances
    return Gaussians(centres, covariances, gaussians.opacities, turned_harmonics(gaussians.harmonics, matrix[:3, :3]))


def turned_harmonics(harmonics: F32, linear: F64) -> F32:
    """Return harmonics (n, k, 3) that have been turned by a linear map (3, 3). Exact for rotations,
    reflections and uniform scales, because they map the harmonics of each degree to each other.
    """
    count = harmonics.shape[1]
    if count == 1 or np.allclose(linear, linear[0, 0] * np.eye(3)):
        return harmonics
    after = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    before = after @ np.linalg.pinv(linear).T
    basis_after, basis_before = (
        harmonic_basis((one / np.linalg.norm(one, axis=1, keepdims=True)).astype(np.float64), count)
        for one in (after, before)
    )
    turn = np.linalg.lstsq(basis_after, basis_before, rcond=None)[0]
    return np.asarray(np.einsum("kj,njc->nkc", turn, harmonics), np.float32)


def together(all_splats: list[Gaussians]) -> Gaussians:
    """Return several scenes of splats as one, with as many harmonics as the one with the most."""
    most = max(one.harmonics.shape[1] for one in all_splats)
    harmonics = [np.pad(one.harmonics, ((0, 0), (0, most - one.harmonics.shape[1]), (0, 0))) for one in all_splats]
    joined = (
        np.concatenate([getattr(one, name) for one in all_splats]) for name in ("centres", "covariances", "opacities")
    )
    centres, covariances, opacities = joined
    return Gaussians(centres, covariances, opacities, np.concatenate(harmonics))
