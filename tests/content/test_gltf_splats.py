"""Reads Gaussian splats in glTF files, plain and compressed as SPZ."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.config import ContentSettings
from runtime.content.compressed_splats import load_compressed_splats
from runtime.content.gaussians import Gaussians, colours_towards
from runtime.content.gltf_splats import SPLATS
from runtime.content.mesh import load_mesh
from runtime.content.registry import prepare_content
from runtime.content.splat import SplatSource
from runtime.errors import InputError
from tests.content.conftest import STACK
from tests.content.gltf_files import SQUARE, SQUARE_FACES, Buffer
from tests.content.packed_splat_files import columns, rest_of, unit_turns, write_spz
from tests.content.test_splat import loaded, splat_table, written

SPZ = "KHR_gaussian_splatting_compression_spz_2"
ELLIPSES = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}


def primitive_of(buffer: Buffer, table: np.ndarray, *, logs: bool = False, **own: Any) -> dict[str, Any]:
    scales = columns(table, "scale_0", "scale_1", "scale_2")
    attributes = {
        "POSITION": buffer.add(columns(table, "x", "y", "z")),
        f"{SPLATS}:SCALE": buffer.add(scales if logs else np.exp(scales)),
        f"{SPLATS}:ROTATION": buffer.add(np.roll(unit_turns(table), -1, axis=1)),
        f"{SPLATS}:OPACITY": buffer.add(1 / (1 + np.exp(-columns(table, "opacity")))),
        f"{SPLATS}:SH_DEGREE_0_COEF_0": buffer.add(columns(table, "f_dc_0", "f_dc_1", "f_dc_2")),
    }
    names = [f"SH_DEGREE_{degree}_COEF_{k}" for degree in (1, 2, 3) for k in range(2 * degree + 1)]
    for name, values in zip(names, rest_of(table).transpose(1, 0, 2)):
        attributes[f"{SPLATS}:{name}"] = buffer.add(values)
    return {"mode": 0, "attributes": attributes, "extensions": {SPLATS: {**ELLIPSES, **own}}}


def splats_in(path: Path) -> Gaussians:
    (splats,) = load_mesh(path).splats
    return splats


def alike(found: Gaussians, wanted: Gaussians) -> None:
    assert found.centres == pytest.approx(wanted.centres, abs=1e-5)
    assert found.covariances == pytest.approx(wanted.covariances, rel=1e-3, abs=1e-5)
    assert found.opacities == pytest.approx(wanted.opacities, abs=1e-5)
    assert found.harmonics == pytest.approx(wanted.harmonics, abs=1e-5)


@pytest.mark.parametrize("logs", [False, True])  # drafts of the specification had logarithms
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_splats_are_those_of_the_ply_file(tmp_path: Path, degree: int, logs: bool) -> None:
    table, buffer = splat_table(50, degree=degree), Buffer()
    path = buffer.write(tmp_path / "a.gltf", primitive_of(buffer, table, logs=logs), extensionsRequired=[SPLATS])
    alike(splats_in(path), loaded(written(tmp_path, table)))


@pytest.mark.parametrize("version", [2, 3, 4])
def test_compressed_splats_are_those_of_the_spz_file_seen_from_behind(tmp_path: Path, version: int) -> None:
    """The extension has glTF's axes, left, up and front; SPZ files have right, up and back."""
    spz = write_spz(tmp_path / "a.spz", splat_table(50, degree=2), version=version)
    buffer = Buffer()
    buffer.add(np.frombuffer(spz.read_bytes(), np.uint8), np.uint8)
    own = {"extensions": {SPZ: {"bufferView": 0}}}
    primitive = {"mode": 0, "attributes": {}, "extensions": {SPLATS: {**ELLIPSES, **own}}}
    path = buffer.write(tmp_path / "a.gltf", primitive, extensionsRequired=[SPLATS, SPZ], accessors=[])
    found, wanted = splats_in(path), load_compressed_splats(spz)
    back = np.array([-1, 1, -1], np.float32)
    assert found.centres == pytest.approx(wanted.centres * back, abs=1e-5)
    assert found.covariances == pytest.approx(wanted.covariances * [1, -1, 1, 1, -1, 1], abs=1e-6)
    direction = np.array([[0.6, 0.64, 0.48]], np.float32).repeat(50, 0)
    assert colours_towards(found.harmonics, direction) == pytest.approx(
        colours_towards(wanted.harmonics, direction * back), abs=1e-5
    )


def test_colours_turn_with_the_node(tmp_path: Path) -> None:
    table, buffer = splat_table(50, degree=3), Buffer()
    turn = [0.5, 0.5, 0.5, 0.5]  # x to y, y to z, z to x
    path = buffer.write(
        tmp_path / "a.gltf",
        primitive_of(buffer, table),
        nodes=[{"mesh": 0, "rotation": turn, "scale": [2, 2, 2], "translation": [1, 2, 3]}],
    )
    found, wanted = splats_in(path), loaded(written(tmp_path, table))
    assert found.centres == pytest.approx(2 * np.roll(wanted.centres, 1, axis=1) + [1, 2, 3], abs=1e-5)
    assert found.covariances[:, 3] == pytest.approx(4 * wanted.covariances[:, 0], rel=1e-4)
    direction = np.array([[0.6, 0.64, 0.48]], np.float32).repeat(50, 0)
    assert colours_towards(found.harmonics, np.roll(direction, 1, axis=1)) == pytest.approx(
        colours_towards(wanted.harmonics, direction), abs=1e-4
    )


def test_linear_colours_are_encoded(tmp_path: Path) -> None:
    table, buffer = splat_table(5, degree=1), Buffer()
    for name in ("f_dc_0", "f_dc_1", "f_dc_2"):
        table[name] = (0.2140 - 0.5) / 0.28209479  # half of full brightness, as seen
    path = buffer.write(tmp_path / "a.gltf", primitive_of(buffer, table, colorSpace="lin_rec709_display"))
    seen = colours_towards(splats_in(path).harmonics, np.eye(3, dtype=np.float32)[[0] * 5])
    assert seen == pytest.approx(np.full((5, 3), 0.5), abs=1e-3)


def test_faint_and_stray_splats_do_not_count_in_the_fit(tmp_path: Path) -> None:
    buffer = Buffer()
    data = load_mesh(buffer.write(tmp_path / "a.gltf", primitive_of(buffer, splat_table(50))))
    assert (data.high - data.low > [1.5, 3, 1.8]).all() and (data.high - data.low < [4, 6, 5]).all()


def test_splats_next_to_triangles_are_left_out_and_named(tmp_path: Path) -> None:
    buffer = Buffer()
    square = {"attributes": {"POSITION": buffer.add(SQUARE)}, "indices": buffer.add(SQUARE_FACES, np.uint16)}
    meshes = [{"primitives": [primitive_of(buffer, splat_table(5)), square]}]
    data = load_mesh(buffer.write(tmp_path / "a.gltf", square, meshes=meshes))
    assert data.left_out == ("splats",) and len(data.parts) == 1 and not data.splats


def test_missing_rotation_is_one_line(tmp_path: Path) -> None:
    buffer = Buffer()
    primitive = primitive_of(buffer, splat_table(5))
    del primitive["attributes"][f"{SPLATS}:ROTATION"]
    path = buffer.write(tmp_path / "a.gltf", primitive)
    with pytest.raises(InputError, match=f"{SPLATS}:ROTATION: the attribute is missing"):
        load_mesh(path)


def test_the_source_is_made_of_splats(tmp_path: Path, context: Any) -> None:
    buffer = Buffer()
    path = buffer.write(tmp_path / "a.gltf", primitive_of(buffer, splat_table(50)))
    source: Any = prepare_content(ContentSettings(scene=str(path)), STACK)(context=context)
    assert isinstance(getattr(source, "_source", source), SplatSource)
    source.close()
