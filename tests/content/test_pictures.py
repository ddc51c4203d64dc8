"""Tests which view of a picture, folder or video an eye gets, where it appears, and how it ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from runtime.config import ContentSettings
from runtime.content.base import ContentSource
from runtime.content.frames import Video
from runtime.content.images import WarpedPicture, plane_from_pixels, rgba_from_rgb
from runtime.content.pictures import PicturesSource
from runtime.content.placing import SceneFile
from runtime.errors import ContentFailure, InputError
from runtime.optics.views import image_from_raster, image_from_stack
from runtime.support.artifacts import write_png
from tests.calls import refusal
from tests.content.conftest import STACK, panel_view
from tests.content.picture_files import make_video

RED, GREEN, BLUE = (255, 0, 0), (0, 255, 0), (0, 0, 255)
EYES = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))


def solid(colour: tuple[int, int, int], width: int = 160, height: int = 90) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def centre(source: ContentSource, side: int, time_ns: int = 0, eye: Any = None) -> list[int]:
    picture = source.render(panel_view(EYES[side] if eye is None else eye, STACK.panel(1), side=side), time_ns=time_ns)
    return picture[STACK.height_px // 2, STACK.width_px // 2, :3].tolist()


@pytest.mark.parametrize(("name", "axis"), [("a_sbs.png", 1), ("a_tb.png", 0)])
def test_each_eye_gets_its_half(tmp_path: Path, opened: Any, name: str, axis: int) -> None:
    write_png(tmp_path / name, np.concatenate([solid(RED), solid(BLUE)], axis=axis))
    source = opened(tmp_path / name)
    assert centre(source, 0) == list(RED)
    assert centre(source, 1) == list(BLUE)
    assert not source.info.moving


def test_a_plain_picture_lies_in_the_middle_plane_for_both_eyes(tmp_path: Path, opened: Any) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (90, 160, 3), np.uint8)
    picture = np.clip((cv2.GaussianBlur(noise, (0, 0), 3).astype(float) - 128) * 4 + 128, 0, 255).astype(np.uint8)
    write_png(tmp_path / "a.png", picture)
    source = opened(tmp_path / "a.png")
    left, right = (source.render(panel_view(EYES[side], STACK.panel(1), side=side), time_ns=0) for side in (0, 1))
    assert (left == right).all()
    assert source.info.flat_x_m == 0.0
    back = cv2.resize(left, (160, 90), interpolation=cv2.INTER_AREA)[..., :3].astype(int)
    # The display is a little wider than the picture's shape: 0.4 of a column each side.
    assert np.abs(back[20:-20, 20:-20] - picture[20:-20, 20:-20]).mean() < 4


def test_a_narrow_picture_has_the_background_beside_it(tmp_path: Path, drawn: Any) -> None:
    write_png(tmp_path / "a.png", solid(GREEN, 90, 90))
    picture = drawn(tmp_path / "a.png", EYES[0])
    assert picture[135, 20].tolist() == [31, 31, 31, 0]
    assert picture[135, 240].tolist() == [0, 255, 0, 255]


def test_a_quilt_gives_each_eye_the_view_nearest_in_angle(tmp_path: Path, opened: Any) -> None:
    """Views run from the bottom left, rightwards, upwards; their grey levels identify them."""
    views = [solid((10 * index, 0, 0), 32, 18) for index in range(15)]
    rows = [np.concatenate(views[row * 5 : row * 5 + 5], axis=1) for row in range(3)]
    path = tmp_path / "a_qs5x3a1.78.png"
    write_png(path, np.concatenate(rows[::-1], axis=0))
    source = opened(path, cone_deg=70.0)
    for degrees in (-35, -20, 0, 5, 30, 50):
        eye = 0.6 * np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0])
        expected = round(np.clip(degrees / 70 + 0.5, 0, 1) * 14)
        assert centre(source, 0, eye=eye)[0] == 10 * expected


def test_a_folder_of_pictures_plays_and_repeats(tmp_path: Path, opened: Any) -> None:
    for index, colour in enumerate((RED, GREEN, BLUE)):
        write_png(tmp_path / f"{index:03}.png", solid(colour))
    source = opened(tmp_path, picture_rate_hz=10.0)
    seen = [centre(source, 0, time_ns=tenth * 10**8) for tenth in range(4)]
    assert seen == [list(RED), list(GREEN), list(BLUE), list(RED)]
    assert source.info.moving
    assert source.revision(time_ns=0) == source.revision(time_ns=99_000_000) != source.revision(time_ns=10**8)


def test_a_video_that_ends_repeats(tmp_path: Path, opened: Any) -> None:
    source = opened(make_video(tmp_path / "a.avi", [RED, GREEN, BLUE]))
    seen = [centre(source, 0, time_ns=tenth * 10**8) for tenth in (0, 1, 2, 3)]
    for found, wanted in zip(seen, (RED, GREEN, BLUE, RED), strict=True):
        assert np.abs(np.array(found) - wanted).max() < 12


def test_a_truncated_video_is_a_failure_that_passes(tmp_path: Path) -> None:
    path = make_video(tmp_path / "a.avi", [RED] * 40)
    declared = Video(path, ContentSettings(), np.arange(401) * 10**8)  # as a damaged container would say
    source = PicturesSource(declared, file=SceneFile(path, ContentSettings(), STACK))
    with pytest.raises(ContentFailure, match=r"a.avi: frame 300"):
        source.render(panel_view(EYES[0], STACK.panel(1)), time_ns=30 * 10**9)
    assert np.abs(np.array(centre(source, 0, time_ns=0)) - RED).max() < 12


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("a_sbs.png", "layout: a picture of 1 x 1 pixels cannot contain 2 x 1 views"),
        ("a_tb.png", "layout: a picture of 1 x 1 pixels cannot contain 1 x 2 views"),
        ("a_qs2x3.png", "layout: a picture of 1 x 1 pixels cannot contain 2 x 3 views"),
        ("a_qs0x3.png", "layout: a quilt cannot have 0 x 3 views"),
        ("a_rgbd.png", "layout: the picture is too small"),
    ],
)
def test_a_picture_too_small_for_its_views_is_one_line(tmp_path: Path, opened: Any, name: str, told: str) -> None:
    write_png(tmp_path / name, solid(RED, 1, 1))
    assert refusal(opened, tmp_path / name).startswith(f"{tmp_path / name}: {told}")


@pytest.mark.parametrize("name", ["a.mp4", "a.avi"])
def test_a_truncated_film_gives_one_line_and_silent_decoders(
    tmp_path: Path, opened: Any, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    make_video(path, [RED] * 12, codec="mp4v" if name.endswith("4") else "MJPG")
    data = path.read_bytes()
    path.write_bytes(data[: 300 if name.endswith(".avi") else len(data) // 2])
    capfd.readouterr()
    with pytest.raises(InputError, match=rf"{name}: cannot be decoded as a film"):
        opened(path)
    assert capfd.readouterr().err == ""


def rgbd_picture() -> np.ndarray:
    """A green square that is near, on a red ground that is far."""
    colour, depth = solid(RED, 320, 180), np.zeros((180, 320, 3), np.uint8)
    colour[60:120, 130:190] = GREEN
    depth[60:120, 130:190] = 255
    return np.concatenate([colour, depth], axis=1)


def test_an_rgbd_picture_has_parallax_of_the_right_size(tmp_path: Path, drawn: Any) -> None:
    write_png(tmp_path / "a_rgbd.png", rgbd_picture())
    middles = []
    for eye in EYES:
        picture = drawn(tmp_path / "a_rgbd.png", eye, depth_m=(-0.05, 0.05))
        columns = np.nonzero((picture[..., 1] > 200) & (picture[..., 0] < 50))[1]
        middles.append(columns.mean())
    # A point at x is seen on the centre plane shifted by -eye_y·x/(eye_x - x).
    expected = -0.06 * 0.05 / (0.6 - 0.05) / (STACK.width_m / STACK.width_px)
    assert middles[1] - middles[0] == pytest.approx(expected, abs=0.5)


def test_an_rgbd_picture_without_depth_is_told(tmp_path: Path, opened: Any) -> None:
    write_png(tmp_path / "a_rgbd.png", np.concatenate([solid(RED), solid(BLUE)], axis=1))
    with pytest.raises(InputError, match=r"a_rgbd.png: layout: the right half is not a grey depth map"):
        opened(tmp_path / "a_rgbd.png")


def size_of(picture: np.ndarray) -> tuple[int, int]:
    """Columns and rows that are covered."""
    rows, columns = np.nonzero(picture[..., 3] > 127)
    return int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1


@pytest.mark.parametrize(
    ("name", "size", "aspect"),
    [
        ("a_sbs.png", (200, 50), 2.0),
        ("a_hsbs.png", (200, 50), 4.0),
        ("a_half_sbs.png", (100, 100), 1.0),
        ("a_htb.png", (100, 100), 1.0),
        ("a_tb.png", (100, 100), 2.0),
        ("a_qs4x2.png", (200, 200), 0.5),
        ("a_qs4x2a0.75.png", (200, 200), 0.75),
        ("a_qs4x2a1.5.png", (200, 200), 1.5),
    ],
)
def test_halves_and_quilts_have_the_shape_that_their_name_tells(
    tmp_path: Path, drawn: Any, name: str, size: tuple[int, int], aspect: float
) -> None:
    write_png(tmp_path / name, solid(GREEN, *size))
    columns, rows = size_of(drawn(tmp_path / name, EYES[0]))
    assert columns / rows == pytest.approx(aspect, rel=0.03)


@pytest.mark.parametrize("blur", [0, 3])
@pytest.mark.parametrize("eye", [(0.6, -0.12, 0.05), (0.6, 0.12, -0.05)])
def test_beside_an_edge_there_is_no_hole_and_no_stretched_foreground(
    tmp_path: Path, drawn: Any, blur: int, eye: tuple[float, float, float]
) -> None:
    """A green square before a blue ground, its edges mixed in colour and depth: only these two colours are seen."""
    colour, depth = solid(BLUE, 320, 180), np.zeros((180, 320, 3), np.uint8)
    colour[60:120, 130:190] = GREEN
    depth[60:120, 130:190] = 255
    if blur:
        colour, depth = (cv2.blur(picture, (blur, blur)) for picture in (colour, depth))
    write_png(tmp_path / "a_rgbd.png", np.concatenate([colour, depth], axis=1))
    picture = drawn(tmp_path / "a_rgbd.png", eye, depth_m=(-0.05, 0.05))[40:230, 80:400].astype(int)
    assert (picture[..., 3] == 255).all()
    green = picture[..., 1] > 200
    ground = (picture[..., 2] > 200) & (picture[..., 1] < 40)
    assert (green | ground).mean() > 0.985  # except for the outline's smoothing
    expected = (60 * 480 / 320) ** 2  # 0.55 m from the eye it is drawn as large as it was from 0.6
    assert green.sum() == pytest.approx(expected, rel=0.08)


def test_a_thin_thing_of_an_rgbd_picture_keeps_its_colour(tmp_path: Path, drawn: Any) -> None:
    """It has no inside from which colours could be taken; a square of its depth is not it."""
    colour, depth = solid(BLUE, 320, 180), np.zeros((180, 320, 3), np.uint8)
    for columns, found in ((slice(80, 84), GREEN), (slice(200, 260), RED)):
        colour[60:120, columns], depth[60:120, columns] = found, 255
    write_png(tmp_path / "a_rgbd.png", np.concatenate([colour, depth], axis=1))
    picture = drawn(tmp_path / "a_rgbd.png", EYES[0])
    red, green, blue, _ = picture.astype(int).transpose(2, 0, 1)
    assert ((green > blue) & (red < 60)).sum() == pytest.approx(4 * 60 * 1.5**2, rel=0.2)


def test_a_picture_much_larger_than_the_raster_is_averaged() -> None:
    lines = np.zeros((1080, 1920, 3), np.uint8)
    lines[:, ::2] = 255
    view = panel_view((0.7, -0.03, 0.1), STACK.panel(1))
    plane = STACK.panel(1)
    projection = image_from_stack(view.eye_m, width_px=1920, height_px=1080, fov_deg=60)
    matrix = image_from_raster(projection, plane) @ plane_from_pixels(view.pixels_from_stack, plane)
    picture = WarpedPicture(rgba_from_rgb(lines), background=(1.0, 1.0, 1.0)).warped(matrix, view)
    inner = picture[60:-60, 60:-60, 0].astype(int)
    assert np.abs(inner - 128).max() < 32
