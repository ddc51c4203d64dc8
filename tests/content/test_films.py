"""Tests that films are shown as players show them: times, pixel shapes, streams, transparency, fields, colours."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from av.video.reformatter import Colorspace

from runtime.config import ContentSettings
from runtime.content.frames import Video
from runtime.content.pictures import PicturesSource, open_frames
from runtime.content.placing import SceneFile
from runtime.errors import InputError
from runtime.records import U8
from runtime.support.film import Film, FilmWriter
from tests.content.conftest import STACK, panel_view

MS = 1_000_000
AUTO = ContentSettings()


def grey(level: int, width: int = 64, height: int = 48) -> U8:
    return np.full((height, width, 3), level, np.uint8)


def write(
    path: Path, *streams: list[tuple[int, U8]], codec: str = "mpeg4", pix_fmt: str = "yuv420p", **options: Any
) -> Path:
    """A film of streams of pictures with their times in ms.

    options: `form`, FFmpeg's name of the container; `aspect`, the pixels' width over height; `base` of the times in s,
    else ms; `matrix`, the colours' matrix, not declared; others are the encoder's.
    """
    matrix = options.pop("matrix", None)
    form, aspect, base = options.pop("form", None), options.pop("aspect", None), options.pop("base", Fraction(1, 1000))
    with av.open(str(path), "w", format=form) as out:
        made = []
        for pictures in streams:
            stream: Any = out.add_stream(codec, rate=options.pop("rate", 1000))
            stream.height, stream.width = pictures[0][1].shape[:2]
            stream.pix_fmt = pix_fmt
            stream.codec_context.time_base = base
            stream.options = {name: str(value) for name, value in options.items()}
            if aspect is not None:
                stream.codec_context.sample_aspect_ratio = aspect
            made.append(stream)
        for stream, pictures in zip(made, streams, strict=True):
            for at_ms, picture in pictures:
                kind = "rgba" if picture.shape[2] == 4 else "rgb24"
                frame = av.VideoFrame.from_ndarray(picture, format=kind).reformat(format=pix_fmt, dst_colorspace=matrix)
                frame.pts, frame.time_base = at_ms, base
                out.mux(stream.encode(frame))
            out.mux(stream.encode(None))
    return path


def played(path: Path, times_ms: list[int], **settings: Any) -> list[int]:
    """The mean codes of a film's picture at these times."""
    frames = open_frames(path, ContentSettings(**settings))
    codes = [round(float(frames.frame(frames.at(at_ms * MS)).mean())) for at_ms in times_ms]
    frames.close()
    return codes


@pytest.mark.parametrize("suffix", [".mkv", ".mp4"])
def test_every_frame_is_shown_at_its_own_time(tmp_path: Path, suffix: str) -> None:
    """A second of stills, then ten pictures in a third of a second."""
    times_ms = [0, 500, 1000, *range(1033, 1333, 33)]
    levels = [int(level) for level in np.linspace(20, 230, len(times_ms))]
    path = write(tmp_path / f"a{suffix}", [(at, grey(level)) for at, level in zip(times_ms, levels, strict=True)])
    assert np.abs(np.array(played(path, times_ms)) - levels).max() < 6
    assert np.abs(np.array(played(path, [499, 0, 999, 1000, 300])) - [levels[n] for n in (0, 0, 1, 2, 0)]).max() < 6


def remuxed(given: Path, path: Path, *, indexed: bool = False, **options: str) -> Path:
    """The same packets in another file. indexed: its index names every frame, as if each could be decoded alone."""
    with av.open(str(path), "w", container_options=options) as out, av.open(str(given)) as container:
        stream = out.add_stream_from_template(container.streams.video[0])
        for packet in container.demux(video=0):
            if packet.size:
                packet.stream, packet.is_keyframe = stream, indexed or packet.is_keyframe
                out.mux(packet)
    return path


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("a.mp4", {"base": Fraction(1, 30000), "step": 1001}),  # times that are no whole number of ns
        ("a.avi", {"base": Fraction(1001, 30000), "bf": 2}),
        ("a.avi", {"base": Fraction(1001, 30000), "codec": "libx264", "g": 12}),  # AVI has no times for H.264
        ("b.mkv", {"step": 33, "codec": "libx264"}),
    ],
)
def test_frames_are_those_of_their_number_in_any_order(tmp_path: Path, name: str, options: dict[str, Any]) -> None:
    step = options.pop("step", 1)
    pictures = [(step * (n + 1), grey(20 + 20 * n)) for n in range(11)]
    path = write(tmp_path / name.replace("b", "a"), pictures, rate=Fraction(30000, 1001), **options)
    if name == "b.mkv":
        path = remuxed(path, tmp_path / name, indexed=True)
    frames = open_frames(path, AUTO)
    order = [*range(11), 8, 3, 10, 1, 6]
    assert [round((float(frames.frame(n).mean()) - 20) / 20) for n in order] == order


@pytest.mark.parametrize(
    ("matrix", "wanted"),
    [((1, 0, 0, 1), "1234"), ((-1, 0, 0, 1), "2143"), ((1, 0, 0, -1), "3412"), ((-1, 0, 0, -1), "4321"),
     ((0, 1, -1, 0), "3142"), ((0, 1, 1, 0), "1324"), ((0, -1, 1, 0), "2413"), ((0, -1, -1, 0), "4231")],
)  # fmt: skip
def test_a_film_is_turned_and_mirrored_as_it_declares(tmp_path: Path, matrix: tuple[int, ...], wanted: str) -> None:
    """A point x, y from the middle is shown at a x + c y, b x + d y."""
    quarters = np.kron(np.array([[1, 2], [3, 4]]) * 50, np.ones((24, 32)))
    path = write(tmp_path / "a.mp4", [(0, np.repeat(quarters[..., None], 3, 2).astype(np.uint8))])
    plain, own = (
        struct.pack(">9i", *(n << 16 for n in (a, b, 0, c, d, 0, 0, 0)), 1 << 30)
        for a, b, c, d in ((1, 0, 0, 1), matrix)
    )
    data = path.read_bytes()
    place = data.rindex(plain)  # the film's own comes before that of its track
    path.write_bytes(data[:place] + own + data[place + len(own) :])
    picture = open_frames(path, AUTO).frame(0)
    places = [(y, x) for y in (picture.shape[0] // 4, -12) for x in (picture.shape[1] // 4, -12)]
    assert "".join(str(round(picture[place].mean() / 50)) for place in places) == wanted


@pytest.mark.parametrize("step_ms", [20_000, 100_000])
def test_a_time_lapse_is_a_film(tmp_path: Path, step_ms: int) -> None:
    path = write(tmp_path / "a.mp4", [(n * step_ms, grey(60 * n + 30)) for n in range(3)])
    assert np.abs(np.array(played(path, [0, step_ms - 1, step_ms, 2 * step_ms])) - [30, 30, 90, 150]).max() < 6


def test_a_recording_of_unknown_length_is_played_to_its_end(tmp_path: Path) -> None:
    """As browsers write it: WebM without a duration and an index."""
    pictures = [(100 * n, grey(20 * n + 20)) for n in range(8)]
    path = remuxed(write(tmp_path / "b.webm", pictures, codec="libvpx"), tmp_path / "a.webm", live="1")
    with av.open(str(path)) as container:
        assert container.duration is None
    assert np.abs(np.array(played(path, [0, 150, 750, 850])) - [20, 40, 160, 20]).max() < 8


def test_a_films_pixels_have_the_shape_that_it_declares(tmp_path: Path) -> None:
    """A square of 4:3 pixels is a third wider than high."""
    picture = grey(0, 96, 96)
    picture[24:72, 24:72] = 255
    path = write(tmp_path / "a.mp4", [(0, picture), (100, picture)], aspect=Fraction(4, 3))
    source = PicturesSource(open_frames(path, AUTO), file=SceneFile(path, AUTO, STACK))
    shown = source.render(panel_view((0.6, 0.0, 0.0), STACK.panel(1)), time_ns=0)[..., 0] > 128
    wide, high = np.ptp(np.nonzero(shown.any(0))[0]) + 1, np.ptp(np.nonzero(shown.any(1))[0]) + 1
    assert wide / high == pytest.approx(4 / 3, rel=0.03)


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "mjpeg"), ("a.mkv", "mpeg4")])
def test_two_streams_of_equal_pictures_are_the_two_views(tmp_path: Path, name: str, codec: str) -> None:
    """Fuji's 3D AVI, and a Matroska film with two tracks."""
    kind = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    left, right = ([(100 * n, grey(level + 10 * n)) for n in range(4)] for level in (40, 180))
    path = write(tmp_path / name, left, right, codec=codec, pix_fmt=kind, rate=10)
    frames = open_frames(path, AUTO)
    for number in (0, 3, 1):
        views = [float(view.mean()) for view in frames.layout(number).views(frames.frame(number))]
        assert views == pytest.approx([40 + 10 * number, 180 + 10 * number], abs=5)
    assert played(path, [0], layout="mono") == pytest.approx([40], abs=5)
    crossed = open_frames(path, ContentSettings(layout="cross-eyed"))
    assert crossed.layout(0).views(crossed.frame(0))[0].mean() == pytest.approx(180, abs=5)


def test_streams_of_different_sizes_are_not_views(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mkv", [(0, grey(40)), (100, grey(40))], [(0, grey(200, 128, 96))])
    assert played(path, [0]) == pytest.approx([40], abs=4)


@pytest.mark.parametrize(("name", "codec", "pix_fmt"), [("a.webm", "libvpx-vp9", "yuva420p"), ("a.mov", "png", "rgba")])
def test_a_transparent_film_is_shown_over_the_background(tmp_path: Path, name: str, codec: str, pix_fmt: str) -> None:
    picture = np.dstack([grey(250), np.repeat([[0] * 32 + [255] * 32], 48, 0)]).astype(np.uint8)
    path = write(tmp_path / name, [(0, picture), (100, picture)], codec=codec, pix_fmt=pix_fmt)
    frames = open_frames(path, ContentSettings(background=(0.2, 0.4, 0.6)))
    row = frames.frame(0)[24].astype(int)
    assert np.abs(row[8] - [51, 102, 153]).max() < 6 and np.abs(row[56] - 250).max() < 6


def test_interlaced_films_do_not_comb(tmp_path: Path) -> None:
    """A bar moves between the fields, and every other row would show it elsewhere."""
    pictures = []
    for n in range(6):
        picture = grey(20, 96, 96)
        picture[0::2, 8 * n : 8 * n + 16] = 220
        picture[1::2, 8 * n + 4 : 8 * n + 20] = 220
        pictures.append((40 * n, picture))
    path = write(
        tmp_path / "a.mkv", pictures, codec="libx264", flags="+ildct+ilme", **{"x264-params": "tff=1", "crf": 5}
    )
    frames = open_frames(path, AUTO)
    assert frames.count == 6
    for number in (0, 3, 5):
        rows = frames.frame(number)[16:80, :, 1].astype(int)
        assert np.abs(rows[:-1] - rows[1:]).mean() < 3, number
        assert (rows > 128).sum() > 500


def test_a_frame_packing_that_only_h264_declares_is_used(tmp_path: Path) -> None:
    halves = np.concatenate([grey(60, 64, 72), grey(180, 64, 72)], axis=1)
    path = write(
        tmp_path / "a.mp4", [(0, halves), (100, halves)], codec="libx264", **{"x264-params": "frame-packing=3"}
    )
    frames = open_frames(path, AUTO)
    assert [round(float(view.mean()) / 60) for view in frames.layout(0).views(frames.frame(0))] == [1, 3]
    assert frames.layout(0).half


def test_the_cover_of_an_audio_file_is_a_still(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mp4", [(0, grey(90))], codec="mjpeg", pix_fmt="yuvj420p")
    data = path.read_bytes()
    assert played(path, [0, 5000]) == pytest.approx([90, 90], abs=4) and data[4:8] == b"ftyp"


def test_paper_white_of_a_pq_film_is_white(tmp_path: Path) -> None:
    """As for stills: 203 nits have the code 148, and half their light the code 130."""
    for transfer, name, white, half in ((16, "smpte2084", 148, 130), (18, "arib-std-b67", 191, 161)):
        for code, wanted in ((white, 255), (half, 188), (0, 0)):
            colours = {"x264-params": f"colorprim=bt2020:transfer={name}:colormatrix=bt2020nc:crf=1"}
            pictures = [(0, grey(code))]
            path = write(tmp_path / "a.mp4", pictures, codec="libx264", pix_fmt="yuv420p10le", **colours)
            assert played(path, [0])[0] == pytest.approx(wanted, abs=10), (transfer, code)


@pytest.mark.parametrize(("height", "matrix"), [(576, Colorspace.ITU601), (720, Colorspace.ITU709)])
def test_colours_without_a_matrix_have_that_of_their_size(tmp_path: Path, height: int, matrix: Colorspace) -> None:
    picture = np.full((height, 720, 3), (200, 40, 40), np.uint8)
    shown = open_frames(write(tmp_path / "a.mp4", [(0, picture)], matrix=matrix), AUTO).frame(0)
    assert np.abs(shown[300, 300].astype(int) - (200, 40, 40)).max() < 8


def test_a_film_that_is_cut_off_repeats_what_is_there(tmp_path: Path) -> None:
    noise = np.random.default_rng(0)
    pictures = [(100 * n, noise.integers(0, 255, (48, 64, 3)).astype(np.uint8)) for n in range(20)]
    path = write(tmp_path / "a.mkv", pictures)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    video = Video(path, AUTO)
    assert 2 <= video.count < 20
    assert video.frame(video.at(100 * MS)).shape == (48, 64, 3)
    path.write_bytes(b"")
    with pytest.raises(InputError, match="cannot be decoded as a film"):
        Film(path)


def test_a_written_film_has_the_times_of_its_pictures(tmp_path: Path) -> None:
    writer = FilmWriter(tmp_path / "a.mp4")
    for at_ms in (7000, 7033, 7100, 7400):
        writer.write(grey(100), time_ns=at_ms * MS)
    writer.close()
    assert (Film(tmp_path / "a.mp4").times_ns[:4] // MS).tolist() == [0, 33, 100, 400]


def test_a_scene_may_be_a_file_url(opened: Any, tmp_path: Path) -> None:
    path = write(tmp_path / "a film é.mp4", [(0, grey(90))])
    source = opened(path.as_uri())
    assert source.info.name == "a film é"
    with pytest.raises(InputError, match="is on another computer; mount the share"):
        opened("smb://nas/films/a.mp4")


def test_a_film_in_an_unknown_code_is_refused_in_one_line(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mkv", [(0, grey(90)), (100, grey(90))])
    data = path.read_bytes()
    assert data.count(b"V_MPEG4/ISO/ASP") == 1
    path.write_bytes(data.replace(b"V_MPEG4/ISO/ASP", b"V_NOBODY/KNOWS/"))
    with pytest.raises(InputError, match="cannot be decoded as a film"):
        Film(path)
