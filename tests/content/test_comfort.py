"""Tests that a stereo picture is kept within a comfortable depth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.config import ContentSettings, StackGeometry
from runtime.content.base import ContentSource
from runtime.content.comfort import adjusted, disparities
from runtime.content.registry import open_content
from runtime.plan.drawing import raster_views
from tests.waiting import eventually

STACK = replace(StackGeometry().stack(), width_px=480, height_px=270)
EYES = np.array([[0.6, -0.03, 0.0], [0.6, 0.03, 0.0]])


def pair(upper_px: int, lower_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Two views of 480 x 270: a coarse random pattern, with one disparity in the upper and one in the lower half."""
    random = np.random.default_rng(0)
    wide = cv2.resize(random.integers(0, 256, (45, 120, 3)).astype(np.uint8), (720, 270), interpolation=cv2.INTER_CUBIC)
    left, right = np.empty((2, 270, 480, 3), np.uint8)
    for rows, shift in ((slice(0, 135), upper_px), (slice(135, 270), lower_px)):
        left[rows], right[rows] = wide[rows, 100:580], wide[rows, 100 + shift : 580 + shift]
    return left, right


@pytest.mark.parametrize(("upper_px", "lower_px"), [(20, -30), (-10, -45), (40, 5), (0, 0)])
def test_nearest_and_farthest_disparity_are_found(upper_px: int, lower_px: int) -> None:
    found = disparities(*pair(upper_px, lower_px))
    assert found is not None
    assert found == pytest.approx((lower_px / 480, upper_px / 480), abs=0.004)


def test_views_without_any_detail_have_no_disparity() -> None:
    left = right = np.full((270, 480, 3), 128, np.uint8)
    assert disparities(left, right) is None


@pytest.mark.parametrize(
    ("far_mm", "near_mm", "shift_mm", "scale"),
    [
        (-5, 5, 0, 1),  # within the limit of 10 mm
        (0, 18, 8, 1),  # too near, so it is moved back
        (-18, 0, -8, 1),
        (-10, 30, 5, 0.5),  # too deep, so it is made smaller as well
        (0, 200, 25, 0.25),  # but not too small
    ],
)
def test_views_are_moved_as_little_as_possible(far_mm: float, near_mm: float, shift_mm: float, scale: float) -> None:
    assert adjusted(far_mm * 1e-3, near_mm * 1e-3, 0.01) == pytest.approx((shift_mm * 1e-3, scale))


def expected(comfort_deg: float) -> tuple[float, float]:
    """Disparities of `pair(30, 10)` as shown. The panels' 480 pixels are 0.5184 m wide, the eyes 0.6 m away."""
    most = np.radians(comfort_deg) * 0.6 / 0.5184
    return (-most, most) if comfort_deg else (10 / 480, 30 / 480)


def shown_disparities(source: ContentSource, comfort_deg: float) -> list[float]:
    """The same in the middle of the picture, whose edges have a disparity as well where it was moved."""
    views = [replace(view, comfort_deg=comfort_deg) for view in raster_views(EYES, STACK.panel(1))]
    source.expect(views, time_ns=0)
    left, right = (source.render(view, time_ns=0)[60:210, 90:390, :3].copy() for view in views)
    return [300 / 480 * one for one in disparities(left, right) or ()]


def test_a_still_picture_is_shown_within_a_limit_set_later(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "a_sbs.png"), np.hstack(pair(30, 10))[..., ::-1])
    source = open_content(ContentSettings(scene=str(tmp_path / "a_sbs.png")), STACK, None)
    for comfort_deg in (0.0, 0.8, 0.9, 0.0):
        assert shown_disparities(source, comfort_deg) == pytest.approx(expected(comfort_deg), abs=0.006)
    source.close()


@pytest.mark.parametrize("comfort_deg", [0.0, 0.8])
def test_a_pipe_is_shown_within_the_limit(tmp_path: Path, comfort_deg: float) -> None:
    os.mkfifo(tmp_path / "video")
    options = {"path": str(tmp_path / "video"), "rgb_size": [960, 270]}
    source = open_content(ContentSettings(scene="pipe", layout="side-by-side", options=options), STACK, None)
    with (tmp_path / "video").open("wb") as writer:
        writer.write(np.hstack(pair(30, 10)).tobytes())
        writer.flush()
        assert eventually(lambda: source.revision(time_ns=0) == 1)
        for limit in (comfort_deg, 0.8 - comfort_deg):  # the second one while the picture does not change
            assert shown_disparities(source, limit) == pytest.approx(expected(limit), abs=0.006)
        source.close()
