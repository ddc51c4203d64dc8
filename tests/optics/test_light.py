"""Light against a ray tracer in plain numpy, with independent random rays: pixels are boxes, eyes have pupils."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from runtime.optics.carried import expected_psnrs_db
from runtime.optics.light import LIGHT, Sampling, squared_errors
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F32, F64, U8

FOV_DEG = 4.0
SIZE = (68, 44)  # of the pictures, pixels: every ray of them crosses every panel
EYES = np.array([[0.7, -0.03, 0.1], [0.72, 0.03, 0.1]])
THREE = PanelStack(0.12, 0.09, (-0.06, 0.0, 0.06), 160, 120)  # a pupil of 4 mm covers half a pixel of the outer panels
STACKS = {
    "three": THREE,
    "two": replace(THREE, x_m=(-0.05, 0.02)),
    "four, uneven": replace(THREE, x_m=(-0.07, -0.03, 0.01, 0.03)),
    "tilted": replace(
        THREE, tilt=Tilt(((0.001, 0.02, -0.03), (0.0, 0.0, 0.0), (-0.002, 0.01, 0.02)), (0.7, 0.05, 0.1))
    ),
}


def unit(vector: F64) -> F64:
    return vector / np.linalg.norm(vector)


def traced(
    nominal: F64, true: F64, layers: U8, stack: PanelStack, random: np.random.Generator, *, pupil_mm: float, rays: int
) -> F64:
    """(h, w, 3) mean light of `rays` by `rays` rays a pixel, each from a random place of pixel and pupil."""
    width, height = SIZE
    back = unit(nominal)
    right = unit(np.cross([0.0, 0.0, 1.0], back))
    up = np.cross(back, right)
    focal = width / 2 / math.tan(math.radians(FOV_DEG / 2))
    light = np.zeros((height, width, 3))
    for number in range(rays * rays):
        v, u = np.mgrid[:height, :width] + (np.array([number // rays, number % rays])[:, None, None]) / rays
        u, v = (np.array([u, v]) + random.random((2, height, width)) / rays)[..., None]
        gaze = (u - width / 2) / focal * right - (v - height / 2) / focal * up - back
        centre_x = stack.x_m[stack.count // 2]
        centre = nominal + gaze * ((centre_x - nominal[0]) / gaze[..., :1])
        radius, angle = np.sqrt(random.random((height, width, 1))), random.random((height, width, 1)) * 2 * math.pi
        start = true + pupil_mm / 2e3 * radius * (np.cos(angle) * right + np.sin(angle) * up)
        phase = np.zeros((height, width, 3))
        for index, layer in enumerate(layers):
            column, row = crossed(start, centre - start, stack, index)
            assert column.min() >= 0.5 and column.max() <= stack.width_px - 0.5
            assert row.min() >= 0.5 and row.max() <= stack.height_px - 0.5
            phase += layer[row.astype(int), column.astype(int), :3] / 255
        light += np.sin(phase * math.pi / 2) ** 2
    return light / rays**2


def crossed(start: F64, direction: F64, stack: PanelStack, index: int) -> tuple[F64, F64]:
    """Columns and rows of a panel's layer where rays cross it."""
    x_m, point = stack.x_m[index], start + direction * ((stack.x_m[index] - start[..., :1]) / direction[..., :1])
    if stack.tilt is not None:  # the panel is at x = x_m + d + r·y + u·z; its layer is what `seen_from_m` sees
        d, r, u = stack.tilt.depth[index]
        normal, origin = np.array([1.0, -r, -u]), np.array(stack.tilt.seen_from_m)
        point = start + direction * ((x_m + d - start @ normal) / (direction @ normal))[..., None]
        point = origin + (point - origin) * ((x_m - origin[0]) / (point[..., :1] - origin[0]))
    pitch_m = stack.width_m / stack.width_px, stack.height_m / stack.height_px
    return (point[..., 1] + stack.width_m / 2) / pitch_m[0], (stack.height_m / 2 - point[..., 2]) / pitch_m[1]


def case(stack: PanelStack, seed: int) -> tuple[U8, list[F32]]:
    """Layers of blocks of four pixels, of which a picture's pixel shows a part, and a picture for each eye."""
    random = np.random.default_rng(seed)
    shape = stack.count, stack.height_px // 2, stack.width_px // 2, 3
    blocks: U8 = random.integers(0, 256, shape, dtype=np.uint8).repeat(2, axis=1).repeat(2, axis=2)
    return blocks, [random.random((SIZE[1], SIZE[0], 3), dtype=np.float32) for _ in range(2)]


def traced_db(layers: U8, pictures: list[F32], stack: PanelStack, *, sigma_mm: float, pupil_mm: float) -> float:
    """The expected light of both eyes, by sets of 36 rays."""
    middle, total = EYES.mean(axis=0), 0.0
    right = unit(np.array([-middle[1], middle[0], 0.0]))
    moves = [(0.5, np.zeros(3))]
    moves += [(0.125, s * 0.002 * sigma_mm * axis) for axis in (right, np.array([0.0, 0.0, 1.0])) for s in (-1, 1)]
    random = np.random.default_rng(77)
    for weight, move in moves:
        for eye, picture in zip(EYES, pictures, strict=True):
            a, b = (
                traced(eye, eye + move, layers, stack, random, pupil_mm=pupil_mm, rays=6) - picture for _ in range(2)
            )
            total += weight / 2 * float((a * b).mean())
    return -10 * math.log10(total)


@pytest.mark.parametrize("name", STACKS)
@pytest.mark.parametrize(("sigma_mm", "pupil_mm"), [(0.0, 4.0), (2.0, 4.0), (1.0, 0.0), (0.0, 12.0)])
def test_light_is_what_an_independent_tracer_finds(name: str, sigma_mm: float, pupil_mm: float) -> None:
    stack = STACKS[name]
    layers, pictures = case(stack, 3)
    sampling, how = LIGHT._replace(rays=4, pupil_mm=pupil_mm), {"eyes_m": EYES, "fov_deg": FOV_DEG}
    told = expected_psnrs_db(layers, pictures, stack, **how, sigmas_mm=(sigma_mm,), sampling=sampling)[sigma_mm]
    assert told == pytest.approx(traced_db(layers, pictures, stack, sigma_mm=sigma_mm, pupil_mm=pupil_mm), abs=0.1)


def test_a_pupil_is_a_disc_and_one_of_no_width_a_point() -> None:
    layers, _ = case(THREE, 5)
    seen = {mm: seen_by_both(layers, pupil_mm=mm, rays=12) for mm in (0.0, 12.0)}
    for own, other in ((0.0, 12.0), (12.0, 0.0)):
        as_seen, as_not = (error(layers, seen[own], Sampling(rays=8, pupil_mm=mm)) for mm in (own, other))
        assert 3 * as_seen < as_not, "seen, but for the tracer's own noise"


def test_few_rays_and_many_estimate_the_same_error_without_bias() -> None:
    layers, pictures = case(THREE, 4)
    seen = seen_by_both(layers, pupil_mm=4.0, rays=20)
    one_set = seen_by_both(layers, pupil_mm=4.0, rays=2)
    noise = float(np.mean([(a - b) ** 2 for a, b in zip(seen, one_set, strict=True)]))
    for share in (0.0, 0.2):
        targets = [(1 - share) * s + share * p for s, p in zip(seen, pictures, strict=True)]
        truth = float(np.mean([(s - t) ** 2 for s, t in zip(seen, targets, strict=True)]))
        few, many = (error(layers, targets, Sampling(rays=rays)) for rays in (2, 8))
        assert many == pytest.approx(truth, abs=noise / 20)
        assert few == pytest.approx(many, abs=noise / 10)


def seen_by_both(layers: U8, *, pupil_mm: float, rays: int) -> list[F64]:
    """The tracer's views of three panels."""
    random = np.random.default_rng(9)
    return [traced(eye, eye, layers, THREE, random, pupil_mm=pupil_mm, rays=rays) for eye in EYES]


def error(layers: U8, targets: list[F64], sampling: Sampling) -> float:
    """The runtime's measure, of eyes that are known."""
    single = [target.astype(np.float32) for target in targets]
    eyes = {"solved_for_m": EYES, "eyes_m": EYES}
    return squared_errors(layers, single, THREE, **eyes, fov_deg=FOV_DEG, sampling=sampling)[0]
