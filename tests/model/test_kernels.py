"""The compiled loops: any geometry, arrays of any size, and the same panels from every instruction set."""

from __future__ import annotations

import ctypes
import mmap
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime import kernels
from runtime.errors import MissingPart
from runtime.kernels import SUBCODE
from runtime.model import cpu
from runtime.model.buffers import LayerPool
from runtime.model.contract import Step
from runtime.model.geometry import TargetView
from runtime.model.job import Job, Targets
from runtime.model.predictor import load_predictor
from runtime.model.warp import warp
from runtime.records import F64
from tests.model.scenes import eyes
from tests.model.test_steps import STACK, STACKS, begun, panels_of, smooth


def test_kernels_of_another_version_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "INTERFACE", kernels.INTERFACE + 1)
    kernels.library.cache_clear()
    with pytest.raises(MissingPart, match="was built from another version"):
        load_predictor("sart", STACK)
    monkeypatch.undo()
    kernels.library()


@pytest.fixture
def any_level() -> Iterator[None]:
    yield
    kernels.library().use_level(kernels.library().levels()[0])


@pytest.mark.parametrize("stack", ["three", "tilted", "four"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.usefixtures("any_level")
def test_every_instruction_set_makes_the_same_panels(stack: str, channels: int) -> None:
    """To the byte, although AVX-512 and AVX2 round a product and its sum once, and the plain build twice."""
    made, levels = [], kernels.library().levels()
    if len(levels) < 2:
        pytest.skip("this machine or build has one level only")
    for level in levels:
        kernels.library().use_level(level)
        state, _, geometry = begun(STACKS[stack], eyes(0.4, 0.2, roll_deg=10), own=True, channels=channels)
        state.close_middle()
        for places in ("rising", "middle", "falling"):
            state.step(Step(size=1.4, places=places))
        buffer = LayerPool(STACKS[stack]).take()
        state.write(buffer, 128)
        made.append((np.concatenate([panel.ravel() for panel in panels_of(state, geometry)]), buffer.pixels))
    for panels, layers in made[1:]:
        assert np.abs(panels - made[0][0]).max() == 0 and (layers == made[0][1]).all()


def guarded(array: NDArray[Any]) -> NDArray[Any]:
    """A copy whose last byte is the last of readable memory."""
    page = mmap.PAGESIZE
    size = -(-array.nbytes // page) * page
    memory = mmap.mmap(-1, size + page)
    place = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(place + size), page, 0) == 0
    flat = np.frombuffer(memory, array.dtype, array.size, size - array.nbytes)
    flat[:] = array.ravel()
    return flat.reshape(array.shape)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("width", [1, 31, 33, 100])
def test_nothing_is_read_or_written_past_an_array_s_end(channels: int, width: int) -> None:
    """A read past the last page of a thread's memory ended the process."""
    loops, rows, rng = kernels.library(), 5, np.random.default_rng(0)
    shape = (rows, width) if channels == 1 else (rows, width, 3)
    pictures = [guarded(rng.integers(0, 256, shape, np.uint8)) for _ in range(2)]
    tapers = guarded(np.full(width, 32767, np.int16)), guarded(np.full(rows, 32767, np.int16))
    rays = loops.Rays(pictures, *tapers, guarded(np.arange(256, dtype=np.int32) * 16 + (8191 << 16)), 2040.0, 0.5)
    panels = loops.Panels(2, rows, width, channels)
    for n in range(2):
        panels.set(n, guarded(rng.integers(0, 4081, shape, np.int16)))
    matrices = guarded(np.tile(np.eye(3) + np.array([[0, 0, 0.2], [0, 0, 0.2], [0, 0, 0]]), (2, 2, 1, 1)))
    back = guarded(np.linalg.inv(matrices))
    for closing in (True, False):
        boxes, sets = [(rows, width)] * 2, [(0, 0), (1, 0)]
        problem = loops.Problem(panels, rays, closing, boxes, matrices, back, sets, 1, [False] * 2)
        for part in range(2):
            problem.close_middle(part, 2) if closing else problem.step(1.0, 0.5, 0.01, part, 2)
    panels.advance()
    assert panels.values(0, rows, width).std() > 1
    layers = guarded(np.zeros((rows, width, 4), np.uint8))
    panels.write(0, 0, 0, layers, 0, rows)
    assert (layers[..., 3] == 255).all()
    image, result = guarded(rng.integers(0, 4081, shape, np.int16)), guarded(np.zeros(shape, np.int16))
    loops.Source(image).warp(result, matrices[0, 0], (0.0, 0.0), (0.0, 0.0), 3.0, -1, (0, rows))
    assert (result >= 0).all()
    turned, framed = (
        guarded(rng.integers(1, 256, layers.shape, np.uint8)),
        guarded(np.zeros((rows + 2, width + 2, 4), np.uint8)),
    )
    assert loops.frame_picture(turned, framed, 1, 1) == (1, 1, width + 1, rows + 1)
    loops.draw_panels([picture(framed, guarded(np.zeros_like(layers)))], 2)


SAME = (1.0, 1.0, 0.0, 0.0)


def picture(source: NDArray[Any], screen: NDArray[Any], **how: Any) -> Any:
    usual: dict[str, Any] = {
        "source_from_panel": SAME, "panel_from_screen": None, "panel_px": (0, 0), "relief": None,
        "relief_from_screen": SAME, "push": SAME, "flat": None, "flatness": 0.0, "curve": None, "every": 1,
    }  # fmt: skip
    return kernels.library().PanelPicture(source=source, screen=screen, **{**usual, **how})


@pytest.mark.parametrize(
    "wrong",
    [
        {"source": np.zeros((1, 9, 4), np.uint8)},  # a neighbour to the right and below is read
        {"source": np.zeros((9, 9, 3), np.uint8)},
        {"source": np.zeros((9, 18, 4), np.uint8)[:, ::2]},
        {"source": np.zeros((9, 37), np.uint8)[:, 1:].reshape(9, 9, 4)[::-1]},
        {"source": np.broadcast_to(np.zeros((1, 9, 4), np.uint8), (70000, 9, 4))},
        {"screen": np.zeros((5, 0, 4), np.uint8)},
        {"source_from_panel": (1.0, 1.0, np.nan, 0.0)},
        {"push": (1.0, np.inf, 0.0, 0.0)},
        {"relief_from_screen": (1e10, 1.0, 0.0, 0.0)},
        {"panel_from_screen": np.diag([1.0, np.nan, 1.0])},
        {"panel_from_screen": np.eye(2)},
        {"relief": np.zeros((0, 3), np.float32)},
        {"flat": np.zeros((5, 8, 4), np.uint8)},
        {"flat": np.zeros((5, 7, 4), np.uint8), "every": 2},
        {"flatness": -0.1},
        {"flatness": 1.1},
        {"curve": np.zeros((3, 256), np.uint32)},
        {"every": 0},
        {"every": 3},
    ],
    ids=str,
)
def test_only_pictures_that_fit_are_drawn(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        picture(**{"source": np.zeros((9, 9, 4), np.uint8), "screen": np.zeros((5, 7, 4), np.uint8), **wrong})


def test_only_pictures_that_fit_are_framed() -> None:
    frame, turned = kernels.library().frame_picture, np.full((3, 5, 4), 9, np.uint8)
    assert frame(turned[::-1, ::-1], np.zeros((7, 9, 4), np.uint8), 2, 0) == (2, 2, 7, 5)
    for size, border_px, extended_px in (((3, 5, 4), 1, 0), ((5, 8, 4), 1, 0), ((5, 7, 4), -1, 0), ((5, 7, 4), 1, 2)):
        with pytest.raises(ValueError, match="border"):
            frame(turned, np.zeros(size, np.uint8), border_px, extended_px)


def test_the_loops_take_only_arrays_that_fit() -> None:
    loops = kernels.library()
    panels = loops.Panels(3, 20, 30, 3)
    picture, taper = np.zeros((20, 30, 3), np.uint8), np.zeros(30, np.int16)
    rows, table = np.zeros(20, np.int16), np.zeros(256, np.int32)
    rays = loops.Rays([picture, picture], taper, rows, table, 0.0, 1.0)
    matrices = np.tile(np.eye(3), (2, 3, 1, 1))
    boxes, sets, grey = [(20, 30)] * 3, [(0, 0), (1, 0)], [False] * 3
    closing = loops.Problem(panels, rays, True, boxes, matrices, matrices, sets, 1, grey)
    wrong: list[tuple[type[Exception], Callable[[], Any]]] = [
        (ValueError, lambda: loops.Panels(9, 20, 30, 3)),
        (ValueError, lambda: loops.Panels(3, 20, 30, 2)),
        (ValueError, lambda: panels.fill(3, 1, 1, 0)),
        (ValueError, lambda: panels.fill(0, 21, 1, 0)),
        (ValueError, lambda: panels.set(0, np.zeros((20, 31, 3), np.int16))),
        (ValueError, lambda: panels.set(0, np.zeros((20, 30), np.int16))),
        (TypeError, lambda: panels.set(0, np.zeros((20, 30, 3), np.int32))),
        (TypeError, lambda: panels.set(0, np.zeros((20, 30, 3), np.int16)[:, ::-1])),
        (ValueError, lambda: panels.write(0, 1, 0, np.zeros((20, 30, 4), np.uint8), 0, 20)),
        (ValueError, lambda: panels.write(0, 0, 0, np.zeros((20, 30, 4), np.uint8), 0, 21)),
        (ValueError, lambda: loops.Rays([picture, picture[1:]], taper, rows, table, 0.0, 1.0)),
        (ValueError, lambda: loops.Rays([picture[:, ::2]] * 2, taper[::2].copy(), rows, table, 0.0, 1.0)),
        (ValueError, lambda: loops.Rays([picture, picture], taper[1:], rows, table, 0.0, 1.0)),
        (ValueError, lambda: loops.Problem(panels, rays, False, boxes[1:], matrices, matrices, sets, 1, grey)),
        (ValueError, lambda: loops.Problem(panels, rays, False, [(21, 30)] * 3, matrices, matrices, sets, 1, grey)),
        (ValueError, lambda: loops.Problem(panels, rays, False, boxes, matrices[:1], matrices, sets, 1, grey)),
        (ValueError, lambda: loops.Problem(panels, rays, False, boxes, matrices, matrices, [(0, 0), (2, 0)], 1, grey)),
        (ValueError, lambda: loops.Problem(panels, rays, False, boxes, matrices, matrices, [(0, 0), (1, 1)], 1, grey)),
        (ValueError, lambda: loops.Problem(panels, rays, False, boxes, matrices, matrices, sets, 21, grey)),
        (ValueError, lambda: closing.close_middle(2, 2)),
    ]  # fmt: skip
    for number, (error, call) in enumerate(wrong):
        with pytest.raises(error):
            call()
            pytest.fail(f"{number} was accepted")


TURNS = {
    "mirrored": (lambda picture: picture[:, ::-1], [[-1.0, 0.0, 480.0], [0.0, 1.0, 0.0]]),
    "upside down": (lambda picture: picture[::-1], [[1.0, 0.0, 0.0], [0.0, -1.0, 270.0]]),
    "on its side": (lambda picture: picture.swapaxes(0, 1), [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
}


@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("channels", [1, 3])
def test_rays_in_any_order_make_the_same_panels(turn: str, channels: int) -> None:
    """A picture whose rows run left, up or down had the loops write in front of their buffers."""
    turned, matrix = TURNS[turn]
    made = []
    for change in (None, np.array([*matrix, [0.0, 0.0, 1.0]])):
        _, job, _ = begun(STACK, eyes(0.5, 0.05), own=False, channels=channels)
        if change is not None:
            left, right = (
                TargetView(np.ascontiguousarray(turned(view.pixels)), view.plane_from_picture @ change)
                for view in job.views
            )
            job = replace(job, targets=replace(job.targets, views=(left, right)))
        state, geometry = cpu.CpuState(STACK, threads=2), job.targets.visible
        with state.begin(job, geometry) as solving:
            solving.close_middle()
            solving.start()
            solving.step(Step(size=1.0, places="middle"))
            made.append(np.concatenate([panel.ravel() for panel in panels_of(solving, geometry)]))
    off = np.abs(made[1] - made[0])
    assert off.mean() < 1.5 and np.quantile(off, 0.99) < 8, (off.mean(), np.quantile(off, [0.9, 0.99]))


def stepped(rays_from_front: F64, *, upside_down: bool, parts: int = 1) -> NDArray[np.int16]:
    """(2, 96, 64, 1) panels after a step with one view, whose rays are the rear panel's pixels."""
    loops, (rows, width) = kernels.library(), (96, 64)
    turn = np.array([[1, 0, 0], [0, -1, rows], [0, 0, 1.0]]) if upside_down else np.eye(3)
    picture = smooth(5, 1)[:rows, :width, 0]
    full = [np.full(size, 32767, np.int16) for size in (width, rows)]
    table = np.arange(256, dtype=np.int32) * SUBCODE + (8191 << 16)
    rays = loops.Rays([np.ascontiguousarray(picture[::-1] if upside_down else picture)], *full, table, 2040.0, 0.5)
    panels = loops.Panels(2, rows, width, 1)
    for n in range(2):
        panels.set(n, smooth(n, 1)[:rows, :width, 0].astype(np.int16) * SUBCODE)
    back = np.linalg.inv(turn) @ [[np.eye(3), rays_from_front]]
    seen, sets = np.linalg.inv(back), [(0, 0)]
    problem = loops.Problem(panels, rays, False, [(rows, width)] * 2, seen, back, sets, 1, [False] * 2)
    for part in range(parts):
        problem.step(1.0, 0.5, 0.01, part, parts)
    panels.advance()
    return np.stack([panels.values(n, rows, width) for n in range(2)])


@pytest.mark.parametrize("per_column", [-3.0, -1.5, 0.0])
@pytest.mark.parametrize("per_row", [-0.3, 0.0])
@pytest.mark.parametrize("downward", [-0.3, 0.3])
def test_rows_up_to_a_horizon_meet_all_their_rays(per_column: float, per_row: float, downward: float) -> None:
    """A panel row whose end lies behind the eye was updated before its last rays had been computed."""
    rays_from_front = np.array([[1.0, 0.0, 0.0], [downward, 1.0, 0.0], [per_column / 64, per_row / 96, 1.0]])
    panels = stepped(rays_from_front, upside_down=False)
    assert np.abs(panels - stepped(rays_from_front, upside_down=True)).max() <= SUBCODE
    assert (panels == stepped(rays_from_front, upside_down=False, parts=3)).all()


@pytest.mark.parametrize("sigma_m", [0.03, 1.66, float("inf")])
def test_an_uncertain_eye_stays_in_front_of_the_panels(sigma_m: float) -> None:
    """A standard deviation of 30 mm at 2 cm from the front panel ended the process."""
    near = np.array([[0.08, 0.065, 0.002], [0.08, 0.126, 0.015]])
    _, job, geometry = begun(STACK, near, own=False)
    for places in ("rising", "falling"):
        weights = geometry.ray_sets(places, sigma_m).panels_from_rays[:, :, 2] @ np.array([240.0, 60.0, 1.0])
        np.testing.assert_allclose(weights, 1.0)
        scales = geometry.ray_sets(places, sigma_m).panels_from_rays[:, :, 0, 0]
        assert (scales > 0).all() and np.isfinite(scales).all()
    layers = load_predictor("sart" if sigma_m > 1 else "fast", STACK).solve(replace(job, eye_sigma_m=sigma_m)).layers
    assert layers.std() > 1


def test_an_eye_between_the_panels_ends_no_process() -> None:
    for distance_m in (0.03, 0.0600001, -0.03, -0.1):
        state, _, _ = begun(STACK, eyes(distance_m), own=False)
        try:
            state.close_middle()
            state.step(Step(size=1.0, places="rising"))
        except ValueError as refused:
            assert "homography" in str(refused)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, 1e300])
def test_homographies_that_are_not_finite_are_refused(wrong: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """The compiler had removed the loops' guards, and NaN became row -2147483648."""
    state, _, geometry = begun(STACK, eyes(0.6), own=False)
    sets = geometry.ray_sets("middle", 0.0)
    matrices = sets.panels_from_rays
    matrices[1, 2, 0, 1] = wrong
    monkeypatch.setattr(type(geometry), "ray_sets", lambda *_: sets)
    monkeypatch.setattr(cpu, "inverse", lambda _: np.nan_to_num(matrices))
    with pytest.raises(ValueError, match="homography"):
        state.step(Step(size=1.0, places="middle"))
    with pytest.raises(ValueError, match="homography"), np.errstate(invalid="ignore"):
        warp(np.zeros((9, 9), np.int16), np.diag([1.0, wrong, 1.0]), size=(9, 9), outside=0)


@pytest.mark.parametrize("scale", [60.0, 300.0, 5000.0])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_ray_may_span_any_number_of_pixels(scale: float, channels: int) -> None:
    """Beyond 180, the loops read what they had not filled."""
    image = np.random.default_rng(0).integers(0, 4081, (3, 60000, channels)).astype(np.int16)
    matrix = np.array([[scale, 0, 0.25], [0, 1, 0], [0, 0, 1]])
    found = warp(image[..., 0] if channels == 1 else image, matrix, size=(3, int(60000 / scale)), outside=0)
    at = (np.arange(found.shape[1]) + 0.5) * scale + 0.25 - 0.5
    left = np.clip(at.astype(int), 0, 59998)
    share = np.clip(at - left, 0, 1)[:, None]
    expected = (1 - share) * image[:, left] + share * image[:, left + 1]
    assert np.abs(found.reshape(expected.shape) - expected).max() < 2.5


def test_too_little_memory_is_an_exception() -> None:
    """The process aborted. Rays of a picture on its side need all their rows at once."""
    turned = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    stack = replace(STACK, width_px=4000, height_px=3000)
    pictures = [np.zeros((4000, 3000, 3), np.uint8)] * 2
    plane = stack.panel(1).plane_from_raster() @ turned
    left, right = (TargetView(picture, plane) for picture in pictures)
    job = Job(Targets(stack, eyes(0.6), (left, right)))
    child = os.fork()
    if child == 0:
        state = cpu.CpuState(stack, threads=1)
        solving = state.begin(job, job.targets.visible).__enter__()
        solving.start()
        used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
        resource.setrlimit(resource.RLIMIT_AS, (used + 50_000_000, -1))
        try:
            solving.step(Step(size=1.0))
        except MemoryError:
            os._exit(0)
        os._exit(1)
    assert os.waitpid(child, 0)[1] == 0


def test_too_little_memory_to_draw_is_an_exception() -> None:
    """Memory is allocated before threads start, which could not raise it."""
    wide = picture(np.zeros((9, 9, 4), np.uint8), np.zeros((1, 1 << 16, 4), np.uint8))
    child = os.fork()
    if child == 0:
        try:
            used = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
            resource.setrlimit(resource.RLIMIT_AS, (used, -1))
            held: list[bytearray] = []
            with suppress(MemoryError):
                while True:
                    held.append(bytearray(1 << 17))
            try:
                kernels.library().draw_panels([wide], 2)  # needs 256 kB at once
            except MemoryError:
                os._exit(0)
        finally:
            os._exit(1)
    assert os.waitpid(child, 0)[1] == 0
