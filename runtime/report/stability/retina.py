"""What an eye sees: simulated retinas, and the error of light (contracts), against a tracer of 50 digits."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from runtime.optics.light import LIGHT, RINGS, first_ray, random_bits, ray_of, squared_error
from runtime.optics.retina import pupil_points, seen_by
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.report.stability import exact
from runtime.report.stability.trial import EPS32, Answer, Trial

STAGE = "retina"
SIZE = (32, 18)  # of the pictures and panels: every ray of a small picture is traced
FOV_DEG = 40.0
THREE = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), *SIZE)
SMALL = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 16, 9)  # for eight rays a pixel
EDGE_PX = 1e-4  # a ray so near to where it begins to count may count or not


def layers_of(kind: str, stack: PanelStack) -> U8:
    """(N, h, w, 3) grey levels that show every mistake of sampling, or none."""
    shape = (stack.count, stack.height_px, stack.width_px, 3)
    if kind == "noise":
        return np.random.default_rng(6).integers(0, 256, shape, dtype=np.uint8)
    if kind == "checkerboard":
        board = np.indices(shape[1:3]).sum(0) % 2 * 255
        return np.broadcast_to(board[None, :, :, None], shape).astype(np.uint8).copy()
    return np.full(shape, 255, np.uint8)


def traced(
    eye: Any, stack: PanelStack, layers: U8, column: int, row: int, size: tuple[int, int] = SIZE
) -> tuple[list[Any], float]:
    """The intensities that a ray of the picture sees, and by how many pixels it crosses the panels inside what counts.

    Bilinear between a panel's pixel centres, summed, sin² of pi/2 of it. size: columns and rows of the picture.
    """
    u, v = exact.mpf(column) + exact.mpf("0.5"), exact.mpf(row) + exact.mpf("0.5")
    direction = exact.ray(eye, u, v, width_px=size[0], height_px=size[1], fov_deg=FOV_DEG)
    if direction[0] >= 0:
        return [], -math.inf
    total, inside = [exact.mpf(0)] * 3, math.inf
    for index, layer in enumerate(layers):
        x, y = exact.on_panel(eye, direction, stack, index)
        half = exact.mpf("0.5")
        margins = (x - half, stack.width_px - half - x, y - half, stack.height_px - half - y)
        inside = min(inside, *(float(margin) for margin in margins))
        if inside <= 0:
            continue
        left, top = int(exact.mp.floor(x - half)), int(exact.mp.floor(y - half))
        fx, fy = x - half - left, y - half - top
        for dy, wy in ((0, 1 - fy), (1, fy)):
            for dx, wx in ((0, 1 - fx), (1, fx)):
                if wx and wy:
                    values = layer[top + dy, left + dx]
                    total = [t + wx * wy * int(value) for t, value in zip(total, values, strict=True)]
    return [exact.mp.sin(exact.mp.pi / 2 * t / 255) ** 2 for t in total], inside


def seen_rays(eye: Sequence[float], stack: PanelStack, kind: str) -> Answer:
    """Every ray's intensity, and whether it counts."""
    layers = layers_of(kind, stack)
    retina = seen_by(eye, layers, stack, fov_deg=FOV_DEG, width_px=SIZE[0], height_px=SIZE[1])
    if retina.image.shape != (SIZE[1], SIZE[0], 3):
        return Answer(1.0, 0.0, note=f"a picture of {retina.image.shape}")
    e, error, counted, wrong = exact.vector(eye), 0.0, 0, 0
    for row, column in np.ndindex(*retina.mask.shape):
        truth, inside = traced(e, stack, layers, column, row)
        if abs(inside) > EDGE_PX and bool(retina.mask[row, column]) != (inside > 0):
            wrong += 1
        if inside > EDGE_PX and retina.mask[row, column]:
            counted += 1
            error = max(error, *map(exact.distance, retina.image[row, column], truth))
    if wrong or not counted:
        return Answer(1.0, 0.0, note=f"{wrong} rays count that do not, or the other way round; {counted} compared")
    # Positions are single precision: half a rounding of the width, a grey step of the range a pixel and panel.
    return Answer(error, 8 * EPS32 * SIZE[0] * stack.count, float(stack.count), note=f"{counted} rays")


def light(eyes: Sequence[Sequence[float]], true: Sequence[Sequence[float]], kind: str) -> Answer:
    """Mean squared error of the light in eyes that are elsewhere than solved for, along the same rays one by one."""
    layers = layers_of(kind, SMALL)
    targets = [np.random.default_rng(3).random((SMALL.height_px, SMALL.width_px, 3), dtype=np.float32) for _ in eyes]
    total, count, doubtful = exact.mpf(0), 0, 0
    for side, (nominal, place, target) in enumerate(zip(eyes, true, targets, strict=True)):
        e = exact.vector(nominal), exact.vector(place)
        for row, column in np.ndindex(SMALL.height_px, SMALL.width_px):
            sets, inside, edge = lit(*e, layers, column, row, first_ray=first_ray(side))
            doubtful += min(abs(inside), edge) < EDGE_PX
            if inside > 0:
                wanted = [exact.mpf(float(value)) for value in target[row, column]]
                total += sum((a - t) * (b - t) for a, b, t in zip(*sets, wanted, strict=True))
                count += 3
    where: Any = {"solved_for_m": np.array(eyes), "eyes_m": np.array(true), "fov_deg": FOV_DEG}
    found = squared_error(layers, targets, SMALL, **where, sampling=LIGHT)
    # A ray on the border between two pixels may take either: its share of a pixel's intensity.
    tolerance = 64 * EPS32 + doubtful / LIGHT.rays**2 / max(count, 1)
    return Answer(exact.distance(found, total / count), tolerance, note=f"{count} values, {doubtful} on a border")


def lit(
    nominal: Any, true: Any, layers: U8, column: int, row: int, *, first_ray: int
) -> tuple[list[list[Any]], float, float]:
    """The mean intensities of both of a pixel's sets, how far inside they cross, and how near to a border of pixels."""
    width, height, half, rays = SMALL.width_px, SMALL.height_px, exact.mpf("0.5"), LIGHT.rays
    right, up, _ = exact.axes(nominal)
    pupil, a_set = pupil_points(LIGHT.pupil_mm / 1e3, rings=RINGS), rays * rays
    sums, inside, edge = [[exact.mpf(0)] * 3, [exact.mpf(0)] * 3], math.inf, math.inf
    numbers = first_ray + (row * width + column) * 2 * a_set + np.arange(2 * a_set)
    for ray, (along, down, point) in enumerate(zip(*ray_of(random_bits(numbers), len(pupil)), strict=True)):
        u = column + (ray % rays + exact.mpf(float(along))) / rays
        v = row + (ray % a_set // rays + exact.mpf(float(down))) / rays
        direction = exact.ray(nominal, u, v, width_px=width, height_px=height, fov_deg=FOV_DEG)
        across, high = map(float, pupil[point])
        end = exact.combine(exact.combine(true, exact.mpf(across), right), exact.mpf(high), up)
        through = exact.combine(exact.hit(nominal, direction, SMALL.x_m[1]), -1, end)
        phases = [0, 0, 0]
        for index, layer in enumerate(layers):
            x, y = exact.on_panel(end, through, SMALL, index)
            inside = min(inside, *map(float, (x - half, width - half - x, y - half, height - half - y)))
            if inside <= 0:
                return sums, inside, edge
            edge = min(edge, *(float(abs(p - exact.mp.nint(p))) for p in (x, y)))
            phases = [p + int(value) for p, value in zip(phases, layer[int(y), int(x)], strict=True)]
        own = sums[ray // a_set]
        own[:] = [s + exact.mp.sin(exact.mp.pi / 2 * p / 255) ** 2 / a_set for s, p in zip(own, phases, strict=True)]
    return sums, inside, edge


def trials() -> Iterator[Trial]:
    """Every case of what eyes see."""
    two = PanelStack(0.5184, 0.2916, (-0.02, 0.03), *SIZE)
    four = PanelStack(0.3, 0.2, (-0.09, -0.02, 0.01, 0.06), 17, 31)
    for name, eye in (
        ("straight ahead", [0.7, 0.0, 0.0]),
        ("aside and above", [0.55, 0.2, 0.15]),
        ("60 degrees aside", [0.35, 0.6, -0.1]),
        ("5 cm before the front panel", [0.11, 0.05, 0.02]),
        ("4 m away", [4.0, -0.3, 0.2]),
    ):
        for kind in ("noise", "checkerboard"):
            run = partial(seen_rays, eye, THREE, kind)
            yield Trial(STAGE, f"rays, {name}, {kind}", run, measure="intensity")
    for name, stack in (("two panels", two), ("four uneven panels of 17x31", four)):
        run = partial(seen_rays, [0.6, 0.04, 0.03], stack, "noise")
        yield Trial(STAGE, f"rays, {name}", run, measure="intensity")
    yield Trial(STAGE, "rays, all white", partial(seen_rays, [0.6, 0, 0], THREE, "white"), measure="intensity")
    eyes = [[0.7, -0.03, 0.05], [0.7, 0.03, 0.05]]
    for name, moved_m, kind in (
        ("at", 0.0, "checkerboard"),
        ("2 mm beside", 0.002, "noise"),
        ("beside", 0.05, "noise"),
    ):
        true = [[x, y + moved_m, z] for x, y, z in eyes]
        yield Trial(STAGE, f"light {name} the eyes, {kind}", partial(light, eyes, true, kind), measure="squared error")
