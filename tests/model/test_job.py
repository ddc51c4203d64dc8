"""What reaches a solver: pictures' pixels and rays, options, and the eyes of trials."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.model.base import ModelFacts, trial_eyes_m, warm_up
from runtime.model.job import Job, SolveWindow, Targets, drawn_job, drawn_views, grey_job
from runtime.model.still import captured_views, solve_still
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from runtime.records import U8
from tests.model.scenes import eyes

STACK = PanelStack(0.4, 0.2, (-0.01, 0.0, 0.01), 400, 200)
PAIR = eyes(0.5)
FOV_DEG = 2 * float(np.degrees(np.arctan(0.2 / 0.5)))  # the panels' width at half a metre
WINDOW = SolveWindow(PixelRect(100, 40, 300, 160), PixelRect(110, 50, 290, 150), (6.0, 4.0))


class Model:
    """A model that keeps its jobs, and takes less and less time."""

    stack, facts = STACK, ModelFacts("kept", "numpy", trims=True, reductions=(1, 2, 4))

    def __init__(self) -> None:
        self.jobs: list[Job] = []

    def solve(self, job: Job, watch: Any = None) -> Any:
        self.jobs.append(job)
        ms = 100.0 - len(self.jobs)
        return SimpleNamespace(stage_ms={"step": ms, "finish": 2 * ms})


@pytest.mark.parametrize(
    ("width_px", "height_px", "found"),
    [
        (400, 200, (400, 200)),
        (630, 315, (630, 315)),
        (650, 325, (400, 200)),
        (246, 123, (246, 123)),
        (236, 118, (400, 200)),
        (80, 40, (320, 160)),  # no more than four pixels are made of one
    ],
)
def test_photographs_are_resized_to_the_panels_pixels(width_px: int, height_px: int, found: tuple[int, int]) -> None:
    picture = np.full((height_px, width_px, 3), 90, np.uint8)
    picture[:, : width_px // 2] = 200
    views = captured_views([picture, picture], PAIR * (1, 0, 1), STACK, fov_deg=FOV_DEG)
    for view in views:
        assert view.pixels.shape == (found[1], found[0], 3)
        assert (view.pixels[:, 2] == 200).all() and (view.pixels[:, -3] == 90).all()
        for (u, v), at_mm in (((0, 0), (-200, 100)), ((1, 1), (200, -100)), ((0.5, 0.25), (0, 50))):
            y, z, w = view.plane_from_picture @ (u * found[0], v * found[1], 1.0)
            assert np.array([y / w, z / w]) * 1000 == pytest.approx(at_mm, abs=1e-6)


@pytest.mark.parametrize(
    ("how", "trimmed"),
    [({}, False), ({"trimmed": True}, True), ({"trimmed": True, "floats": True}, False)],
)
def test_still_pictures_are_trimmed_if_that_is_asked_for(how: dict[str, Any], trimmed: bool) -> None:
    model, picture = Model(), np.full((200, 400, 4), 90, np.uint8)
    solve_still(picture, picture, eyes_m=PAIR, fov_deg=FOV_DEG, predictor=model, eye_sigma_mm=3.0, steps=5, **how)  # type: ignore[arg-type]
    job = model.jobs[0]
    assert (job.eye_sigma_m, job.steps, job.window is not None) == (0.003, 5, trimmed)
    assert job.floats == ("floats" in how) and job.views[0].pixels.shape == (200, 400, 3)
    solve_still(picture, eyes_m=PAIR[:1], fov_deg=FOV_DEG, predictor=model, trimmed=True)  # type: ignore[arg-type]
    model.facts = replace(model.facts, trims=False)
    solve_still(picture, picture, eyes_m=PAIR, fov_deg=FOV_DEG, predictor=model, trimmed=True)  # type: ignore[arg-type]
    assert [job.window for job in model.jobs[1:]] == [None, None]


def ramp(height_px: int = 200, width_px: int = 400) -> U8:
    return np.arange(height_px * width_px * 4, dtype=np.uint32).reshape(height_px, width_px, 4).astype(np.uint8)


def test_coarser_targets_keep_their_rays() -> None:
    targets = Targets(STACK, PAIR, drawn_views([ramp(), ramp()], STACK), points=1)
    coarse = replace(targets, points=3).on_raster(8)
    assert (coarse.stack.width_px, coarse.stack.height_px, coarse.points) == (50, 25, 3)
    view = coarse.views[1]
    assert view.pixels.shape == (25, 50, 4)
    assert np.abs(view.pixels[3, 5] - ramp()[24:32, 40:48].mean(axis=(0, 1))).max() <= 0.5
    assert view.plane_from_picture @ (5, 3, 1) == pytest.approx([-0.16, 0.076, 1])
    thin = Targets(STACK, PAIR, drawn_views([ramp(3, 400)] * 2, STACK)).on_raster(8).views[0]
    assert thin.pixels.shape == (1, 50, 4) and thin.plane_from_picture @ (0, 1, 1) == pytest.approx([-0.2, 0.097, 1])
    assert targets.reduced(2)[0].pixels.shape == (100, 200, 4) and targets.reduced(2) is targets.reduced(2)
    assert targets.reduced(4)[0].pixels.shape == (50, 100, 4)


def test_what_is_drawn_in_a_window_lies_there() -> None:
    views = drawn_views([ramp(120, 200)] * 2, STACK, WINDOW)
    assert views[0].plane_from_picture @ (0, 0, 1) == pytest.approx([-0.1, 0.06, 1])
    found = Targets(STACK, PAIR, views, 1).within(WINDOW)
    assert (found.boxes, found.kept, found.taper_px) == ((WINDOW.box,) * 3, WINDOW.kept, (6.0, 4.0))
    assert found.rays.corners == (10, 10, 190, 110)
    assert drawn_job([ramp()] * 2, PAIR, STACK).targets.every_pixel.boxes == (PixelRect(0, 0, 400, 200),) * 3


@pytest.mark.parametrize(("front_m", "distance_m"), [(0.01, 0.6), (0.1, 0.6), (0.3, 0.8)])
def test_trials_are_seen_from_a_usual_distance_to_all_panels(front_m: float, distance_m: float) -> None:
    found = trial_eyes_m(replace(STACK, x_m=(-0.01, 0.0, front_m)))
    assert found == pytest.approx(np.array([[distance_m, -0.031, 0.0], [distance_m, 0.031, 0.0]]))


def test_a_warm_up_solves_every_raster_and_keeps_the_shortest_times() -> None:
    model = Model()
    assert warm_up(model) == {  # type: ignore[arg-type]
        1: {"step": 98.0, "finish": 196.0}, 2: {"step": 95.0, "finish": 190.0}, 4: {"step": 91.0, "finish": 182.0},
    }  # fmt: skip
    assert [job.stack.width_px for job in model.jobs] == [400] * 2 + [200] * 3 + [100] * 4
    for job in (*model.jobs, grey_job(PAIR, STACK)):
        assert (job.views[1].pixels == 128).all() and job.views[0].pixels.shape[2] == 4
    assert {job.steps for job in model.jobs} == {1}
