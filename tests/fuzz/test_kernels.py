"""Kernels with random geometry: they end no process, and any number of threads computes the same values.

`make sanitize` builds them with sanitizers and tries thousands; FUZZ_FIRST is the first number.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from runtime import kernels
from runtime.kernels import FULL
from runtime.model.buffers import LayerPool
from runtime.model.contract import Step
from runtime.model.cpu import CpuState
from runtime.model.job import Job, SolveWindow, Targets, drawn_views
from runtime.model.still import captured_views
from runtime.model.warp import warp
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64, U8

FIRST = int(os.environ.get("FUZZ_FIRST", "0"))
EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "40"))
BATCH = 20  # geometries in a test
FOUND = [5005560, 69002240, 69003960]  # first numbers of tests that have failed: rounded mixtures were out of range
SIZES = [
    (1, 7),
    (7, 1),
    (1, 1),
    (33, 7),
    (333, 77),
    (64, 36),
    (480, 270),
    (1920, 30),
    (3840, 12),
    (40, 400),
    (192, 108),
]
PICTURES = [(16, 9), (1, 1), (1, 40), (40, 1), (8, 64), (320, 180), (33, 7), (640, 20), (3000, 3)]


@dataclass(frozen=True)
class Case:
    """One random geometry."""

    stack: PanelStack
    eyes_m: F64
    pictures: tuple[U8, ...]
    fov_deg: float | None  # None: drawn on the middle panel
    window: SolveWindow | None
    channels: int
    sigma_m: float
    seed: int


def case_of(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    count, (width, height) = int(rng.integers(2, 9)), SIZES[rng.integers(len(SIZES))]
    x_m = (np.arange(count) - (count - 1) / 2) * rng.choice([0.005, 0.03, 0.06, 0.5])
    if rng.random() < 0.2:
        x_m = np.sort(x_m + rng.uniform(-0.3, 0.3, count) * 0.005)
    tilt = None
    if rng.random() < 0.3:
        slopes = rng.uniform(-1, 1, (count, 3)) * [0.002, 0.2, 0.2]
        tilt = Tilt(tuple(map(tuple, slopes.tolist())), (float(x_m[-1]) + 0.6, 0.1, 0.0))
    size_m = float(rng.choice([0.1, 0.5, 2.0]))
    stack = PanelStack(size_m, size_m * float(rng.choice([0.2, 0.5625, 1.5])), tuple(x_m.tolist()), width, height, tilt)
    near_m = float(rng.choice([-0.03, 0.01, 0.05, 0.3, 0.7]))
    aside = rng.uniform(-1, 1, 2) * rng.choice([0, 0.1, 0.5, 2], 2)
    roll = np.radians(rng.choice([0, 0, 10, 45, 90, 180]))
    half_m = 0.031 * np.array([0, np.cos(roll), np.sin(roll)])
    middle_m = np.array([x_m[-1] + near_m, *aside])
    eyes_m = np.array([middle_m - half_m, middle_m + half_m])
    if rng.random() < 0.3:  # two people, or one eye
        eyes_m = np.concatenate([eyes_m, eyes_m + rng.uniform(-0.3, 0.3, 3)]) if rng.random() < 0.7 else eyes_m[:1]
    if rng.random() < 0.2:
        eyes_m[-1, 0] += rng.uniform(-0.5, 0.9) * abs(near_m)
    own = rng.random() < 0.7
    columns, rows = PICTURES[rng.integers(len(PICTURES))] if own else (width, height)
    pictures = tuple(rng.integers(0, 256, (rows, columns, 3), np.uint8) for _ in eyes_m)
    window = None
    if rng.random() < 0.3:
        u0, v0 = int(rng.integers(0, width)), int(rng.integers(0, height))
        box = PixelRect(u0, v0, int(rng.integers(u0 + 1, width + 1)), int(rng.integers(v0 + 1, height + 1)))
        window = SolveWindow(box, box, (4.0, 4.0))
    return Case(
        stack, eyes_m, pictures, float(rng.choice([5, 40, 90, 150, 175])) if own else None,
        window, int(rng.choice([1, 3])),
        float(rng.choice([0, 0.002, 0.05, 1.7])), seed,
    )  # fmt: skip


def solved(case: Case, threads: int) -> list[Any]:
    """The values of all panels after the operations of a solution, and the layers."""
    stack, rng = case.stack, np.random.default_rng(case.seed)
    if case.fov_deg is None:
        views = drawn_views(case.pictures, stack)
    else:
        views = captured_views(case.pictures, case.eyes_m, stack, fov_deg=case.fov_deg)
    targets = Targets(stack, case.eyes_m, views)
    job = Job(targets, channels=case.channels, eye_sigma_m=case.sigma_m)
    geometry = targets.visible if case.window is None else targets.within(case.window)
    state = CpuState(stack, threads=threads)
    buffer = LayerPool(stack).take()
    with state.begin(job, geometry) as solving:
        for n, box in enumerate(geometry.boxes):
            if rng.random() < 0.8:
                shape = (box.height_px, box.width_px) + ((3,) if case.channels == 3 else ())
                solving.set_panel(n, rng.integers(0, FULL + 1, shape, np.int16))
        solving.close_middle()
        solving.start()
        for places in ("middle", "rising", "falling"):
            solving.step(Step(size=1.2, momentum=0.5, places=places))  # type: ignore[arg-type]
        solving.write(buffer, 128)
        return [solving.panel(n) for n in range(stack.count)] + [buffer.pixels]


@pytest.mark.parametrize("first", range(FIRST, FIRST + EXAMPLES, BATCH))
def test_any_geometry_is_solved_or_refused(first: int) -> None:
    done = 0
    for seed in range(first, first + BATCH):
        case = case_of(seed)
        try:
            with np.errstate(all="ignore"):
                found = solved(case, 1)
        except (ValueError, np.linalg.LinAlgError):  # more panels than a solution has, an eye in a panel's plane
            continue
        done += 1
        assert all(values.min() >= 0 and values.max() <= FULL for values in found[:-1]), seed
        with np.errstate(all="ignore"):
            assert all((one == other).all() for one, other in zip(found, solved(case, 3), strict=True)), seed
    assert done >= BATCH // 4


@pytest.mark.parametrize("first", [*FOUND, *range(FIRST, FIRST + EXAMPLES, BATCH)])
def test_any_homography_is_sampled_or_refused(first: int) -> None:
    for seed in range(first, first + BATCH):
        rng = np.random.default_rng(seed)
        shapes = [(*rng.choice([1, 2, 7, 64, 333], 2).tolist(), *((3,) if seed % 2 else ())) for _ in range(2)]
        image = rng.integers(-32768, 32767, shapes[0], np.int16)
        matrix = np.eye(3) + rng.normal(0, 1, (3, 3)) * 10.0 ** rng.uniform(-4, 3, (3, 3)) * (rng.random((3, 3)) < 0.5)
        law = float(rng.choice([0, 0, 1e-3, 0.5])), float(rng.uniform(0, 300))
        result = np.full(shapes[1], 7, np.int16)
        source = kernels.library().Source(image)
        source.warp(result, matrix, law, (0.0, 0.0), float(rng.choice([-1, 0, 3])), 8191, (0, len(result)))
        assert np.abs(result).max() <= 8191
        with np.errstate(all="ignore"):
            warp(image, matrix, size=result.shape[:2], outside=0)


def drawing_of(seed: int) -> dict[str, Any]:
    """A random `PanelPicture` but for its screen. Some are refused: pictures of one row, numbers from 1e9."""
    rng = np.random.default_rng(seed)

    def sizes() -> list[int]:
        return rng.choice([1, 2, 3, 64, 65, 130], 2, p=[0.05, 0.15, 0.2, 0.2, 0.2, 0.2]).tolist()

    def number(scale: float) -> float:
        return float(rng.normal(0, scale) * 10.0 ** (rng.choice([0, 12], p=[0.9, 0.1]) * rng.random()))

    def map_() -> tuple[float, ...]:
        return (number(2), number(2), number(50), number(50))

    screen, registered = sizes(), rng.random() < 0.5
    flat = rng.integers(0, 256, (*screen, 4), np.uint8) if rng.random() < 0.4 else None
    homography = np.eye(3) + rng.normal(0, 1, (3, 3)) * 10.0 ** rng.uniform(-4, 3, (3, 3))
    return {
        "source": rng.integers(0, 256, (*sizes(), 4), np.uint8),
        "source_from_panel": (1.0, 1.0, 0.5, 0.5) if rng.random() < 0.2 else map_(),
        "panel_from_screen": homography * number(1) if registered else None,
        "panel_px": tuple(sizes()),
        "relief": rng.normal(0, 1, sizes()).astype(np.float32) if rng.random() < 0.5 else None,
        "relief_from_screen": map_(),
        "push": map_(),
        "flat": flat,
        "flatness": float(rng.random()),
        "curve": rng.integers(0, 256, (3, 1024), np.uint32) if rng.random() < 0.5 else None,
        "every": 1 if flat is not None else int(rng.choice([1, 2])),
        "screen_px": screen,
    }


@pytest.mark.parametrize("first", range(FIRST, FIRST + 10 * EXAMPLES, 10 * BATCH))
def test_any_picture_is_drawn_within_its_screen_or_refused(first: int) -> None:
    """Threads draw alike, however many, whatever the maps, homography and relief."""
    loops, done = kernels.library(), 0
    for seed in range(first, first + 10 * BATCH):
        how = drawing_of(seed)
        rows, columns = how.pop("screen_px")
        drawn = []
        for threads in (1, 3):
            memory = np.full((rows + 2, columns + 2, 4), 77, np.uint8)
            try:
                picture = loops.PanelPicture(screen=memory[1:-1, 1:-1], **how)
            except ValueError:
                continue
            loops.draw_panels([picture], threads)
            drawn.append(memory)
            memory_inside = memory[1:-1, 1:-1].copy()
            memory[1:-1, 1:-1] = 77
            assert (memory == 77).all(), seed
            memory[1:-1, 1:-1] = memory_inside
        done += len(drawn) // 2
        assert not drawn or (drawn[0] == drawn[1]).all(), seed
    assert done > 5 * BATCH
