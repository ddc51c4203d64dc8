"""Tests what files declare about views and colours: Leia pictures, tags of films, coded colours."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.config import ContentSettings
from runtime.content.frames import open_frames, read_pair
from runtime.errors import InputError
from runtime.support.picture_file import read_image, read_views
from tests.content.picture_files import equirectangular, film, lif, multiview, of_colours, spherical_xml, st3d
from tests.content.test_pictures import solid

RED, BLUE = (200, 40, 40), (40, 40, 200)
AUTO = ContentSettings()


def middle(picture: np.ndarray) -> str:
    return "red" if picture[picture.shape[0] // 2, picture.shape[1] // 2, 0] > 120 else "blue"


# Leia pictures


@pytest.mark.parametrize(("own_is_left", "seen"), [(True, ["red", "blue"]), (False, ["blue", "red"])])
def test_both_views_of_a_leia_picture_are_shown(tmp_path: Path, own_is_left: bool, seen: list[str]) -> None:
    path = lif(tmp_path / "a.jpg", solid(RED), solid(BLUE), own_is_left=own_is_left)
    assert [middle(view) for view in read_pair(path, AUTO)] == seen
    frames = open_frames(path, AUTO)
    assert [middle(view) for view in frames.layout(0).views(frames.frame(0))] == seen
    assert middle(open_frames(path, ContentSettings(layout="mono")).frame(0)) == seen[0]


def test_a_damaged_leia_picture_is_the_jpeg_that_it_begins_with(tmp_path: Path) -> None:
    data = lif(tmp_path / "a.jpg", solid(RED), solid(BLUE)).read_bytes()
    json_at = data.index(b'{"views"')
    for broken in (data[:-3], data[:json_at] + b"[" + data[json_at + 1 :], data.replace(b"1000001", b"1000002")):
        (tmp_path / "a.jpg").write_bytes(broken)
        assert [middle(view) for view in read_views(tmp_path / "a.jpg")] == ["red"]
    lif(tmp_path / "a.jpg", solid(RED), solid(BLUE, 80, 60))  # another size is no eye's
    assert len(read_views(tmp_path / "a.jpg")) == 1


# Films


def pair() -> np.ndarray:
    return np.concatenate([solid(RED, 80), solid(BLUE, 80)], axis=1)


def views_of(path: Path, **settings: Any) -> list[str]:
    frames = open_frames(path, ContentSettings(**settings))
    found = [middle(view) for view in frames.layout(0).views(frames.frame(0))]
    frames.close()
    return found


def test_an_mp4_is_laid_out_as_its_tag_says(tmp_path: Path) -> None:
    assert views_of(film(tmp_path / "a.mp4", pair(), added=st3d(2))) == ["red", "blue"]
    above = np.concatenate([solid(RED, height=48), solid(BLUE, height=48)])
    assert views_of(film(tmp_path / "a.mp4", above, added=st3d(1))) == ["red", "blue"]
    assert len(views_of(film(tmp_path / "a.mp4", pair(), added=st3d(0)))) == 1
    assert len(views_of(film(tmp_path / "a.mp4", pair(), added=st3d(2)), layout="mono")) == 1


@pytest.mark.parametrize(
    ("mode", "seen"), [(1, ["red", "blue"]), (2, ["blue", "red"]), (3, ["red", "blue"]), (11, ["blue", "red"])]
)
def test_a_matroska_film_is_laid_out_as_its_tag_says(tmp_path: Path, mode: int, seen: list[str]) -> None:
    picture = np.concatenate([solid(RED, height=48), solid(BLUE, height=48)]) if mode in (2, 3) else pair()
    assert views_of(film(tmp_path / "a.mkv", picture, mode=mode)) == seen


def test_stated_stereo_that_is_not_shown_is_logged(tmp_path: Path, caplog: Any) -> None:
    assert len(views_of(film(tmp_path / "a.mkv", pair(), mode=13))) == 1
    assert (
        "a.mkv: showing the film without its second view (alternating frames); convert it to side by side"
        in caplog.text
    )
    film(tmp_path / "a.mp4", pair(), added=multiview())
    assert len(views_of(tmp_path / "a.mp4")) == 1
    assert "a.mp4: showing the film without its second view (MV-HEVC)" in caplog.text


def test_both_views_of_mv_hevc_are_shown(tmp_path: Path) -> None:
    spatial = Path(__file__).parent / "data" / "spatial.mp4"  # by x265 4.1, with the boxes of Apple's spatial films
    swapped = spatial.read_bytes().replace(b"\x04\x0d\x00\x10", b"\x04\x0a\x80\x10")  # the base view is the right eye's
    (tmp_path / "a.mp4").write_bytes(swapped)
    for path, seen in ((spatial, ["red", "blue"]), (tmp_path / "a.mp4", ["blue", "red"])):
        frames = open_frames(path, AUTO)
        assert [middle(view) for n in range(3) for view in frames.layout(n).views(frames.frame(n))] == seen * 3
    assert views_of(spatial, layout="mono") == ["red"]


def test_a_film_all_around_is_refused(tmp_path: Path) -> None:
    for added, into in ((equirectangular(), {}), (spherical_xml("top-bottom"), {"into": (b"moov", b"trak")})):
        with pytest.raises(InputError, match=r"a\.mp4: shows all directions"):
            open_frames(film(tmp_path / "a.mp4", pair(), added=added, **into), ContentSettings())


# Colours


def to_srgb(linear_from_stated: np.ndarray, light: np.ndarray) -> np.ndarray:
    linear = np.clip(linear_from_stated @ light, 0, 1)
    return 255 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


# From the chromaticities of ITU-R BT.2020 and SMPTE EG 432-1, both with white D65.
SRGB_FROM = {
    12: np.array([[1.22494, -0.22494, 0.0], [-0.04206, 1.04206, 0.0], [-0.01964, -0.07864, 1.09827]]),
    9: np.array([[1.66049, -0.58764, -0.07285], [-0.12455, 1.13290, -0.00835], [-0.01815, -0.10058, 1.11873]]),
}


def stated(path: Path, codes: tuple[int, int, int], *, primaries: int, transfer: int) -> np.ndarray:
    file = io.BytesIO()
    Image.fromarray(solid(codes)).save(file, "AVIF", quality=100, subsampling="4:4:4")
    path.write_bytes(of_colours(file.getvalue(), primaries=primaries, transfer=transfer))
    return read_image(path)[40, 80].astype(float)


@pytest.mark.parametrize("primaries", [9, 12])
def test_wide_colours_stated_by_numbers_become_srgb(tmp_path: Path, primaries: int) -> None:
    codes = np.array([170, 140, 120]) / 255
    wanted = to_srgb(SRGB_FROM[primaries], np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4))
    found = stated(tmp_path / "a.avif", (170, 140, 120), primaries=primaries, transfer=13)
    assert np.abs(found - wanted).max() < 3
    assert np.abs(wanted - codes * 255).max() > 5


def test_srgb_stated_by_numbers_stays_as_it_is(tmp_path: Path) -> None:
    for transfer in (1, 2, 13):
        assert np.abs(stated(tmp_path / "a.avif", RED, primaries=1, transfer=transfer) - RED).max() <= 2


def test_paper_white_of_bright_pictures_is_white_and_half_its_light_half(tmp_path: Path) -> None:
    for transfer, white, half in ((16, 148, 130), (18, 191, 161)):  # 203 nits, 101.5 nits
        for code, light, by in ((white, 1.0, 3), (half, 0.5, 6), (255, 1.0, 1)):
            found = stated(tmp_path / "a.avif", (code, code, code), primaries=9, transfer=transfer)
            assert np.abs(found - to_srgb(np.eye(3), np.full(3, light))).max() <= by, (transfer, code)
