"""What each panel's monitor is sent, pixel by pixel, drawn by the real shader."""

from __future__ import annotations

import gc

import numpy as np
import psutil
import pytest

from runtime.clock import SimulatedClock
from runtime.config import OutputSettings, PanelSettings
from runtime.errors import InputError, PanelLost
from runtime.optics.stack import PanelStack
from runtime.panels.offscreen import OffscreenPanels
from runtime.panels.registry import open_panels
from runtime.records import PanelFrame
from runtime.support.gl import offscreen_context

WIDTH, HEIGHT = 48, 32


@pytest.fixture
def layers():
    return np.random.default_rng(7).integers(0, 256, (3, HEIGHT, WIDTH, 4), dtype=np.uint8)


def shown(context, layers, *panels, clock=None, draw=False):
    sink = OffscreenPanels(
        context, clock=clock or SimulatedClock(), width_px=WIDTH, height_px=HEIGHT, panels=panels, draw=draw
    )
    try:
        sink.present(PanelFrame(1, layers, 1))
        return [picture[..., :3] for picture in sink.read_back()]
    finally:
        sink.close()


def test_by_default_every_panel_shows_its_layer_to_the_bit(context, layers):
    pictures = shown(context, layers, PanelSettings(), PanelSettings(), PanelSettings())
    for picture, layer in zip(pictures, layers, strict=True):
        assert np.array_equal(picture, layer[..., :3])


@pytest.mark.parametrize(("rotation_deg", "clockwise_quarters"), [(0, 0), (90, 1), (180, 2), (270, 3)])
@pytest.mark.parametrize(("mirror", "axis"), [("none", None), ("horizontal", 1), ("vertical", 0)])
def test_a_mounted_panel_is_sent_its_picture_mirrored_then_turned_against_the_mounting(
    context, layers, rotation_deg, clockwise_quarters, mirror, axis
):
    (picture,) = shown(context, layers[:1], PanelSettings(rotation_deg=rotation_deg, mirror=mirror))
    seen = layers[0, ..., :3] if axis is None else np.flip(layers[0, ..., :3], axis)
    assert np.array_equal(picture, np.rot90(seen, -clockwise_quarters))


def test_a_registered_panel_is_sent_its_picture_where_registration_found_it(context, layers):
    shift = ((1.0, 0.0, 5.0), (0.0, 1.0, -3.0), (0.0, 0.0, 1.0))
    (picture,) = shown(context, layers[:1], PanelSettings(homography=shift))
    assert np.array_equal(picture[:-3, 5:], layers[0, 3:, :-5, :3])
    assert not picture[:, :5].any() and not picture[-3:].any()  # beyond the layer there is no phase


def test_half_a_pixel_of_registration_is_interpolated(context, layers):
    shift = ((1.0, 0.0, 0.5), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    (picture,) = shown(context, layers[:1], PanelSettings(homography=shift))
    mean = (layers[0, :, :-1, :3].astype(float) + layers[0, :, 1:, :3]) / 2
    assert np.abs(picture[:, 1:] - mean).max() <= 1.0


def test_a_perspective_registration_agrees_with_an_independent_warp(context):
    import cv2

    smooth = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 4)).astype(np.uint8), (0, 0), 4)
    homography = ((1.02, 0.01, -1.5), (-0.02, 0.97, 1.0), (2e-4, -1e-4, 1.0))
    (picture,) = shown(context, smooth[None], PanelSettings(homography=homography))
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])  # OpenCV counts from pixel centres
    expected = cv2.warpPerspective(smooth, np.linalg.inv(half) @ np.array(homography) @ half, (WIDTH, HEIGHT))
    inner = (slice(4, -4), slice(4, -4))
    assert np.abs(picture[inner].astype(int) - expected[inner][..., :3]).max() <= 2


def test_a_homography_may_have_either_sign(context, layers):
    negative = tuple(tuple(-float(i == j) for j in range(3)) for i in range(3))
    (picture,) = shown(context, layers[:1], PanelSettings(homography=negative))
    assert np.array_equal(picture, layers[0, ..., :3])


def test_each_channel_goes_through_its_own_curve(context, tmp_path):
    path = tmp_path / "curve.csv"
    path.write_text("phase,red,green,blue\n0,0,1,0.5\n1,1,0,0.5\n")
    ramp = np.zeros((1, HEIGHT, WIDTH, 4), np.uint8)
    ramp[..., :3] = np.linspace(0, 255, WIDTH).astype(np.uint8)[None, None, :, None]
    (picture,) = shown(context, ramp, PanelSettings(lut=str(path)))
    assert np.array_equal(picture[..., 0], ramp[0, ..., 0])
    assert np.array_equal(picture[..., 1], 255 - ramp[0, ..., 1])
    assert np.abs(picture[..., 2] - 127.5).max() == 0.5


def test_a_gamma_changes_greys_and_keeps_black_and_white(context):
    ramp = np.repeat(np.arange(0, 256, 8, dtype=np.uint8)[:, None, None], WIDTH, axis=1).repeat(4, axis=2)[None]
    (picture,) = shown(context, ramp, PanelSettings(gamma=2.2))
    expected = 255 * (ramp[0, ..., :3] / 255) ** (1 / 2.2)
    assert np.abs(picture - expected).max() <= 0.51


def test_the_report_tells_frame_time_and_skew(context, layers):
    clock = SimulatedClock(5_000)
    sink = open_panels(OutputSettings(), PanelStack(0.5, 0.3, (-0.1, 0.0, 0.1), WIDTH, HEIGHT), clock, context)
    report = sink.present(PanelFrame(41, layers, 41))
    assert (report.number, report.present_ns, report.skew_ms, report.vblank_ns) == (41, 5_000, 0.0, None)
    assert sink.period_ns is None
    sink.close()


class Ticking(SimulatedClock):
    """Every look at it costs a millisecond."""

    def now_ns(self) -> int:
        self.advance_ns(1_000_000)
        return super().now_ns()


def test_panels_drawn_one_after_the_other_have_a_skew(context, layers):
    panels = (PanelSettings(),) * 3
    sink = OffscreenPanels(context, clock=Ticking(), width_px=WIDTH, height_px=HEIGHT, panels=panels, draw=True)
    assert sink.present(PanelFrame(1, layers, 1)).skew_ms == 2.0
    sink.close()


def test_a_later_frame_replaces_an_earlier_one_on_all_panels(context, layers):
    sink = OffscreenPanels(
        context, clock=SimulatedClock(), width_px=WIDTH, height_px=HEIGHT, panels=(PanelSettings(),) * 3
    )
    sink.present(PanelFrame(1, layers, 1))
    sink.present(PanelFrame(2, np.ascontiguousarray(255 - layers), 2))
    for picture, layer in zip(sink.read_back(), layers, strict=True):
        assert np.array_equal(picture[..., :3], 255 - layer[..., :3])
    sink.close()
    sink.close()


def test_an_unchanged_frame_costs_nothing_and_stays(context, layers):
    sink = OffscreenPanels(
        context, clock=SimulatedClock(), width_px=WIDTH, height_px=HEIGHT, panels=(PanelSettings(),) * 3
    )
    other = np.zeros_like(layers)
    sink.present(PanelFrame(0, layers, 0), unchanged=True)  # nothing was shown before: it must be uploaded all the same
    assert sink.present(PanelFrame(1, other, 1), unchanged=True).number == 1
    assert np.array_equal(sink.read_back()[0][..., :3], layers[0, ..., :3])
    sink.close()


def test_nothing_can_be_read_back_before_the_first_frame(context):
    sink = OffscreenPanels(context, clock=SimulatedClock(), width_px=WIDTH, height_px=HEIGHT, panels=(PanelSettings(),))
    with pytest.raises(ValueError, match="presented"):
        sink.read_back()
    sink.close()


def test_layers_of_another_size_are_a_mistake_of_the_caller(context, layers):
    with pytest.raises(ValueError, match="panels"):
        shown(context, layers, PanelSettings())


def test_a_lost_context_is_a_lost_panel_not_a_crash(layers):
    own = offscreen_context()
    sink = OffscreenPanels(own, clock=SimulatedClock(), width_px=WIDTH, height_px=HEIGHT, panels=(PanelSettings(),) * 3)
    sink.present(PanelFrame(1, layers, 1))
    sink._textures.release()  # what a driver's reset leaves behind: objects that are no more
    with pytest.raises(PanelLost):
        sink.read_back()
    sink.close()
    own.release()


def test_opening_and_closing_gives_the_memory_back(context):
    def open_and_close() -> None:
        panels = (PanelSettings(),) * 3
        sink = OffscreenPanels(context, clock=SimulatedClock(), width_px=512, height_px=512, panels=panels)
        sink.present(PanelFrame(1, np.zeros((3, 512, 512, 4), np.uint8), 1))
        sink.read_back()
        sink.close()

    process = psutil.Process()
    for _ in range(5):
        open_and_close()
    before = process.memory_info().rss
    for _ in range(40):
        open_and_close()
    gc.collect()
    one_sink = 2 * 3 * 512 * 512 * 4  # layers and targets
    assert process.memory_info().rss - before < 8 * one_sink


def test_a_wrong_number_of_panel_tables_is_refused(context):
    stack = PanelStack(0.5, 0.3, (-0.1, 0.0, 0.1), WIDTH, HEIGHT)
    with pytest.raises(InputError, match="output: panels"):
        open_panels(OutputSettings(panels=(PanelSettings(),)), stack, SimulatedClock(), context)
