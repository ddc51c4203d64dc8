"""What a network is given, and where its answer goes, by rays that are traced from the eyes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.clock import Stopwatch
from runtime.kernels import FULL
from runtime.model.chain import ChainFrame, chain_frame
from runtime.model.job import Job, SolveWindow, Targets, drawn_job, drawn_views
from runtime.model.proposal import INPUTS, ChainProposal, tapered
from runtime.optics.malus import phase_from_intensity
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import F64
from tests.model.scenes import eyes

STACK = PanelStack(0.48, 0.24, (-0.06, 0.0, 0.06), 480, 240)  # pixels of 1 mm
WINDOW = SolveWindow(PixelRect(96, 96, 224, 176), PixelRect(112, 104, 208, 168), (24.0, 0.0))
EVEN = FULL // 2


class Session:
    """A network that answers with a slope over its raster: 2 for each column, and 3 for each row."""

    contract = SimpleNamespace(cell_px=4, reduction=2, branch=2)
    check = 0.0

    def run(self, feeds: dict[str, Any], shapes: dict[str, Any]) -> dict[str, Any]:
        assert tuple(feeds) == INPUTS
        self.feeds = feeds
        rows, cells, size = shapes["rear"]
        columns = np.arange(cells * (width := feeds["cell_waves"].shape[0])) + 0.5
        slope = 2 * columns + 3 * (np.arange(rows)[:, None] + 0.5)
        slope = np.repeat(slope.reshape(rows, cells, width), size // width, axis=2)
        return {"rear": slope.astype(np.int16), "front": (4000 - slope).astype(np.int16), "check": self.check}


def asked(job: Job, session: Any = None) -> tuple[dict[int, Any], Any, Session]:
    session = session or Session()
    geometry = job.targets.visible if job.window is None else job.targets.within(job.window)
    return ChainProposal(session).panels(job, geometry, Stopwatch()), geometry, session


def brighter(job_eyes: F64, *, channels: int = 3, window: SolveWindow | None = None) -> Job:
    """Each eye's picture gets brighter to the right and down, the second eye's half as fast."""
    v, u = np.mgrid[:240, :480] + 0.5
    pictures = [np.rint(20 + (u + v) / step).astype(np.uint8)[..., None].repeat(4, 2) for step in (3.2, 6.4)]
    return replace(drawn_job(pictures, job_eyes, STACK), channels=channels, window=window)


Case = tuple[F64, Any, ChainFrame, Any]  # eyes, window, the raster, and the map of (y, z) to the raster's frame


def cases() -> dict[str, Case]:
    level, lying = eyes(0.6, 0.03, 0.02), np.array([[0.6, 0.0, 0.031], [0.6, 0.0, -0.031]])
    how: Any = {"most_cell_px": 4, "reduction": 2}
    at_m = np.array([-0.08, -0.016])  # of the window's middle
    own = PanelStack(0.128, 0.08, STACK.x_m, 128, 80)
    turned = np.stack([lying[:, 0], -lying[:, 2], -lying[:, 1]], axis=1)
    return {
        "level": (level, None, chain_frame(level, STACK, **how), lambda p: p),
        "second eye on the left": (level[::-1].copy(), None, chain_frame(level, STACK, **how), lambda p: p),
        "in a window": (level, WINDOW, chain_frame(level - (0, *at_m), own, **how), lambda p: p - at_m),
        "one above the other": (lying, None, chain_frame(turned, STACK.transposed(), **how), lambda p: -p[..., ::-1]),
    }


CASES = cases()


def crossing(point: F64, eye_m: F64, *, x_m: float, to_x_m: float) -> F64:
    """Where rays from an eye through points (..., 2) on one plane cross another."""
    return eye_m[1:] + (point - eye_m[1:]) * (to_x_m - eye_m[0]) / (x_m - eye_m[0])


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("case", CASES)
def test_an_answer_is_laid_on_the_outer_panels_along_middle_rays(case: str, channels: int) -> None:
    pair, window, frame, to_local = CASES[case]
    found, geometry, _ = asked(brighter(pair, channels=channels, window=window))
    assert sorted(found) == [0, 2]
    raster_from_plane = np.linalg.inv(frame.plane_from_raster)
    for n, answer in ((0, lambda slope: slope), (2, lambda slope: 4000 - slope)):
        box = geometry.boxes[n]
        v, u = np.mgrid[box.v0 : box.v1, box.u0 : box.u1] + 0.5
        point = to_local(np.stack([u / 1000 - 0.24, 0.12 - v / 1000], axis=-1))
        seen = crossing(point, frame.middle_m, x_m=STACK.x_m[n], to_x_m=frame.x_m)
        column, row, _ = np.moveaxis(
            np.concatenate([seen, np.ones((*seen.shape[:2], 1))], -1) @ raster_from_plane.T, 2, 0
        )
        wanted = answer(2 * (column + frame.cell_px) + 3 * row)  # the answer begins one parallax earlier
        inner = (column > 1) & (column < frame.width_px - 1) & (row > 1) & (row < frame.rows - 1)
        if window is not None:  # within its taper of 24 pixels
            inner &= (u > 150) & (u < 170)
        assert found[n].shape == ((*u.shape, 3) if channels == 3 else u.shape)
        assert inner.mean() > (0.1 if window else 0.9)
        assert np.abs(found[n].reshape(*u.shape, -1) - wanted[..., None])[inner].max() < 2


@pytest.mark.parametrize("case", CASES)
def test_a_network_sees_half_the_difference_along_each_eye_s_rays(case: str) -> None:
    pair, window, frame, to_local = CASES[case]
    _, _, session = asked(brighter(pair, window=window))
    order = (1, 0) if case == "second eye on the left" else (0, 1)
    v, u = np.mgrid[: frame.rows, : frame.width_px] + 0.5
    at = np.stack([u, v, np.ones_like(u)], axis=-1) @ frame.plane_from_raster.T
    for name, view in zip(("left", "right"), order, strict=True):
        eye_m = np.array([pair[view, 0], *to_local(pair[view, 1:])])
        local = crossing(at[..., :2], eye_m, x_m=frame.x_m, to_x_m=0.0)
        y_m, z_m = np.moveaxis(-local[..., ::-1] if "above" in case else local - to_local(np.zeros(2)), -1, 0)
        inner = (abs(y_m) < 0.2) & (abs(z_m) < 0.1)
        place_px = (y_m + 0.24) * 1000 + (0.12 - z_m) * 1000
        own, other = (phase_from_intensity((20 + place_px / step) / 255, 2) * FULL for step in (3.2, 6.4))
        half = (own - other) / 2 * (1, -1)[view]
        off = (session.feeds[name].reshape(frame.rows, frame.width_px, 3) - half[..., None])[inner]
        assert inner.mean() > 0.6
        assert np.abs(off).max() < 16 and -0.65 < off.mean() < 0.15  # of whole numbers, rounded down


def test_where_an_eye_has_no_picture_there_is_no_difference() -> None:
    """Its edge goes on for a fortieth of its smaller side, and what is sharpened spreads by another column."""
    part = SolveWindow(PixelRect(100, 80, 380, 160), PixelRect(100, 80, 380, 160), (0.0, 0.0))
    pictures = [np.full((80, 280, 4), code, np.uint8) for code in (90, 160)]
    job = Job(Targets(STACK, eyes(0.6), drawn_views(pictures, STACK, part)), channels=1)
    _, _, session = asked(job)
    frame = chain_frame(job.eyes_m, STACK, most_cell_px=4, reduction=2)
    v, u = np.mgrid[: frame.rows, : frame.width_px] + 0.5
    at = np.stack([u, v, np.ones_like(u)], axis=-1) @ frame.plane_from_raster.T
    point = crossing(at[..., :2], job.eyes_m[0], x_m=frame.x_m, to_x_m=0.0)
    past_px = np.maximum(abs(point[..., 0]) - 0.14, abs(point[..., 1]) - 0.04) * 1000
    given = session.feeds["left"].reshape(past_px.shape)
    first, second = phase_from_intensity(np.array([90, 160]) / 255, 2) * FULL / 2
    assert np.abs(given[past_px < -2] - (first - second)).max() <= 1
    assert (past_px > 4.5).sum() > 1000 and (given[past_px > 4.5] == 0).all()
    assert (np.abs(given[(past_px > 0) & (past_px < 1.5)]) > 50).all()


def test_one_eye_for_both_is_solved_on_a_level_raster() -> None:
    found, _, session = asked(brighter(eyes(0.6)[[0, 0]]))
    rows, cells, size = session.feeds["left"].shape
    assert (rows, size) == (120, 12) and 48 <= cells <= 96 and sorted(found) == [0, 2]


def test_panels_fade_to_rest_at_a_window_s_edges() -> None:
    geometry = brighter(eyes(1e6), window=WINDOW).targets.within(WINDOW)  # from so far away, all panels coincide
    codes = np.full((80, 128, 3), 4000, np.int16)
    found = tapered(codes, 0, geometry)
    # The window's kept part begins 16 pixels inside the box, and the taper is 24 pixels wide.
    weights = (np.array([0.0, 0.0, 0.5, 1.5, 23.5, 24.0, 23.5, 0.5, 0.0]) / 24)[:, None]
    wanted = EVEN + (4000 - EVEN) * weights
    assert np.abs(found[40, [0, 15, 16, 17, 39, 60, 88, 111, 112]] - wanted).max() <= 0.6
    assert (found[:, 60] == 4000).all()  # there is no taper down
    assert np.abs(tapered(codes[..., 0], 2, geometry) - found[..., 0]).max() <= 1
    assert tapered(codes, 1, geometry) is codes  # the middle panel
    assert tapered(codes, 0, replace(geometry, taper_px=(0.0, 0.0))) is codes
    high = tapered(codes, 0, replace(geometry, taper_px=(0.0, 16.0)))
    assert (high[24:56] == 4000).all() and np.abs(high[[8, 71], 60] - EVEN - (4000 - EVEN) / 32).max() <= 0.6


def test_answers_are_limited_to_a_panel_s_range() -> None:
    class Extreme(Session):
        def run(self, feeds: dict[str, Any], shapes: dict[str, Any]) -> dict[str, Any]:
            values = super().run(feeds, shapes)
            return values | {"rear": np.full(shapes["rear"], -900, np.int16), "front": values["front"] * 0 + 9000}

    found, _, _ = asked(brighter(eyes(0.6)), Extreme())
    assert (found[0][60:180, 100:380] == 0).all() and (found[2][60:180, 100:380] == FULL).all()
