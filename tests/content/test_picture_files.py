"""Tests views, colours, animations and refusals of picture files."""

from __future__ import annotations

import io
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.config import ContentSettings
from runtime.content.frames import open_frames, read_pair
from runtime.content.layout import layout_of
from runtime.errors import InputError
from runtime.records import U8
from runtime.support.artifacts import write_png
from runtime.support.picture_file import read_image, read_views
from runtime.support.untrusted_input import LIMITS
from tests.content.conftest import STACK, panel_view
from tests.content.picture_files import DISPARITY, THUMBNAIL, UNDEFINED, heic_pair, make_video, mpo, swapped_profile
from tests.content.test_pictures import BLUE, EYES, GREEN, RED, centre, solid

AUTO = ContentSettings()


def near(found: Any, wanted: tuple[int, int, int], *, by: int = 12) -> bool:
    return bool(np.abs(np.array(found, int) - wanted).max() <= by)


def shown(opened: Any, path: Path, **settings: Any) -> list[list[int]]:
    """Colours at the centre of both eyes' views."""
    source = opened(path, **settings)
    return [centre(source, side) for side in (0, 1)]


def views(path: Path, **settings: Any) -> list[U8]:
    frames = open_frames(path, ContentSettings(**settings))
    return frames.layout(0).views(frames.frame(0))


# Two views in one file


def test_the_two_pictures_of_an_mpo_are_the_eyes(tmp_path: Path, opened: Any) -> None:
    path = mpo(tmp_path / "a.mpo", solid(RED), solid(BLUE))
    left, right = shown(opened, path)
    assert near(left, RED) and near(right, BLUE)
    assert opened(path).info.flat_x_m is None
    assert [near(picture[5, 5], colour) for picture, colour in zip(read_pair(path, AUTO), (RED, BLUE), strict=True)]


def test_an_mpo_can_be_shown_flat_and_cross_eyed(tmp_path: Path, opened: Any) -> None:
    path = mpo(tmp_path / "a.mpo", solid(RED), solid(BLUE))
    assert all(near(seen, RED) for seen in shown(opened, path, layout="mono"))
    left, right = shown(opened, path, layout="cross-eyed")
    assert near(left, BLUE) and near(right, RED)


@pytest.mark.parametrize(
    ("name", "size", "kind", "note", "count"),
    [
        ("a.jpg", (160, 90), DISPARITY, b"", 2),  # some cameras call it so
        ("a.mpo", (160, 90), UNDEFINED, b"", 2),
        ("a.jpg", (160, 90), UNDEFINED, b"", 1),
        ("a.mpo", (160, 90), UNDEFINED, b'http://ns.adobe.com/xap/1.0/\0hdrgm:Version="1.0"', 1),
        ("a.mpo", (160, 90), THUMBNAIL, b"", 1),
        ("a.mpo", (80, 45), DISPARITY, b"", 1),
    ],
)
def test_a_second_picture_that_is_no_eye_s_is_not_shown(
    tmp_path: Path, name: str, size: tuple[int, int], kind: int, note: bytes, count: int
) -> None:
    path = mpo(tmp_path / name, solid(RED), solid(BLUE, *size), kind=kind, note=note)
    assert len(read_views(path)) == len(views(path)) == count


def test_an_mpo_without_its_second_picture_is_shown_flat_and_says_so(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = mpo(tmp_path / "a.mpo", solid(RED), solid(BLUE)).read_bytes()
    (tmp_path / "a.mpo").write_bytes(data[: data.index(b"\xff\xd8\xff", 3)])
    assert len(views(tmp_path / "a.mpo")) == 1
    assert "a.mpo: the second picture is missing" in caplog.text


@pytest.mark.parametrize(
    ("group", "colours"), [((0, 1), (RED, BLUE)), ((1, 0), (BLUE, RED)), ((0, 2), (RED,)), ((), (RED,))]
)
def test_a_stereo_pair_in_a_heic_is_the_eyes(tmp_path: Path, group: tuple[int, int], colours: Any) -> None:
    pictures = [solid(RED), solid(BLUE), solid(GREEN, 80, 46)]
    found = views(heic_pair(tmp_path / "a.heic", pictures, group=group))
    assert [near(view[40, 40], colour) for view, colour in zip(found, colours, strict=True)]


# Names


@pytest.mark.parametrize(
    ("layout", "names"),
    [
        ("side-by-side", "film-sbs.png film.sbs.png a_LR.jpg a.left-right.png a_2x1.png a_3dh.mp4 a_sbs_1080p.mkv"),
        ("half-side-by-side", "Film.2012.3D.HSBS.1080p.mkv a.H-SBS.x264-GRP.mkv a_half_sbs.png a_hsbs(2).png"),
        ("top-bottom", "a_TaB.png a.top-bottom.png a_tb.png a_ou.png a_tb_4k.mp4 Film.3D.OverUnder.mkv"),
        ("half-top-bottom", "a_htb.png a_hou.png Film.3D.Half-OU.BluRay.mkv a_half_tb.png"),
        ("cross-eyed", "a.jps a.pns a_RL.png a.cross-eyed.jpg a_crosseye.png"),
        ("anaglyph", "a_anaglyph.jpg"),
        ("rgbd", "a_rgbd.png"),
        ("mono", "cat_ou_house.jpg faqs12x3.png tab_bar.png a_xsbs.png mr_hou_house.jpg lr_photo.jpg album.png"),
        ("qs8x6a.75", "a_qs8x6a0.75.png a_qs8x6a.75.png"),
        ("qs8x6a0.75", "qs8x6a0.75.png x_qs8x6a0.75(1).png"),
    ],
)
def test_a_name_tells_the_layout(layout: str, names: str) -> None:
    wanted = layout_of(Path("a.png"), ContentSettings(layout=layout))
    assert {name: layout_of(Path(name), AUTO) for name in names.split()} == dict.fromkeys(names.split(), wanted)


def test_a_cross_eyed_picture_and_an_anaglyph_reach_the_eyes(tmp_path: Path, opened: Any) -> None:
    Image.fromarray(np.concatenate([solid(RED), solid(BLUE)], axis=1)).save(tmp_path / "a.jps", "JPEG")
    left, right = shown(opened, tmp_path / "a.jps")
    assert near(left, BLUE) and near(right, RED)
    write_png(tmp_path / "a_anaglyph.png", solid((200, 40, 40)))
    assert shown(opened, tmp_path / "a_anaglyph.png") == [[200] * 3, [40] * 3]


@pytest.mark.parametrize(
    ("told", "layout"),
    [
        ((0, 4, 2, 1), "side-by-side"),
        ((0, 0, 2, 1), "cross-eyed"),
        ((0, 6, 2, 1), "half-side-by-side"),
        ((0, 5, 3, 1), "half-top-bottom"),
        ((0, 4, 4, 1), "anaglyph"),
        ((0, 4, 2, 0), "cross-eyed"),
    ],
)
def test_a_stereo_header_states_the_layout(tmp_path: Path, told: tuple[int, ...], layout: str) -> None:
    """Separation, flags, layout and kind of picture; a picture that is not stereo leaves it to the name."""
    file = io.BytesIO()
    Image.new("RGB", (32, 16)).save(file, "JPEG")
    segment = b"_JPSJPS_" + bytes([0, 4, *told, 0, 0])
    data = file.getvalue()
    (tmp_path / "a.jps").write_bytes(data[:2] + b"\xff\xe3" + struct.pack(">H", len(segment) + 2) + segment + data[2:])
    assert open_frames(tmp_path / "a.jps", AUTO).layouts == [layout_of(Path("a"), ContentSettings(layout=layout))]


@pytest.mark.parametrize(
    ("name", "size", "is_half"),
    [
        ("a_sbs.avi", (192, 108), True),
        ("a_sbs.avi", (384, 108), False),
        ("a_full_sbs.avi", (192, 108), False),
        ("a_tb.avi", (192, 108), True),
        ("a_tb.avi", (96, 108), False),
        ("a.avi", (192, 108), False),
    ],
)
def test_a_film_as_wide_as_one_view_holds_two_squeezed_ones(
    tmp_path: Path, name: str, size: tuple[int, int], is_half: bool
) -> None:
    make_video(tmp_path / name, [(90,) * 3], size)
    assert open_frames(tmp_path / name, AUTO).layouts[0].half == is_half


@pytest.mark.parametrize("axis", [0, 1])
def test_a_picture_whose_halves_nearly_agree_gets_a_hint(
    tmp_path: Path, axis: int, caplog: pytest.LogCaptureFixture
) -> None:
    from skimage.data import astronaut, chelsea

    picture = astronaut()
    pair = [np.roll(picture, shift, axis=1) for shift in (0, 12)]
    write_png(tmp_path / "a.png", np.concatenate(pair, axis=axis))
    for number, other in enumerate((picture, chelsea(), np.concatenate([picture, picture[:, ::-1]], axis=axis))):
        write_png(tmp_path / f"other{number}.png", other)
        open_frames(tmp_path / f"other{number}.png", AUTO)
    assert caplog.text == ""
    open_frames(tmp_path / "a.png", AUTO)
    assert f"--layout {['top-bottom', 'side-by-side'][axis]}" in caplog.text


def test_a_picture_called_a_quilt_without_its_numbers_gets_a_hint(tmp_path: Path, caplog: Any) -> None:
    for name in ("my-Quilt.png", "quilt_qs2x2.png"):
        write_png(tmp_path / name, solid(RED))
        open_frames(tmp_path / name, AUTO)
    assert (
        caplog.text.count("if this picture is a quilt, pass --layout qs8x6a0.75") == 1 and "my-Quilt.png" in caplog.text
    )


# All around


def test_a_picture_all_around_is_refused_by_its_metadata_and_shape(tmp_path: Path) -> None:
    xmp = (
        b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><GPano:ProjectionType>equirectangular</GPano:ProjectionType></x:xmpmeta>'
    )
    path = tmp_path / "a.jpg"
    for size in ((160, 80), (80, 80), (320, 80)):
        Image.fromarray(solid(RED, *size)).save(path, xmp=xmp)
        with pytest.raises(InputError, match=r"a\.jpg: shows all directions .*; crop it"):
            open_frames(path, AUTO)
    Image.fromarray(solid(RED, 240, 80)).save(path, xmp=xmp)  # a phone's panorama
    assert views(path)[0].shape == (80, 240, 3)
    Image.fromarray(solid(RED, 160, 80)).save(tmp_path / "a_360.jpg")
    assert views(tmp_path / "a_360.jpg")[0].shape == (80, 160, 3)
    Image.fromarray(solid(RED, 160, 80)).save(path, xmp=xmp)
    assert open_frames(tmp_path, AUTO).count == 1


# Sets of pictures with cameras


def test_a_camera_set_is_called_so_as_file_and_folder(tmp_path: Path, opened: Any) -> None:
    (tmp_path / "transforms_train.json").write_text('{"camera_angle_x": 0.7, "frames": [{"transform_matrix": []}]}')
    (tmp_path / "train").mkdir()
    for path in (tmp_path, tmp_path / "transforms_train.json"):
        told = set()
        # As `run`, `solve` and `eyes` read it.
        for read in (opened, lambda p: read_pair(p, ContentSettings()), read_image):
            with pytest.raises(InputError, match="set of cameras for training a NeRF") as error:
                read(path)
            told.add(str(error.value))
        assert len(told) == 1
    (tmp_path / "transforms_train.json").unlink()
    write_png(tmp_path / "train" / "0.png", solid(RED))
    with pytest.raises(
        InputError, match="contains no pictures; to show the pictures in train, pass that folder instead"
    ):
        opened(tmp_path)
    (tmp_path / "a.json").write_text('{"name": "something"}')
    with pytest.raises(InputError, match=r"a\.json: show: is missing; a JSON file must be a playlist"):
        opened(tmp_path / "a.json")


# Colours


def test_a_transparent_picture_lies_over_the_scene_s_background(tmp_path: Path, opened: Any) -> None:
    clear = np.dstack([solid(RED), np.full((90, 160), 0, np.uint8)])
    Image.fromarray(clear).save(tmp_path / "a.png")
    assert shown(opened, tmp_path / "a.png")[0] == [31, 31, 31]
    assert shown(opened, tmp_path / "a.png", background=(0.0, 0.2, 1.0))[0] == [0, 51, 255]
    assert read_image(tmp_path / "a.png")[0, 0].tolist() == [255, 255, 255]


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.tif", "a.webp", "a.avif", "a.heic"])
def test_a_profile_s_colours_become_srgb(tmp_path: Path, name: str) -> None:
    """Compares a profile that swaps red and green with sRGB's."""
    if name.endswith("heic"):
        pytest.importorskip("pillow_heif").register_heif_opener()
    picture = Image.fromarray(solid((200, 80, 60)))
    for profile, wanted in ((swapped_profile(), (80, 200, 60)), (b"no profile", (200, 80, 60))):
        picture.save(tmp_path / name, icc_profile=profile, quality=98)
        assert near(read_image(tmp_path / name)[40, 40], wanted, by=4), profile[:10]


def test_srgb_s_own_profile_changes_no_code(tmp_path: Path) -> None:
    from PIL import ImageCms

    codes = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    Image.fromarray(codes).save(tmp_path / "a.png", icc_profile=profile)
    assert np.array_equal(read_image(tmp_path / "a.png"), codes)


@pytest.mark.parametrize("mode", ["1", "L", "LA", "P", "RGB", "RGBA", "CMYK", "YCbCr", "LAB", "I;16"])
def test_every_mode_of_colours_is_read(tmp_path: Path, mode: str) -> None:
    white = Image.new("RGB", (20, 20), (255, 255, 255))
    image = white.convert(mode) if mode != "I;16" else Image.fromarray(np.full((20, 20), 65535, np.uint16))
    image.save(tmp_path / "a.tif")
    assert near(read_image(tmp_path / "a.tif")[5, 5], (255, 255, 255), by=2)


def test_values_without_a_range_are_refused(tmp_path: Path) -> None:
    Image.fromarray(np.full((20, 20), 0.5, np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(InputError, match=r"a\.tif: has 32-bit values without a defined range"):
        read_image(tmp_path / "a.tif")


# Folders, and pictures that move


def test_a_folder_holds_pictures_of_any_size_and_kind(tmp_path: Path, opened: Any) -> None:
    write_png(tmp_path / "0.png", solid(RED, 160, 90))
    write_png(tmp_path / "1.png", solid(GREEN, 90, 160))
    mpo(tmp_path / "2.mpo", solid(RED), solid(BLUE))
    write_png(tmp_path / "3_tb.png", np.concatenate([solid(GREEN), solid(BLUE)]))
    source = opened(tmp_path, picture_rate_hz=1.0)
    seen = [[centre(source, side, time_ns=second * 10**9) for side in (0, 1)] for second in range(4)]
    for found, wanted in zip(seen, ((RED, RED), (GREEN, GREEN), (RED, BLUE), (GREEN, BLUE)), strict=True):
        assert near(found[0], wanted[0]) and near(found[1], wanted[1])
    picture = source.render(panel_view(EYES[0], STACK.panel(1)), time_ns=10**9)
    rows, columns = np.nonzero(picture[..., 3] > 127)
    assert np.ptp(columns) / np.ptp(rows) == pytest.approx(90 / 160, rel=0.03)
    assert source.info.moving and source.info.flat_x_m is None


def test_a_folder_that_begins_with_a_truncated_picture_shows_the_others(tmp_path: Path, caplog: Any) -> None:
    write_png(tmp_path / "b.png", solid(RED))
    (tmp_path / "a.png").write_bytes((tmp_path / "b.png").read_bytes()[:60])
    frames = open_frames(tmp_path, AUTO)
    assert frames.count == 1 and near(frames.frame(0)[0, 0], RED)
    assert "skipping 1 of 2 pictures: a.png cannot be decoded as an image" in caplog.text
    (tmp_path / "b.png").unlink()
    with pytest.raises(InputError, match=r"a\.png: cannot be decoded as an image"):
        open_frames(tmp_path, AUTO)


def test_what_a_folder_holds_besides_is_left_out_and_named(tmp_path: Path, caplog: Any) -> None:
    (tmp_path / "a.jxl").write_bytes(b"\xff\x0a" + bytes(40))
    (tmp_path / "b.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match=r"a\.jxl: is JPEG XL, which is not supported"):
        open_frames(tmp_path, AUTO)
    write_png(tmp_path / "c.png", solid(RED))
    Image.fromarray(solid(RED)).save(tmp_path / "d.tga")
    (tmp_path / "e.mov").write_bytes(b"\0\0\0\x14ftypqt  ")
    assert open_frames(tmp_path, AUTO).count == 2
    assert (
        "skipping 3 of 5 pictures: a.jxl is JPEG XL" in caplog.text
        and "b.png cannot be decoded as an image" in caplog.text
    )
    assert "e.mov is a film; set content.scene to the film itself" in caplog.text


@pytest.mark.parametrize("kind", ["GIF", "WEBP", "PNG", "AVIF"])
def test_an_animated_picture_plays_at_its_own_pace(tmp_path: Path, opened: Any, kind: str) -> None:
    pictures = [Image.fromarray(solid(colour)) for colour in (RED, GREEN, BLUE)]
    path = tmp_path / f"a.{kind.lower()}"
    pictures[0].save(path, kind, save_all=True, append_images=pictures[1:], duration=[200, 100, 300], loop=0)
    source = opened(path)
    for time_ms, wanted in ((0, RED), (150, RED), (250, GREEN), (350, BLUE), (590, BLUE), (650, RED)):
        assert near(centre(source, 0, time_ns=time_ms * 10**6), wanted), time_ms
    assert source.info.moving


def test_an_animation_over_the_limit_is_a_still_and_says_so(tmp_path: Path, monkeypatch: Any, caplog: Any) -> None:
    pictures = [Image.fromarray(solid(colour)) for colour in (RED, GREEN, BLUE)]
    pictures[0].save(tmp_path / "a.gif", save_all=True, append_images=pictures[1:])
    monkeypatch.setattr(LIMITS, "pixels", 2 * 160 * 90)
    assert open_frames(tmp_path / "a.gif", AUTO).count == 1
    assert "3 frames of 160 x 90 pixels, which exceeds" in caplog.text
    assert "showing only its first frame" in caplog.text


# Refusals


@pytest.mark.parametrize("suffix", ["jpg", "png", "webp", "avif", "heic", "gif", "tif"])
def test_a_picture_that_ends_too_early_is_called_cut_off(tmp_path: Path, suffix: str, capfd: Any) -> None:
    if suffix == "heic":
        pytest.importorskip("pillow_heif").register_heif_opener()
    path = tmp_path / f"a.{suffix}"
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    capfd.readouterr()
    with pytest.raises(InputError, match=rf"a\.{suffix}: .*is truncated"):
        read_image(path)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b"\x00\x00\x00\x0cJXL \r\n\x87\n", "is JPEG XL, which is not supported; save it as PNG, JPEG or AVIF"),
        (b"v/1\x01\x02\x00\x00\x00", "is OpenEXR, which is not supported; tone-map the picture"),
        (b"8BPS\x00\x01", "is a Photoshop document"),
        (b"II*\x00\x10\x00\x00\x00CR\x02\x00", "is a camera's raw picture"),
        (b"version https://git-lfs.github.com/spec/v1\n", "is a Git LFS pointer"),
        (b'<?xml version="1.0"?><svg/>', "is SVG"),
        (b"<!DOCTYPE html><html>", "is a web page"),
        (b"PK\x03\x04", "is a ZIP archive, which is not supported; unpack it first"),
        (b"\x89MCAP0\r\n", "is a recording, which is not supported; play it with --replay"),
    ],
)
def test_another_kind_is_called_by_its_name_with_the_way_out(tmp_path: Path, data: bytes, told: str) -> None:
    (tmp_path / "a.png").write_bytes(data + bytes(100))
    with pytest.raises(InputError, match=told):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize("suffix", ["dng", "NEF", "arw"])
def test_of_a_raw_picture_the_thumbnail_is_not_shown(tmp_path: Path, suffix: str) -> None:
    """A raw file is a TIFF whose first picture is small."""
    Image.fromarray(solid(RED)).save(tmp_path / f"a.{suffix}", "TIFF")
    with pytest.raises(InputError, match="is a camera's raw picture, which is not supported; develop it"):
        open_frames(tmp_path / f"a.{suffix}", AUTO)


def test_without_its_extra_a_heic_is_called_so(tmp_path: Path) -> None:
    path = heic_pair(tmp_path / "a.heic", [solid(RED)], group=())
    code = "import sys; sys.modules['pillow_heif'] = None\nfrom pathlib import Path\n"
    code += "from runtime.support import picture_header\npicture_header.importlib.util.find_spec = lambda name: None\n"
    code += f"from runtime.support.picture_file import read_image\nread_image(Path({str(path)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "a.heic: is HEIC, which requires the extra `heic` (pip install pillow-heif)" in done.stderr
