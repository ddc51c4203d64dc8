"""The processor's steps: they are those of the reference in torch, and light gets better by them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from model_export.light import Views, step
from runtime.config import ModelSettings
from runtime.kernels import FULL, SUBCODE
from runtime.model.contract import Places, Step
from runtime.model.cpu import CpuSolution, CpuState
from runtime.model.job import Job, Targets, drawn_job, drawn_views
from runtime.model.predictor import load_predictor
from runtime.model.solver import StepPredictor, steps_from_even
from runtime.model.still import captured_views, solve_still
from runtime.model.targets import rest_of, target_table
from runtime.optics.carried import expected_psnrs_db
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64, U8
from tests.model.scenes import FOV_DEG, card_scene, eyes

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
TILTED = replace(STACK, tilt=Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05)))
STACKS = {
    "two": replace(STACK, x_m=(-0.03, 0.03)),
    "three": STACK,
    "tilted": TILTED,
    "uneven": replace(STACK, x_m=(-0.05, 0.0, 0.02)),
    "four": replace(STACK, x_m=(-0.06, -0.02, 0.02, 0.06)),
    "five": replace(STACK, x_m=(-0.06, -0.03, 0.0, 0.03, 0.06)),
    "six": replace(STACK, x_m=(-0.06, -0.04, -0.01, 0.01, 0.03, 0.06)),
    "front without filters": replace(STACK, colour=(True, True, False)),
    "only the rear with filters": replace(STACK, x_m=(-0.06, -0.02, 0.02, 0.06), colour=(True, False, False, False)),
}
PAIRS = {
    "in front": (eyes(0.6, 0.05, 0.1), False),
    "own rays": (eyes(0.6, 0.05, 0.1), True),
    "own rays, far aside": (eyes(0.4, 0.5, -0.2, roll_deg=20), True),
}
# Of all pixels, that are within a fiftieth: the rest lies where a ray just meets an edge, or hardly any slope is left.
MANY = {"in front": 0.999, "own rays": 0.999, "own rays, far aside": 0.85}
torch.set_num_threads(1)  # its pool spins, beside the suite's other workers


def smooth(seed: int, channels: int) -> U8:
    """(270, 480, 3) random, smooth, over the whole range."""
    image = cv2.GaussianBlur(np.random.default_rng(seed).random((270, 480, 3)), (0, 0), 2.0)
    image = image if channels == 3 else image[..., :1].repeat(3, 2)
    return np.rint(255 * np.clip(0.5 + 3 * (image - 0.5), 0, 1)).astype(np.uint8)


def begun(
    stack: PanelStack, pair: F64, *, own: bool, channels: int = 3, threads: int = 2, points: int = 1
) -> tuple[CpuSolution, Job, Any]:
    """A solution with random panels, and what it was begun for."""
    pictures = [smooth(8 + seed, channels) for seed in range(len(pair))]
    views = captured_views(pictures, pair, stack, fov_deg=FOV_DEG) if own else drawn_views(pictures, stack)
    job = Job(Targets(stack, pair, views, points), channels=channels, eye_sigma_m=5e-3)
    state, geometry = CpuState(stack, threads=threads), job.targets.visible
    with state.begin(job, geometry) as solving:
        for n, box in enumerate(geometry.boxes):
            panel = cv2.resize(smooth(n, channels), (box.width_px, box.height_px)).astype(np.int16) * SUBCODE
            solving.set_panel(n, panel if channels == 3 else panel[..., 0])
        solving.start()
    return solving, job, geometry


def panels_of(solving: CpuSolution, geometry: Any) -> list[Any]:
    """(rows, columns, channels) values of each panel's box."""
    return [solving.panel(n) for n in range(len(geometry.boxes))]


@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize("pair", PAIRS)
@pytest.mark.parametrize("channels", [1, 3])
def test_steps_are_the_references(stack: str, pair: str, channels: int) -> None:
    if channels == 3 or not STACKS[stack].colour:
        compare_with_reference(STACKS[stack], *PAIRS[pair], channels=channels, many=MANY[pair])


@pytest.mark.parametrize("views", [1, 4, 8])
@pytest.mark.parametrize("stack", ["four", "six", "only the rear with filters"])
def test_steps_for_any_number_of_views_are_the_references(stack: str, views: int) -> None:
    at = np.concatenate([eyes(0.6, side_m) for side_m in (-0.15, 0.15, 0.0, 0.25)])[:views]
    compare_with_reference(STACKS[stack], at, True, channels=3, many=0.98)


def test_steps_for_points_of_the_pupils_are_the_references() -> None:
    at = np.concatenate([eyes(0.6, side_m, side_m) for side_m in (-0.001, 0.001)])
    compare_with_reference(STACK, at, False, channels=3, many=0.999, points=2)


def compare_with_reference(
    stack: PanelStack, at: F64, own: bool, *, channels: int, many: float, points: int = 1
) -> None:
    count = stack.count
    solving, job, geometry = begun(stack, at, own=own, channels=channels, points=points)
    boxes, rays = geometry.boxes, geometry.rays
    # The reference has one size for all panels: each lies in the first corner of the largest.
    height, width = (max(getattr(box, name) for box in boxes) for name in ("height_px", "width_px"))
    last = torch.zeros(count, channels, height, width, dtype=torch.float64)
    for n, panel in enumerate(panels_of(solving, geometry)):
        last[n, :, : panel.shape[0], : panel.shape[1]] = torch.from_numpy(panel.astype(np.float64) / FULL).movedim(
            -1, 0
        )
    pictures = [view.pixels for view in job.views]
    targets = torch.from_numpy(np.stack([p[rays.slices][..., :channels] for p in pictures]) / 255.0).movedim(-1, 1)
    ahead = last
    alike = len({(box.width_px, box.height_px) for box in boxes}) == 1
    sequence: tuple[tuple[float, Places], ...] = ((1.6, "middle"), (1.2, "rising"), (1.2, "falling"))[
        : 2 + (points > 1)
    ]
    for size, places in sequence:
        sets = geometry.ray_sets(places, job.eye_sigma_m)
        matrices = torch.from_numpy(sets.panels_from_rays)
        views = Views(matrices, rays.width_px, rays.height_px // sets.turns, sets.views, sets.turn)
        grey = [n for n in range(count) if stack.is_grey(n)]
        last, ahead = step(last, ahead, targets, views, size=size, momentum=0.5, grey=grey)
        solving.step(Step(size=size, momentum=0.5, places=places))
    for n, panel in enumerate(panels_of(solving, geometry)):
        edge = 0 if alike else 8  # beside a smaller panel the reference sees what is not there
        rows, columns = slice(edge, panel.shape[0] - edge), slice(edge, panel.shape[1] - edge)
        off = np.abs(panel / FULL - last[n, :, : panel.shape[0], : panel.shape[1]].movedim(0, -1).numpy())[
            rows, columns
        ]
        assert np.median(off) < (1e-2 if many < 0.9 else 2e-3)
        assert (off < 2e-2).mean() > many, np.quantile(off, [0.9, 0.99, 0.999])


@pytest.mark.parametrize(
    ("pair", "own"), [(eyes(0.4, 0.3, roll_deg=20), True), (eyes(0.2), False), (eyes(0.25, 0.1, -0.1), False)]
)
def test_threads_share_a_step_without_a_trace(pair: F64, own: bool) -> None:
    """Nor does what the threads' memory held before."""
    found = []
    for threads in (1, 3):
        before, _, _ = begun(STACK, eyes(0.9, 0.2 * threads), own=True, threads=threads)
        before.step(Step(size=1.0, places="rising"))
        solving, _, geometry = begun(TILTED, pair, own=own, threads=threads)
        for places in ("rising", "falling"):
            solving.step(Step(size=1.6, places=places))  # type: ignore[arg-type]
        solving.close_middle()
        found.append(panels_of(solving, geometry))
    assert all((one == other).all() for one, other in zip(*found, strict=True))


@pytest.mark.parametrize("stack", ["two", "three", "five"])
def test_the_middle_panel_closes_on_one_eye_s_target(stack: str) -> None:
    pair = eyes(0.6)[[0, 0]]
    _, job, geometry = begun(STACKS[stack], pair, own=False)
    middle, count = geometry.middle, STACKS[stack].count
    same = replace(job, targets=replace(job.targets, views=(job.views[0], job.views[0])))
    with CpuState(STACKS[stack], threads=2).begin(same, geometry) as solving:
        solving.close_middle()
    wanted = target_table(count)[:, 0][job.views[0].pixels[geometry.rays.slices][..., :3]] - (count - 1) * rest_of(
        count
    )
    off = np.abs(panels_of(solving, geometry)[middle] - np.clip(wanted, 0, FULL))
    assert np.median(off) <= 3
    assert off.max() <= 32  # of rays that miss a panel, which weigh little in 16 bits


def test_a_ray_that_misses_a_panel_leaves_it_to_another() -> None:
    _, job, geometry = begun(STACK, eyes(0.3), own=False)
    codes = 90, 160
    plain = [np.full_like(view.pixels, code) for view, code in zip(job.views, codes, strict=True)]
    evenly = replace(job, targets=replace(job.targets, views=drawn_views(plain, STACK)))
    with CpuState(STACK, threads=2).begin(evenly, geometry) as solving:
        solving.close_middle()
    rays, found = geometry.rays, panels_of(solving, geometry)[geometry.middle][..., 0]
    at = np.stack([*np.meshgrid(np.arange(rays.width_px) + 0.5, np.arange(rays.height_px) + 0.5), np.ones(found.shape)])
    crosses = []
    for matrices in geometry.ray_sets("middle", 0.0).panels_from_rays:
        ends = [np.tensordot(matrix, at, 1) for matrix in matrices]
        boxes = zip(ends, geometry.boxes, strict=True)
        within = [(x > 0) & (x < b.width_px * w) & (y > 0) & (y < b.height_px * w) for (x, y, w), b in boxes]
        crosses.append(np.all(within, axis=0))
    wanted = [target_table(3)[code, 0] - 2 * rest_of(3) for code in codes]
    for side in (0, 1):
        alone = crosses[side] & ~crosses[1 - side]
        assert alone.sum() > 1000
        assert np.abs(found[alone] - wanted[side]).max() < 0.12 * abs(wanted[1] - wanted[0])


def test_many_steps_with_momentum_do_not_diverge() -> None:
    solving, _, geometry = begun(STACK, eyes(0.6), own=True)
    changes = []
    for _ in range(60):
        before = [panel.copy() for panel in panels_of(solving, geometry)]
        solving.step(Step(size=1.3, momentum=0.6))
        after = panels_of(solving, geometry)
        changes.append(np.mean([np.abs(a.astype(int) - b).mean() for a, b in zip(after, before, strict=True)]))
    assert changes[-1] < 0.05 * changes[0]


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["even", "tilted"])
@pytest.mark.parametrize("sigma_mm", [0.0, 1.0])
def test_every_step_makes_light_better(stack: PanelStack, sigma_mm: float) -> None:
    pair, found_db = eyes(0.6, 0.05, 0.1), []
    pictures = [card_scene(eye) for eye in pair]
    solver = load_predictor("best", stack, ModelSettings(threads=2))
    job = Job(Targets(stack, pair, captured_views(pictures, pair, stack, fov_deg=FOV_DEG)), eye_sigma_m=sigma_mm / 1e3)
    for count in (0, 1, 3, solver.facts.steps):
        layers = solver.solve(replace(job, steps=count)).layers
        light_db = expected_psnrs_db(layers, pictures, stack, eyes_m=pair, fov_deg=FOV_DEG, sigmas_mm=[sigma_mm])
        found_db.append(light_db[sigma_mm])
    assert found_db == sorted(found_db)
    assert found_db[-1] > found_db[0] + 2


@pytest.mark.parametrize(
    "stack", [name for name in STACKS if name not in ("three", "tilted", "only the rear with filters")]
)
def test_panels_that_begin_even_show_both_eyes_a_picture(stack: str) -> None:
    pair = eyes(0.6)
    pictures = [card_scene(eye) for eye in pair]
    solver = StepPredictor(STACKS[stack], None, steps_from_even(3), name="even")
    how: Any = {"eyes_m": pair, "fov_deg": FOV_DEG}
    layers = solve_still(*pictures, **how, predictor=solver, eye_sigma_mm=0.0).layers
    assert expected_psnrs_db(layers, pictures, STACKS[stack], **how, sigmas_mm=[0.0])[0.0] > 22


def test_grey_pictures_for_four_views_are_solved_in_one_channel() -> None:
    at = np.concatenate([eyes(0.6, side_m) for side_m in (-0.15, 0.15)])
    pictures = [card_scene(eye)[..., :1].repeat(3, 2) for eye in at]
    solver = load_predictor("fast", STACKS["four"])
    job = Job(
        Targets(STACKS["four"], at, captured_views(pictures, at, STACKS["four"], fov_deg=FOV_DEG)), eye_sigma_m=0.0
    )
    grey, colour = (solver.solve(replace(job, channels=channels)).layers.copy() for channels in (1, 3))
    assert np.abs(grey.astype(int) - colour).mean() < 1


def test_equal_grey_pictures_and_panels_that_show_them_stay() -> None:
    pair = eyes(0.6)
    grey = np.full((270, 480, 4), 128, np.uint8)
    job = drawn_job([grey, grey], pair, STACK)
    geometry = job.targets.visible
    with CpuState(STACK, threads=1).begin(job, geometry) as solving:
        solving.close_middle()
        solving.start()
        before = [panel.copy() for panel in panels_of(solving, geometry)]
        for _ in range(3):
            solving.step(Step(size=1.6))
    for panel, old in zip(panels_of(solving, geometry), before, strict=True):
        assert np.abs(panel.astype(int) - old).max() <= SUBCODE // 2


@pytest.mark.parametrize("sigma_mm", [0.0, 5.0])
@pytest.mark.parametrize("code", [0, 255])
def test_no_seam_is_seen_along_a_picture_s_edge(code: int, sigma_mm: float) -> None:
    pair, pictures = eyes(0.6), [np.full((270, 480, 3), code, np.uint8)] * 2
    predictor = load_predictor("fast", STACK)
    layers = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor, eye_sigma_mm=sigma_mm).layers
    predictor.close()
    light = expected_psnrs_db(layers, pictures, STACK, eyes_m=pair, fov_deg=FOV_DEG, sigmas_mm=(0.0,))
    assert light[0.0] > 60  # 40 to 46 where what lies a pixel beyond the edge rests at mid-grey
