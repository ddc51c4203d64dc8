"""The order of a solution's operations, recorded by a device that computes nothing."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.model import solver
from runtime.model.contract import Step
from runtime.model.geometry import Geometry
from runtime.model.job import Job, SolveWindow, Targets, drawn_job, drawn_views
from runtime.model.solver import StepPredictor, enlarged
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

STACK = PanelStack(0.4, 0.25, (-0.02, 0.0, 0.02), 320, 200)
PAIR = eyes(0.6)
STEPS = (Step(size=1.5), Step(size=1.1))
BOX = PixelRect(80, 40, 240, 160)
WINDOW = SolveWindow(BOX, PixelRect(96, 48, 224, 152), (12.0, 0.0), (250, 0, 0))


class Device:
    """A backend, a state and a solution in one, which notes what it is told to do."""

    name = "cpu"

    def __init__(self) -> None:
        self.told: list[Any] = []
        self.context: object = object()
        self.states: list[tuple[int, int]] = []

    def state(self, stack: PanelStack, *, threads: int) -> Device:
        self.states.append((stack.width_px, stack.height_px))
        return self

    @contextmanager
    def begin(self, job: Job, geometry: Geometry, *, resumed: bool = False) -> Iterator[Device]:
        self.job, self.geometry = job, geometry
        self.told.append(f"{'resume' if resumed else 'begin'} {job.stack.width_px}")
        yield self

    def set_panel(self, panel: int, codes: Any) -> None:
        assert codes.shape[:2] == self.panel(panel).shape[:2]
        self.told.append(f"set {panel}")

    def panel(self, panel: int) -> Any:
        box = self.geometry.boxes[panel]
        return np.full((box.height_px, box.width_px, self.job.channels), 16 * 51 * (panel + 1), np.int16)

    def __getattr__(self, name: str) -> Any:
        """Note `close_middle`, `start`, `step`, `write` and `close`."""
        return lambda *given: self.told.append(
            (given[0].size, given[0].places) if name == "step" else " ".join([name, *map(str, given[1:])])
        )

    def lately(self) -> list[Any]:
        """What it was told since the last call."""
        told, self.told = self.told, []
        return told


class Network:
    """A proposal for both outer panels."""

    any_raster = True
    session = SimpleNamespace(provider="cuda", contract=SimpleNamespace(parameters=7, precision="fp16"))

    def panels(self, job: Job, geometry: Geometry, watch: Any) -> dict[int, Any]:
        boxes = geometry.boxes[0], geometry.boxes[2]
        return {n: np.zeros((b.height_px, b.width_px, 3), np.int16) for n, b in zip((0, 2), boxes, strict=True)}


def model(proposal: Any, device: Device, steps: tuple[Step, ...] = STEPS) -> StepPredictor:
    return StepPredictor(STACK, proposal, steps, name="mine", backend=device)  # type: ignore[arg-type]


def job(views: int = 2, *, points: int = 1, pair: Any = PAIR, **change: Any) -> Job:
    at = np.concatenate([pair] * 3)[:views]
    pictures = [np.full((200, 320, 4), 90, np.uint8)] * views
    return replace(Job(Targets(STACK, at, drawn_views(pictures, STACK), points)), **change)


PROPOSED = ["begin 320", "set 0", "set 2", "close_middle", "start"]
OWN = [(1.5, "middle"), (1.1, "middle")]
REFINED = [(0.8, "falling"), (0.8, "rising")]


@pytest.mark.parametrize(
    ("own", "steps", "told"),
    [(2, None, OWN), (2, 0, []), (2, 1, OWN[:1]), (2, 5, OWN + REFINED + REFINED[:1]), (1, 3, OWN[:1] + REFINED)],
)
def test_a_model_s_steps_follow_its_proposal_then_refining_ones(own: int, steps: int | None, told: list[Any]) -> None:
    device = Device()
    found = model(Network(), device, STEPS[:own]).solve(job(steps=steps))
    assert device.told == [*PROPOSED, *told, "write 128"]
    assert (found.steps, found.continued_from, found.floats) == (len(told), None, None)
    assert set(found.stage_ms) == {"prepare", "inference", "finish", "step"}


@pytest.mark.parametrize(("deadline_ns", "steps"), [(99, 0), (100, 0), (101, 1), (110, 1), (111, 2)])
def test_no_step_begins_at_its_deadline_or_later(deadline_ns: int, steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter(range(100, 200, 10))
    monkeypatch.setattr(solver, "perf_counter_ns", lambda: next(times))
    assert model(Network(), Device()).solve(job(deadline_ns=deadline_ns)).steps == steps


def test_a_solution_goes_on_from_the_last_one_of_the_same_rays() -> None:
    device = Device()
    ours = model(Network(), device)
    again = job(continued=True, steps=3)
    assert (ours.solve(again).steps, ours.solve(again).continued_from) == (3, 3)
    device.lately()
    assert ours.solve(replace(again, steps=4)).continued_from == 3
    assert device.lately() == ["resume 320", REFINED[1], "write 128"]
    moved = replace(again, targets=replace(again.targets, eyes_m=PAIR + 1e-3))
    for other in (replace(again, channels=1), again, moved, again, replace(again, continued=False)):
        assert ours.solve(other).continued_from is None
        assert device.lately()[0] == "begin 320"
    assert ours.solve(again).continued_from == 3
    ours.solve(replace(again, window=SolveWindow(PixelRect(0, 0, 0, 0), PixelRect(0, 0, 0, 0), (0.0, 0.0))))
    assert ours.solve(again).continued_from is None


@pytest.mark.parametrize(
    ("window", "told", "steps"),
    [
        (WINDOW, [*PROPOSED, *OWN, "write (250, 0, 0)"], 2),
        (replace(WINDOW, colour=None), ["begin 320", "close_middle", "write 128", *PROPOSED, *OWN, "write None"], 2),
        (replace(WINDOW, box=PixelRect(0, 0, 0, 0)), ["begin 320", "close_middle", "write 128"], 0),
    ],
)
def test_outside_a_window_is_its_colour_or_what_both_eyes_see(window: Any, told: list[Any], steps: int) -> None:
    device = Device()
    found = model(Network(), device).solve(job(window=window, floats=True))
    assert device.told == told
    assert (found.steps, found.floats) == (steps, None)
    if steps:
        assert device.geometry.boxes == (BOX,) * 3 and device.geometry.kept == window.kept


def test_unrounded_layers_are_the_panels_values() -> None:
    floats = model(Network(), Device()).solve(job(pair=eyes(0.1), floats=True)).floats
    assert floats is not None and floats.shape == (3, 200, 320, 3)
    assert floats[:, 100, 160] == pytest.approx(np.array([[0.2] * 3, [0.4] * 3, [0.6] * 3]))
    assert floats[2, 0, 0] == pytest.approx(np.ones(3))  # outside the front panel's box


def test_without_a_network_coarser_rasters_are_solved_first() -> None:
    device = Device()
    ours = model(None, device)
    found = ours.solve(job())
    begun = [n for n, told in enumerate(device.told) if str(told).startswith("begin")]
    assert [device.told[n] for n in begun] == ["begin 80", "begin 160", "begin 320"]  # 40 x 25 pixels are too few
    first, second, last = (device.told[a:b] for a, b in zip(begun, [*begun[1:], None], strict=True))
    assert first[1:3] == ["close_middle", "start"]
    assert second[1:5] == last[1:5] == ["set 0", "set 1", "set 2", "start"]
    turns = ["rising", "middle", "falling", "middle"]
    for coarse, begin in ((first, 3), (second, 5)):
        assert len(coarse) > begin + 8
        assert [places for _, places in coarse[begin : begin + 8]] == turns * 2
    assert last[5:] == [*OWN, "write 128"]
    assert found.steps == 2
    device.lately()
    for side_px, first in ((62, "begin 100"), (64, "begin 50")):  # a raster has at least 32 rows and columns
        small = replace(STACK, width_px=100, height_px=side_px)
        grey = [np.full((side_px, 100, 4), 90, np.uint8)] * 2
        StepPredictor(small, None, STEPS, name="mine", backend=device).solve(drawn_job(grey, PAIR, small))  # type: ignore[arg-type]
        told = device.lately()
        assert told[:3] == [first, "close_middle", "start"]


@pytest.mark.parametrize("views", [1, 3, 4])
def test_a_network_serves_two_views_alone(views: int) -> None:
    device = Device()
    ours = model(Network(), device)
    assert ours.solve(job(views)).steps == 6
    assert device.told[0] == "begin 80"
    sizes, places = zip(*device.told[-7:-1], strict=True)
    assert sizes == (1.2, 1.2, 1.2, 1.2, 0.8, 0.8)
    assert places == ("rising", "middle", "falling", "middle", "rising", "middle")
    assert ours.name_with(views) == "mine (without its network: needs two views)"
    assert ours.name_with(2) == model(None, device).name_with(views) == "mine"


def test_points_of_the_pupils_have_two_eyes_each_and_steps_of_their_own() -> None:
    device = Device()
    model(Network(), device).solve(job(4, points=2))
    assert device.told[:5] == PROPOSED
    steps = device.told[5:-1]
    assert [places for _, places in steps] == ["rising", "falling"] * 8
    assert [size for size, _ in steps[::5]] == pytest.approx([1.3, 1.3 - 0.5 / 3, 1.3 - 1 / 3, 0.8])


@pytest.mark.parametrize(("of", "u0"), [(2, 40), (4, 16), (1, 0)])
def test_coarse_panels_are_enlarged_in_place(of: int, u0: int) -> None:
    """Values that are sixteenths of their column and row stay so, whatever the boxes."""
    fine = replace(job().targets.visible, boxes=(PixelRect(u0, 8, 240, 160),) * 3)
    coarse = replace(fine, stack=STACK.reduced(of), boxes=(PixelRect(u0 // of // 2, 2, 240 // of, 160 // of),) * 3)
    box = coarse.boxes[0]
    rows, columns = np.mgrid[box.v0 : box.v1, box.u0 : box.u1] + 0.5
    codes = np.stack([16 * of * columns, 16 * of * rows], axis=-1).astype(np.int16)
    found = enlarged(codes, 0, coarse, fine)
    rows, columns = np.mgrid[8:160, u0:240] + 0.5
    off = np.abs(found - np.stack([16 * columns, 16 * rows], axis=-1))[of:-of, of:-of]
    assert found.shape == (152, 240 - u0, 2) and off.max() <= 1


def test_what_a_model_can_do_follows_from_its_proposal() -> None:
    device, fixed = Device(), Network()
    fixed.any_raster = False
    facts = [
        (m.has_devices, m.trims, m.reductions, m.provider, m.parameters, m.precision)
        for m in (model(Network(), device).facts, model(fixed, device).facts, model(None, device).facts)
    ]
    assert facts == [
        (True, True, (1, 2, 3, 4), "cuda", 7, "fp16"),
        (False, False, (1,), "cuda", 7, "fp16"),
        (True, False, (1, 2, 3, 4), "cpu", 0, "fp32"),
    ]
    few, many = model(None, device).facts, model(None, device, STEPS * 5).facts
    assert [(few.steps, few.refined_steps), (many.steps, many.refined_steps)] == [(2, 8), (10, 10)]
    model(fixed, device).solve(job())
    assert device.geometry.boxes == (PixelRect(0, 0, 320, 200),) * 3  # whole panels


def test_a_device_is_shared_asked_once_for_each_raster_and_closed() -> None:
    device, other = Device(), Device()
    ours = model(Network(), device)
    for _ in range(2):
        ours.solve(job())
    assert device.states == [(320, 200)]
    assert ours.reads_textures_of(device.context) and not ours.reads_textures_of(other.context)
    device.context = None
    assert not ours.reads_textures_of(None)
    for moved in (ours.bound(backend=other), ours.bound(backend=other, stack=STACK.reduced(2)).bound()):  # type: ignore[arg-type]
        moved.solve(job())
        assert other.lately()[:5] == PROPOSED
    assert moved.stack.width_px == 160
    device.lately()
    for _ in range(2):
        ours.close()
    assert device.told == ["close"]
