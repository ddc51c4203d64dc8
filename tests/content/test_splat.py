"""Compares splats with an exact renderer of the same equations, and reads files of other programs."""

from __future__ import annotations

import gzip
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.lib.recfunctions as rfn
import pytest
from plyfile import PlyData, PlyElement

from runtime.config import ContentSettings
from runtime.content import splat
from runtime.content.base import ContentInfo
from runtime.content.compressed_splats import load_compressed, load_compressed_splats, load_splat
from runtime.content.gaussians import Gaussians, harmonic_basis, load_gaussians
from runtime.content.placing import SceneFile
from runtime.content.ply import read_header
from runtime.content.registry import prepare_content
from runtime.content.splat import SplatSource, prepare
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from tests.calls import refusal
from tests.content.conftest import STACK, image_view, panel_view
from tests.content.packed_splat_files import write_compressed, write_sog, write_splat, write_spz
from tests.content.splat_reference import harmonics, render

COUNT = 400


def splat_table(count: int = COUNT, degree: int = 3, seed: int = 0) -> np.ndarray:
    """Random splats in a box of 2 x 4 x 2.4 units, as the reference implementation's file has them."""
    random = np.random.default_rng(seed)
    rest = 3 * ((degree + 1) ** 2 - 1)
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(rest))]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    table = np.zeros(count, dtype=[(name, "f4") for name in names])
    for name, half in (("x", 1.0), ("y", 2.0), ("z", 1.2)):
        table[name] = random.uniform(-half, half, count)
    for name in names[6:9]:
        table[name] = random.uniform(-1.5, 1.5, count)
    for name in names[9 : 9 + rest]:
        table[name] = random.normal(0, 0.15, count)
    table["opacity"] = random.normal(1.0, 2.0, count)
    for axis in range(3):
        table[f"scale_{axis}"] = random.normal(-2.6, 0.5, count)
    for axis in range(4):
        table[f"rot_{axis}"] = random.normal(0, 1, count)
    return table


def written(folder: Path, table: np.ndarray, name: str = "scene.ply") -> Path:
    path = folder / name
    PlyData([PlyElement.describe(table, "vertex")]).write(path)
    return path


def loaded(path: Path) -> Gaussians:
    return load_gaussians(read_header(path))


def placed(path: Path, context: Any, **settings: Any) -> tuple[SplatSource, np.ndarray]:
    gaussians = loaded(path)
    low, high = gaussians.centres.min(0).astype(float), gaussians.centres.max(0).astype(float)
    matrix = SceneFile(path, ContentSettings(**settings), STACK).placed(low, high)
    info = ContentInfo("a", background=(1.0, 0.9, 0.8))
    return SplatSource(gaussians, stack_from_scene=matrix, context=context, info=info), matrix


def exact(table: np.ndarray, matrix: np.ndarray, view: Any) -> np.ndarray:
    def columns(*names: str) -> np.ndarray:
        return np.column_stack([table[name] for name in names]).astype(np.float64)

    rest = sorted((name for name in table.dtype.names or () if name.startswith("f_rest")), key=lambda n: int(n[7:]))
    first = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    higher = columns(*rest).reshape(len(table), 3, -1).transpose(0, 2, 1) if rest else first[:, :0]
    quaternions = columns("rot_0", "rot_1", "rot_2", "rot_3")
    return render(
        columns("x", "y", "z"),
        np.exp(columns("scale_0", "scale_1", "scale_2")),
        quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True),
        1 / (1 + np.exp(-table["opacity"].astype(np.float64))),
        np.concatenate([first, higher], axis=1),
        stack_from_scene=matrix,
        projection=view.pixels_from_stack,
        eye=view.eye_m,
        width=view.width_px,
        height=view.height_px,
        background=(1.0, 0.9, 0.8),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("eye", [(0.6, 0.03, 0.1), (0.3, 0.5, -0.1)], ids=["ahead", "60 degrees off"])
def test_the_picture_agrees_with_an_exact_renderer_of_the_same_equations(
    tmp_path: Path, context: Any, degree: int, eye: tuple[float, ...]
) -> None:
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 160, 90)
    table = splat_table(degree=degree)
    source, matrix = placed(written(tmp_path, table), context, depth_m=(-0.1, 0.1))
    for view in (panel_view(eye, stack.panel(1)), image_view(eye, 160, 90, fov_deg=50)):
        picture = source.render(view, time_ns=0)
        wanted = np.clip(exact(table, matrix, view), 0, 1)
        assert wanted.std() > 0.05
        error = (picture[..., :3] / 255 - wanted) ** 2
        assert -10 * np.log10(error.mean()) > 40


def test_many_splats_deep_agree_with_the_exact_renderer_for_both_eyes(tmp_path: Path, context: Any) -> None:
    """Tens of layers a pixel: what rounding, cut-offs and the order of sorting add up to."""
    stack = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 320, 180)
    table = splat_table(2000)
    for axis in range(3):
        table[f"scale_{axis}"] = np.random.default_rng(axis).normal(-3.1, 0.6, 2000)
    source, matrix = placed(written(tmp_path, table), context, depth_m=(-0.1, 0.1))
    for side, eye in enumerate(((0.6, -0.03, 0.05), (0.6, 0.03, 0.05))):
        view = panel_view(eye, stack.panel(1), side=side)
        error = source.render(view, time_ns=0)[..., :3] / 255 - np.clip(exact(table, matrix, view), 0, 1)
        assert -10 * np.log10((error**2).mean()) > 40
        assert np.abs(error.mean()) < 0.5 / 255


def test_the_harmonics_are_the_textbook_s() -> None:
    for direction in np.random.default_rng(1).normal(size=(20, 3)):
        direction /= np.linalg.norm(direction)
        ours = harmonic_basis(direction[None].astype(np.float32), 16)[0]
        assert ours == pytest.approx(harmonics(direction, 16), abs=1e-5)


@pytest.mark.parametrize("name", ["x", "f_dc_1", "opacity", "scale_2", "rot_3"])
def test_a_missing_property_is_told(tmp_path: Path, name: str) -> None:
    table = splat_table(50)
    table = rfn.repack_fields(table[[other for other in table.dtype.names or () if other != name]])
    with pytest.raises(InputError, match=rf"scene.ply: {name}: the property is missing"):
        loaded(written(tmp_path, table))


@pytest.mark.parametrize(
    ("names", "value"),
    [
        ("scale_1", 60.0),
        ("scale_1", np.inf),
        ("scale_2", np.nan),
        ("x", np.nan),
        ("y", np.inf),
        ("z", 1e30),
        ("rot_2", np.nan),
        ("rot_0 rot_1 rot_2 rot_3", 0.0),
        ("opacity", np.nan),
        ("f_rest_40", np.nan),
    ],
)
def test_an_unusable_splat_is_left_out_and_a_line_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, names: str, value: float
) -> None:
    table, path = splat_table(50), tmp_path / "scene.ply"
    kept = loaded(written(tmp_path, np.delete(table, 7)))
    for name in names.split():
        table[name][7] = value
    found = loaded(written(tmp_path, table))
    assert f"{path}: ignoring 1 of 50 splats because they are not usable" in caplog.text
    for name in ("centres", "covariances", "opacities", "harmonics"):
        assert np.array_equal(getattr(found, name), getattr(kept, name))


def test_a_file_without_a_usable_splat_is_refused(tmp_path: Path) -> None:
    table = splat_table(50)
    table["x"] = np.nan
    with pytest.raises(InputError, match="opacity: no splat is visible"):
        loaded(written(tmp_path, table))


def test_nothing_of_a_large_splat_is_cut_off(tmp_path: Path, context: Any) -> None:
    """Its centre alone says nothing of how far it reaches."""
    table = splat_table(3, degree=0)
    for axis in range(3):
        table["xyz"[axis]] = [-0.1, 0.0, 0.1]
        table[f"scale_{axis}"] = np.log(1.0)
    table["opacity"] = 4.0
    path = written(tmp_path, table)
    source = prepare(SceneFile(path, ContentSettings(), STACK))(context=context)
    covered = source.render(panel_view((0.6, 0.0, 0.0), STACK.panel(1)), time_ns=0)[..., 3]
    assert covered[135, 240] > 200
    assert max(covered[0].max(), covered[-1].max(), covered[:, 0].max(), covered[:, -1].max()) < 40


def test_splats_stand_as_cameras_see_them(tmp_path: Path, context: Any) -> None:
    """Trainers have y down and z away from the camera: a red splat at -y is above."""
    table = splat_table(2, degree=0)
    for name in ("x", "y", "z"):
        table[name] = 0.0
    table["y"] = [-1.0, 1.0]
    for axis in range(3):
        table[f"scale_{axis}"] = np.log(0.2)
        table[f"f_dc_{axis}"] = [1.5 if axis == 0 else -1.5, 1.5 if axis == 2 else -1.5]
    table["opacity"] = 4.0
    source = prepare(SceneFile(written(tmp_path, table), ContentSettings(), STACK))(context=context)
    picture = source.render(panel_view((0.6, 0.0, 0.0), STACK.panel(1)), time_ns=0)
    assert picture[:135, 240, :3].max(0).argmax() == 0 and picture[135:, 240, :3].max(0).argmax() == 2


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_every_ply_format_gives_the_same_splats(tmp_path: Path, order: str, kind: str) -> None:
    table = splat_table(30).astype([(name, kind) for name in splat_table(1).dtype.names or ()])
    element = PlyElement.describe(table, "vertex")
    path = tmp_path / "scene.ply"
    PlyData([element], byte_order=order, comments=["made here"]).write(path)
    wanted, found = loaded(written(tmp_path, splat_table(30), "plain.ply")), loaded(path)
    for name in ("centres", "covariances", "opacities", "harmonics"):
        assert getattr(found, name) == pytest.approx(getattr(wanted, name), rel=1e-4, abs=1e-6)


FORMS = ["compressed", "compressed with harmonics", "splat", "spz 1", "spz 2 with harmonics", "spz 3 with harmonics"]
FORMS += ["spz 2 unzipped", "spz 4", "spz 4 with harmonics", "sog", "sog folder with harmonics"]


@pytest.mark.parametrize("form", FORMS)
def test_packed_splats_are_those_that_were_packed(tmp_path: Path, form: str) -> None:
    """To what so few bits hold: places to 1/1000 of a chunk, turns to a hundredth, colours to their code."""
    table = splat_table(600, degree=2 if "harmonics" in form else 0)
    if form == "splat":
        found = load_splat(write_splat(tmp_path / "a.splat", table))
    elif form.startswith("spz"):
        path = write_spz(tmp_path / "a.spz", table, version=int(form[4]))
        if "unzipped" in form:
            path.write_bytes(gzip.decompress(path.read_bytes()))
        found = load_compressed_splats(path)
    elif form.startswith("sog"):
        found = load_compressed_splats(write_sog(tmp_path / ("a" if "folder" in form else "a.sog"), table))
    else:
        path = write_compressed(tmp_path / "a.ply", table, harmonics="harmonics" in form)
        found = load_compressed(read_header(path))
    wanted = loaded(written(tmp_path, table))
    assert found.centres == pytest.approx(wanted.centres, abs=4 / 1000)
    size = wanted.covariances[:, [0, 3, 5]].sum(1, keepdims=True)
    assert (np.abs(found.covariances - wanted.covariances) / size).max() < (
        0.12 if "spz" in form else 0.04
    )  # its scales are in steps of 6 %
    assert found.opacities == pytest.approx(wanted.opacities, abs=0.6 / 255)
    assert found.harmonics.shape == wanted.harmonics.shape
    assert found.harmonics == pytest.approx(wanted.harmonics, abs=0.02)


def test_a_compressed_file_stands_by_its_format_s_custom(tmp_path: Path) -> None:
    """SPZ has y up, SOG y down as trainers write it."""
    table = splat_table(50, 0)
    ups = []
    for path in (write_spz(tmp_path / "a.spz", table, version=3), write_sog(tmp_path / "a.sog", table)):
        opener = prepare(SceneFile(path, ContentSettings(scene=str(path)), STACK))
        ups.append(opener.keywords["stack_from_scene"][2, 1])  # type: ignore[attr-defined]
    assert ups[0] > 0 > ups[1]


@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("a.spz", lambda data: data[: len(data) // 2], "is truncated; the header declares 600 splats"),
        ("a.spz", lambda data: gzip.decompress(data)[:-1], "is truncated; the header declares 600 splats"),
        ("a.spz", lambda _: b"NGSP\4\0\0\0\1\0\0\0\0\x0c\0\5\0\0\0\1" + bytes(12), "is damaged or is not an SPZ file"),
        ("a.spz", lambda data: gzip.compress(b"NGSP" + bytes(40)), "is not an SPZ file of version 1 to 4"),
        ("a.sog", lambda data: data[:400], "is damaged or is not a SOG file"),
        ("a.sog", lambda data: data.replace(b'"version": 2', b'"version": 3'), "is damaged or is not a SOG file"),
        ("a.splat", lambda data: data[:-1], "is truncated or is not a .splat: its size must be a multiple of 32, not"),
        ("a.splat", lambda data: b"", "is truncated or is not a .splat: its size must be"),
        ("a.ply", lambda data: data[:-1], "vertex: the file is truncated: only 599 of the 600"),
        ("a.ply", lambda data: data.replace(b"element chunk", b"element chumk"), "chunk: is missing"),
    ],
)
def test_a_broken_packed_file_is_one_line(tmp_path: Path, name: str, change: Any, told: str) -> None:
    write = {".splat": write_splat, ".ply": write_compressed, ".spz": partial(write_spz, version=2), ".sog": write_sog}
    path = write[name[1:]](tmp_path / name, splat_table(600, degree=0))
    path.write_bytes(change(path.read_bytes()))
    assert refusal(prepare_content, ContentSettings(scene=str(path)), STACK).startswith(f"{path}: {told}")


def edited(folder: Path, old: bytes, new: bytes, cut: int = 0) -> Path:
    """A good file with one thing in it changed."""
    path = written(folder, splat_table(20))
    data = path.read_bytes().replace(old, new, 1)
    path.write_bytes(data[: len(data) - cut])
    return path


@pytest.mark.parametrize(
    ("old", "new", "cut", "told"),
    [
        (b"", b"", 100, "vertex: the file is truncated: only 19 of the 20 declared elements are present"),
        (b"vertex 20", b"vertex 2999999", 0, "element vertex: the file is truncated"),
        (b"vertex 20", b"vertex 3000001", 0, "element vertex: 3,000,001 exceeds the limit of 3,000,000"),
        (b"vertex 20", b"vertex 0", 0, "vertex: the file contains no splats"),
        (b"element vertex", b"element corner", 0, "vertex: the header lacks a format or vertices"),
        (b"property float x", b"property list uchar float x", 0, "vertex: must precede every element with lists"),
        (b"property float nx", b"property float x", 0, "vertex: the header lacks a format or vertices, or declares"),
        (b"property float nx", b"property words nx", 0, "header: this line is not valid PLY: property words nx"),
        (b"end_header", b"comment", 0, "header: the PLY header is incomplete"),
        (b"format binary_little_endian 1.0\n", b"", 0, "vertex: the header lacks a format"),
        (b"format binary_little_endian", b"format ascii", 0, "format: is ascii"),
    ],
)
def test_a_broken_file_is_one_line(tmp_path: Path, old: bytes, new: bytes, cut: int, told: str) -> None:
    path = edited(tmp_path, old, new, cut)
    assert refusal(loaded, path).startswith(f"{path}: {told}")


def test_splats_drawn_a_few_at_a_time_are_those_drawn_together(
    tmp_path: Path, context: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, pictures = written(tmp_path, splat_table(50)), []
    for at_once in (1000, 7):
        monkeypatch.setattr(splat, "AT_ONCE", at_once)
        source = prepare_content(ContentSettings(scene=str(path)), STACK)(context=context)
        pictures.append(source.render(panel_view([0.6, 0.03, 0.0], STACK.panel(1)), time_ns=0).copy())
        source.close()
    assert np.array_equal(*pictures) and np.ptp(pictures[0][..., :3]) > 20


def test_splats_behind_the_eye_or_beside_the_raster_draw_nothing(tmp_path: Path, context: Any) -> None:
    table = splat_table(50)
    source, _ = placed(written(tmp_path, table), context)
    picture = source.render(panel_view((-1.0, 0.0, 0.0), STACK.panel(1)), time_ns=0)
    assert (picture[..., 3] == 0).all()
