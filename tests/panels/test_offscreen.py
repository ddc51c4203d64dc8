"""Tests the pixels sent to each monitor, drawn by the real shader and on the processor."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import moderngl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.config import PanelSettings
from runtime.optics.alignment import align
from runtime.optics.presentation import shown_layers
from runtime.optics.stack import PanelStack
from runtime.records import U8, PanelFrame, PresentReport
from tests.panels.drawn import DrawnPanels, ReadPanels, drawn_panels

WIDTH, HEIGHT = 48, 32


@pytest.fixture
def layers() -> NDArray[np.uint8]:
    return np.random.default_rng(7).integers(0, 256, (3, HEIGHT, WIDTH, 4), dtype=np.uint8)


BOTH = pytest.mark.parametrize("context", ["shader", "processor"], indirect=True)


@pytest.fixture
def context(request: pytest.FixtureRequest) -> moderngl.Context | None:
    """Context of the shader; None: the processor draws."""
    if getattr(request, "param", "shader") == "processor":
        return None
    made: moderngl.Context = request.getfixturevalue("gl")
    return made


def shown(
    context: moderngl.Context | None, layers: NDArray[np.uint8], *panels: PanelSettings, **how: Any
) -> list[NDArray[np.uint8]]:
    sink = drawn_panels(context, (WIDTH, HEIGHT), *panels, **how)
    try:
        sink.present(PanelFrame(1, layers, 1))
        return [picture[..., :3] for picture in sink.read_back()]
    finally:
        sink.close()


@BOTH
@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
@pytest.mark.parametrize(("mirror", "axis"), [("none", None), ("horizontal", 1), ("vertical", 0)])
def test_a_mounted_panel_s_picture_is_mirrored_then_turned(
    context: moderngl.Context | None, layers: NDArray[np.uint8], rotation_deg: int, mirror: str, axis: int | None
) -> None:
    (picture,) = shown(context, layers[:1], PanelSettings(rotation_deg=rotation_deg, mirror=mirror))
    seen = layers[0, ..., :3] if axis is None else np.flip(layers[0, ..., :3], axis)
    assert np.array_equal(picture, np.rot90(seen, -rotation_deg // 90))


@BOTH
def test_half_a_pixel_of_registration_is_interpolated(
    context: moderngl.Context | None, layers: NDArray[np.uint8]
) -> None:
    """With cubic weights by the shader, with linear ones on the processor."""
    shift = ((1.0, 0.0, 0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    (picture,) = shown(context, layers[:1], PanelSettings(homography=shift))
    before, left, right, after = (layers[0, :, k : WIDTH - 3 + k, :3].astype(float) for k in range(4))
    cubic = (19 * (left + right) - 3 * (before + after)) / 32
    expected = (left + right) / 2 if context is None else np.clip(cubic, 0, 255)
    assert np.abs(picture[:, 2:-1] - expected).max() <= 1.0


@BOTH
def test_a_perspective_registration_agrees_with_an_independent_warp(context: moderngl.Context | None) -> None:
    smooth = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8), (0, 0), 4)
    homography = ((1.02, 0.01, -1.5), (-0.02, 0.97, 1.0), (2e-4, -1e-4, 1.0))
    (picture,) = shown(context, smooth[None], PanelSettings(homography=homography))
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts from pixel centres
    expected = cv2.warpPerspective(smooth, np.linalg.inv(half) @ np.array(homography) @ half, (WIDTH, HEIGHT))
    inner = (slice(4, -4), slice(4, -4))
    assert np.abs(picture[inner].astype(int) - expected[inner][..., :3]).max() <= 2


@BOTH
@pytest.mark.parametrize(
    ("sign", "diagonal", "axis", "at", "lit"),
    [(sign, 1, axis, 1.5, np.s_[: HEIGHT // 3, : WIDTH // (3 - axis)]) for sign in (1, -1) for axis in (0, 1)]  # beyond
    + [(1, -1, 0, 0.35, np.s_[:8, -8:]), (1, -1, 1, 0.35, np.s_[-8:, :8])],  # across it
)
def test_with_a_horizon_the_side_of_the_panel_s_middle_is_seen(
    context: moderngl.Context | None, layers: U8, sign: int, diagonal: int, axis: int, at: float, lit: Any
) -> None:
    seen = sign * np.diag([diagonal, diagonal, 1.0])
    seen[2, axis] = -sign / (at * (WIDTH, HEIGHT)[axis])
    settings = PanelSettings(homography=tuple(map(tuple, np.linalg.inv(seen).tolist())))
    (picture,) = shown(context, np.full_like(layers[:1], 200), settings)
    assert (picture[lit] == 200).all() if diagonal > 0 else (picture[lit] >= 190).all() and not picture[:4, :4].any()


@BOTH
def test_each_channel_goes_through_its_own_curve(context: moderngl.Context | None, tmp_path: Path) -> None:
    path = tmp_path / "curve.csv"
    path.write_text("phase,red,green,blue\n0,0,1,0.5\n1,1,0,0.5\n")
    ramp = np.zeros((1, HEIGHT, WIDTH, 4), np.uint8)
    ramp[..., :3] = np.linspace(0, 255, WIDTH).astype(np.uint8)[None, None, :, None]
    (picture,) = shown(context, ramp, PanelSettings(lut=str(path)))
    assert np.array_equal(picture[..., 0], ramp[0, ..., 0])
    assert np.array_equal(picture[..., 1], 255 - ramp[0, ..., 1])
    assert np.abs(picture[..., 2] - 127.5).max() == 0.5


# A solution that is aligned to where the eyes are now.

STACK, SIZE_PX = PanelStack(0.5184, 0.3456, (-0.1, 0.0, 0.06), 480, 320), (480, 320)
HEAD = np.array([[0.6, -0.031, 0.0], [0.6, 0.031, 0.0]])


def smooth(seed: int) -> np.ndarray:
    """Layers with every frequency up to a pixel, as solutions have."""
    noise = np.random.default_rng(seed).integers(0, 256, (3, STACK.height_px, STACK.width_px, 4))
    wave = 127 + 120 * np.sin(np.arange(STACK.width_px) ** 2 / 500)[None, None, :, None]
    layers = (0.5 * noise + 0.5 * wave).astype(np.uint8)
    layers[..., 3] = 255
    return layers


@pytest.fixture
def sink(context: moderngl.Context | None) -> Iterator[ReadPanels]:
    made = drawn_panels(context, SIZE_PX, *(PanelSettings(),) * 3)
    yield made
    made.close()


def codes(pictures: NDArray[np.uint8] | tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8]]) -> np.ndarray:
    return np.stack(pictures)[..., :3].astype(int)


@BOTH
def test_an_unaligned_panel_is_exact_to_the_bit_beside_aligned_ones(sink: ReadPanels) -> None:
    frame = PanelFrame(1, smooth(1), 1, align(STACK, solved_for_m=HEAD, eyes_m=HEAD * 1.01).solved_from_shown)
    assert sink.present(frame) == PresentReport(1, 0, 0.0)
    assert np.array_equal(codes(sink.read_back())[1], codes(frame.solved)[1])
    assert not np.array_equal(codes(sink.read_back())[0], codes(frame.solved)[0])


@BOTH
def test_a_registered_panel_is_aligned_first_then_warped_by_its_registration(context: moderngl.Context | None) -> None:
    shift = PanelSettings(homography=((1.0, 0.0, 5.0), (0.0, 1.0, -3.0), (0.0, 0.0, 1.0)))
    sink = drawn_panels(context, SIZE_PX, *(shift,) * 3)
    matrices = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([0.02, 0.016, 0.03])).solved_from_shown
    frame = PanelFrame(1, smooth(1), 1, matrices)
    sink.present(frame)
    picture = codes(sink.read_back())
    assert np.abs(picture[:, :-3, 5:] - codes(shown_layers(frame))[:, 3:, :-5]).max() <= 2
    assert not picture[:, :, :5].any() and not picture[:, -3:].any()  # outside the panel is black, not mid-grey
    sink.close()


def test_a_solution_is_uploaded_once_however_often_it_is_aligned_and_shown(
    sink: DrawnPanels, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[U8] = []
    assert sink._textures is not None
    write = sink._textures._written

    def noted(kind: str, layers: U8) -> tuple[moderngl.Texture, ...]:
        written.append(layers)
        return write(kind, layers)

    monkeypatch.setattr(sink._textures, "_written", noted)
    solved, flat = smooth(1), smooth(2)
    for number in range(4):
        matrices = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + 0.001 * number).solved_from_shown
        sink.present(PanelFrame(number, solved, 3, matrices, flat, 5, 0.25 * number))
        sink.read_back()
        assert [id(layers) for layers in written] == [id(solved), id(flat)][: number + 1]
    sink.present(PanelFrame(5, smooth(3), 4, (), flat, 5, 0.0))
    other = smooth(4)
    sink.present(PanelFrame(6, smooth(3), 4, (), other, 6, 1.0))  # the solution isn't seen, the flat picture is
    sink.read_back()
    assert [id(layers) for layers in written[2:]] == [id(other)]


@BOTH
def test_a_new_solution_is_recognised_by_its_version_alone(sink: ReadPanels) -> None:
    for version in (1, 2):
        sink.present(PanelFrame(version, smooth(version), version))
        assert np.array_equal(codes(sink.read_back()), codes(smooth(version)))


@BOTH
def test_monitors_show_each_panel_aligned_for_its_own_display_time(sink: ReadPanels) -> None:
    relief = np.asarray(0.15 * np.sin(np.mgrid[0:27, 0:48][1] / 8), np.float32)
    own = [align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([0, move_m, 0])) for move_m in (0.004, 0.008, 0.016)]
    layers = smooth(1)
    now, *_ = frames = [
        PanelFrame(1, layers, 1, each.solved_from_shown, size_px=SIZE_PX, relief=relief, parallax=each.parallax)
        for each in own
    ]
    in_turn = tuple((each.solved_from_shown[n], each.parallax) for n, each in enumerate(own))
    sink.present(replace(now, on_monitors=in_turn))
    expected = np.stack([shown_layers(frame)[n] for n, frame in enumerate(frames)])
    assert np.abs(codes(sink.read_back()) - codes(expected)).max() <= 3
    assert np.array_equal(shown_layers(replace(now, on_monitors=in_turn)), shown_layers(now))  # all at one time


@BOTH
def test_an_even_coarse_solution_reaches_the_panel_s_edge(sink: ReadPanels) -> None:
    even = np.full((3, STACK.height_px // 2, STACK.width_px // 2, 4), 200, np.uint8)
    sink.present(frame := PanelFrame(1, even, 1, (), size_px=SIZE_PX))
    assert (shown_layers(frame)[..., :3] == 200).all()
    assert (codes(sink.read_back()) == 200).all()


@pytest.mark.parametrize("rotation_deg", [0, 90, 180, 270])
@pytest.mark.parametrize("mirror", ["none", "horizontal", "vertical"])
@pytest.mark.parametrize("reduction", [1, 3])
def test_a_mounted_panel_is_aligned_and_displaced_as_the_viewer_sees_it(
    rotation_deg: int, mirror: str, reduction: int
) -> None:
    """Drawn on the processor, which turns pictures before it samples them."""
    v, u = np.mgrid[0:40, 0:60] / 8
    relief = np.asarray(np.maximum(0.1 * np.sin(u) * np.cos(v), 0.0), np.float32)  # flat between the hills
    moved = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([0.02, 0.016, -0.01]))
    layers = np.ascontiguousarray(smooth(1)[:, ::reduction, ::reduction])
    frame = PanelFrame(1, layers, 1, moved.solved_from_shown, smooth(2), 1, 0.3, SIZE_PX, relief, moved.parallax)
    sink = drawn_panels(None, SIZE_PX, *(PanelSettings(rotation_deg=rotation_deg, mirror=mirror),) * 3)
    sink.present(frame)
    for picture, seen in zip(sink.read_back(), shown_layers(frame), strict=True):
        mirrored = {"none": seen, "horizontal": seen[:, ::-1], "vertical": seen[::-1]}[mirror]
        difference = np.abs(picture[..., :3].astype(int) - np.rot90(mirrored, -rotation_deg // 90)[..., :3])
        assert (difference <= 1).mean() >= 0.999 and difference.max() <= 2


@BOTH
def test_layers_are_enlarged_for_a_larger_monitor(context: moderngl.Context | None) -> None:
    screen_px = 2 * WIDTH, 2 * HEIGHT
    layer = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 4), np.uint8), (0, 0), 4)
    (picture,) = shown(context, layer[None], PanelSettings(), screen_px=screen_px)
    enlarged = cv2.resize(layer, screen_px, interpolation=cv2.INTER_LINEAR)[..., :3]
    assert np.abs(picture.astype(int) - enlarged)[2:-2, 2:-2].max() <= 2


def test_on_the_processor_only_panels_that_change_are_drawn() -> None:
    sink = drawn_panels(None, SIZE_PX, *(PanelSettings(),) * 3)
    alike, moved = align(STACK, solved_for_m=HEAD, eyes_m=HEAD), align(STACK, solved_for_m=HEAD, eyes_m=HEAD * 1.01)
    layers = smooth(1)
    assert list(sink.drawn(PanelFrame(1, layers, 1, alike.solved_from_shown))) == [0, 1, 2]
    assert list(sink.drawn(PanelFrame(2, layers, 1, moved.solved_from_shown))) == [0, 2]
    assert list(sink.drawn(PanelFrame(3, layers, 1, moved.solved_from_shown))) == []
    assert list(sink.drawn(PanelFrame(4, smooth(2), 2, moved.solved_from_shown))) == [0, 1, 2]


@pytest.mark.parametrize("reductions", [[1, 2], [3, 2, 4]])
def test_on_the_processor_nothing_remains_of_an_earlier_raster(reductions: list[int]) -> None:
    """Solutions of all rasters share their memory."""
    moved = align(STACK, solved_for_m=HEAD, eyes_m=HEAD + np.array([-0.1, -0.1, 0.05])).solved_from_shown
    sink, fresh = (drawn_panels(None, SIZE_PX, *(PanelSettings(rotation_deg=90),) * 3) for _ in range(2))
    for version, by in enumerate(reductions, start=1):
        layers = np.ascontiguousarray(smooth(version)[:, ::by, ::by])
        sink.present(PanelFrame(version, layers, version, moved, size_px=SIZE_PX))
        drawn = sink.read_back()
    fresh.present(PanelFrame(version, layers, version, moved, size_px=SIZE_PX))
    assert np.abs(codes(drawn) - codes(fresh.read_back())).max() <= 1  # parts are rounded otherwise than the whole


@pytest.mark.slow
@given(st.lists(st.sampled_from([1, 2, 3, 4]), min_size=2, max_size=6))
def test_on_the_processor_nothing_remains_of_any_raster(reductions: list[int]) -> None:
    test_on_the_processor_nothing_remains_of_an_earlier_raster(reductions)


@pytest.mark.parametrize(
    ("size_px", "solved_px", "averages"),
    [((480, 320), (120, 80), 1), ((477, 319), (120, 80), 1), ((480, 320), (320, 213), 1), ((477, 319), (320, 213), 0)],
)
@pytest.mark.parametrize("gamma", [1.0, 2.0])
def test_on_the_processor_pixels_between_those_of_a_coarse_solution_are_averages(
    size_px: tuple[int, int], solved_px: tuple[int, int], averages: int, gamma: float
) -> None:
    """Every pixel of even rows and columns is sampled as the reference does, whichever thread draws it."""
    width, height = size_px
    stack = PanelStack(0.5184, 0.3456, (-0.1, 0.0, 0.06), width, height)
    moved = align(stack, solved_for_m=HEAD, eyes_m=HEAD + np.array([0.01, 0.016, 0.008]))
    relief = np.full((height // 16, width // 16), 0.1, np.float32)
    layers = np.stack([cv2.resize(layer, solved_px, interpolation=cv2.INTER_NEAREST) for layer in smooth(1)])
    frame = PanelFrame(1, layers, 1, moved.solved_from_shown, None, 0, 0.0, size_px, relief, moved.parallax)
    sink = drawn_panels(None, size_px, *(PanelSettings(gamma=gamma),) * 3)
    sink.present(frame)
    drawn, reference = codes(sink.read_back()), codes(shown_layers(frame)).astype(float)
    expected = reference.copy()
    if averages:
        expected[:, :, 1:-1:2] = (reference[:, :, 0:-2:2] + reference[:, :, 2::2]) / 2
        expected[:, 1:-1:2] = (expected[:, 0:-2:2] + expected[:, 2::2]) / 2
    inner = (slice(None), slice(0, height - 1), slice(0, width - 1))  # what lies beyond the last pixel is not shown
    greys = 255 * (expected / 255) ** (1 / gamma)
    near_black = expected < 16  # where the curve is steep
    difference = np.where(near_black, 0.0, np.abs(drawn - greys))[inner]
    assert difference.max() <= 4 and (difference <= 2).mean() >= 0.999
