"""Tests that two pages of `phasestack try` are two people."""

from __future__ import annotations

import base64
import io
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from runtime.browser.link import BrowserLink, PageMode
from runtime.clock import NS_PER_MS, NS_PER_S, SimulatedClock
from runtime.config import StackGeometry
from runtime.optics.quality import psnr_db
from runtime.records import SensorFrame
from runtime.report.pairs import PairPainter
from runtime.sensor.browser import AHEAD_NS, SILENT_NS, BrowserEyes
from tests.browser.test_try import SMALL, Client, off_m, trying
from tests.browser.test_viewer import driven, needs_chromium

FOUR_M = (-0.09, -0.03, 0.03, 0.09)
FOUR = SMALL.replace("[stack]", f"[stack]\nx_m = {[*FOUR_M]}")
STACK = replace(StackGeometry().stack(), x_m=FOUR_M, width_px=320, height_px=180)
TRIED = (
    "one person", "then two", "each page says who it is", "the first one has targets", "the second one has targets",
    "both heads in a plan", "a third one watches", "one again",
)  # fmt: skip


def eyes(x_m: float, y_m: float) -> np.ndarray:
    return np.array([[x_m, y_m - 0.03, 0.0], [x_m, y_m + 0.03, 0.0]])


class Sensing:
    """A sensor of two heads, on a clock that stands still."""

    def __init__(self) -> None:
        self.link, self.clock = BrowserLink(PageMode(STACK, 40.0, heads=2)), SimulatedClock(NS_PER_S)
        self.link.sensor = replace(self.link.sensor, noise_mm=0.0)
        self.sensor = BrowserEyes(self.link, self.clock)
        self.sensor.open()

    def sampled(self, head: int, eyes_m: Any, page_ms: float, velocity_m_s: Any = None) -> SensorFrame:
        """The frame after a page's sample, whose clock is 1000 ms late and which has just arrived."""
        self.link.see(eyes_m, page_ms, head, velocity_m_s)
        late_ns = NS_PER_S + round(page_ms * NS_PER_MS) - self.clock.now_ns()
        self.clock.advance_ns(max(late_ns, 0))
        return self.sensor.read_newest(0.0)


@pytest.fixture
def sensing() -> Sensing:
    return Sensing()


def test_the_nearest_head_comes_first_and_true_eyes_keep_their_order(sensing: Sensing) -> None:
    frame = sensing.sampled(1, eyes(0.5, 0.2), 10.0)
    assert frame.true_eyes_m is not None and np.isnan(frame.true_eyes_m[:2]).all() and len(frame.people) == 1
    frame = sensing.sampled(0, eyes(0.7, 0.0), 20.0)
    assert [round(float(points.eyes_m[0, 0]), 3) for points in frame.people] == [0.5, 0.7]
    np.testing.assert_array_equal(frame.true_eyes_m, np.concatenate([eyes(0.7, 0.0), eyes(0.5, 0.2)]))


def test_a_head_that_left_is_absent_and_the_other_is_first(sensing: Sensing) -> None:
    sensing.sampled(0, eyes(0.6, 0.0), 10.0)
    sensing.sampled(1, eyes(0.6, 0.3), 20.0)
    frame = sensing.sampled(0, None, 30.0)
    assert frame.true_eyes_m is not None and np.isnan(frame.true_eyes_m[:2]).all()
    assert len(frame.people) == 1 and float(frame.people[0].eyes_m[0, 1]) == pytest.approx(0.27, abs=1e-3)
    frame = sensing.sampled(1, None, 40.0)
    assert frame.people == () and frame.true_eyes_m is not None and np.isnan(frame.true_eyes_m).all()


def test_a_head_whose_page_is_silent_is_gone(sensing: Sensing) -> None:
    sensing.sampled(0, eyes(0.6, 0.0), 10.0)
    sensing.sampled(1, eyes(0.6, 0.3), 20.0)
    frame = sensing.sampled(1, eyes(0.6, 0.3), 30.0 + SILENT_NS / NS_PER_MS)
    assert len(frame.people) == 1 and frame.true_eyes_m is not None and np.isnan(frame.true_eyes_m[:2]).all()


@pytest.mark.parametrize("later_ms", [8.0, 40.0, 400.0])
def test_a_moving_head_goes_on_until_the_others_sample(sensing: Sensing, later_ms: float) -> None:
    sensing.sampled(0, eyes(0.6, 0.0), 100.0, [0.0, 1.0, 0.5])
    frame = sensing.sampled(1, eyes(0.6, 0.3), 100.0 + later_ms)
    ahead_s = min(later_ms, AHEAD_NS / NS_PER_MS) / 1e3
    assert frame.true_eyes_m is not None
    np.testing.assert_allclose(frame.true_eyes_m[:2], eyes(0.6, 0.0) + ahead_s * np.array([0.0, 1.0, 0.5]), atol=1e-6)
    covariances = [points.covariance_m2 for points in frame.people]
    assert covariances[0] is not None and covariances[1] is not None
    assert covariances[0][0, 0] > covariances[1][0, 0]  # the extrapolated one is less certain


def test_a_resting_head_stays_for_the_others_sample(sensing: Sensing) -> None:
    sensing.sampled(0, eyes(0.6, 0.0), 100.0, [0.0, 1.0, 0.0])
    sensing.sampled(0, eyes(0.6, 0.01), 110.0)
    frame = sensing.sampled(1, eyes(0.6, 0.3), 130.0)
    np.testing.assert_array_equal(frame.true_eyes_m[:2], eyes(0.6, 0.01))  # type: ignore[index]


@pytest.mark.parametrize("velocity", [[9.0, 0.0, 0.0], [float("nan")] * 3, [1.0], "fast"])
def test_what_is_no_head_s_velocity_is_refused(sensing: Sensing, velocity: Any) -> None:
    with pytest.raises(ValueError, match=r"velocity|convert"):
        sensing.link.see(eyes(0.6, 0.0), 1.0, 0, velocity)


def told() -> None:
    """What a page that is told of changes does in these tests."""


def test_the_first_two_pages_are_heads_and_keep_their_places() -> None:
    link = BrowserLink(PageMode(STACK, 40.0, heads=2))
    for page in "abcd":
        assert link.join(page, told)
    assert [link.head_of(page) for page in "abcd"] == [0, 1, None, None]
    link.seen(0.0)
    link.leave("a")
    assert [link.head_of(page) for page in "bcd"] == [1, 0, None]
    assert [(sample.head, sample.eyes_m) for sample in link.seen(0.0)] == [(0, None)]
    assert [page for page in "bcd" if link.is_camera(page)] == ["b"]


def test_each_page_has_the_time_of_its_own_head() -> None:
    sensing = Sensing()
    for head, page_ms in ((0, 50.0), (1, 60.0), (0, 70.0)):
        frame = sensing.sampled(head, eyes(0.6, 0.3 * head), page_ms)
    assert [sensing.link.page_ms_of(frame.capture_ns, head) for head in (0, 1)] == [70.0, 60.0]
    assert sensing.link.page_ms_of(frame.capture_ns - 5 * NS_PER_MS, 0) == 50.0


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with trying(tmp_path_factory.mktemp("two"), "--scene", "room", config=FOUR) as address:
        yield address


def test_two_pages_are_served_until_one_leaves(url: str) -> None:
    places = [eyes(0.6, y_m).tolist() for y_m in (0.0, 0.28, -0.3)]
    with Client(url) as first:
        clients = [first]

        def heads(field: str) -> list[Any]:
            for client, place in zip(clients, places, strict=False):
                client.look()
                client.say(eyes=place, page_ms=time.monotonic() * 1e3)
            return sorted(one.get("head", 0) for one in first.refresh.get(field, []) if one.get("head", 0) is not None)

        with ExitStack() as others:
            clients += [others.enter_context(Client(url)) for _ in range(2)]
            assert first.until(lambda _: heads("people") == [0, 1])
            for one in first.refresh["people"]:
                assert off_m(one["eyes_m"], places[one["head"]]) < 2e-3
            assert first.until(lambda _: len(heads("solved_for")) == 2)
            del clients[1:]
        assert first.until(lambda _: heads("people") == [0])


def picture(url: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(url.split(",")[1]))).convert("RGB"), np.float64) / 255


@pytest.mark.slow
def test_each_page_shows_its_own_person_s_picture_in_a_browser(tmp_path: Path) -> None:
    needs_chromium()
    with trying(tmp_path, "--scene", "room", config=FOUR) as address:
        found = driven("two.mjs", address, os.environ.get("PHASESTACK_SCREENSHOTS") or tmp_path)
    assert [what for what in TRIED if found.get(what) is not True] == []
    with PairPainter("room", STACK) as painter:
        pairs = [painter.pair("room", np.array(found[f"{one} eyes"]), off_mm=()) for one in ("first", "second")]
    targets = [pair.images[0] / 255 for pair in pairs]
    for own, what in ((0, "first"), (1, "second"), (1, "the second's, on the first page")):
        db = [psnr_db(float(np.mean((picture(found[what]) - target) ** 2))) for target in targets]
        assert db[own] > db[1 - own] + 6, (what, db)
    assert found["elsewhere"] == [] and found["errors"] == []
