"""The simultaneous step: the kernel is the reference in torch; light gets better on rays that no step saw."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
import torch

from model_export.light import Views, step
from runtime.model.compiled.phasors import FULL, INTENSITY, PhasorState, Rays, rays_of
from runtime.model.contract import Step
from runtime.model.own_rays import refined
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, Tilt
from runtime.optics.views import image_from_stack
from runtime.records import F32, F64, U8
from tests.model.scenes import FOV_DEG, card_scene, eyes

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 480, 270)
TILTED = replace(STACK, tilt=Tilt(((0.001, 0.012, -0.006), (0.0, 0.0, 0.0), (-0.002, 0.004, 0.015)), (1.0, 0.1, -0.05)))
STEPS = tuple(Step(kind="joint", size=size, momentum=0.5) for size in (1.6, 1.45, 1.4))
WHOLE = PixelRect(0, 0, 480, 270)


def problem(stack: PanelStack, pair: F64, *, own: bool = False, seed: int = 1) -> tuple[F64, F64, Views]:
    """Panels (3, h, w), targets (2, h, w), and the rays of pictures' own pixels or of the centre panel's."""
    random = np.random.default_rng(seed)
    images = [cv2.GaussianBlur(random.random((stack.height_px, stack.width_px)), (0, 0), 2.0) for _ in range(5)]
    images = [np.clip(0.5 + 3 * (image - 0.5), 0, 1) for image in images]
    views = Views.of(stack, pair, width_px=stack.width_px, height_px=stack.height_px, fov_deg=FOV_DEG if own else None)
    return np.array(images[:3]), np.array(images[3:]), views


def state_of(panels: F64, targets: F64, channels: int, threads: int) -> PhasorState:
    height, width = panels.shape[1:]
    state = PhasorState(np.array([(height, width)] * 4), channels=channels, threads=threads)
    for n in range(3):
        state.panels[n, :height, : width * channels] = np.rint(np.repeat(panels[n], channels, axis=1) * FULL)
    for side in range(2):
        codes = np.repeat(targets[side], channels, axis=1) * 255 * INTENSITY
        state.targets[side, :height, : width * channels] = np.rint(codes)
    state.start()
    return state


def rays_to(views: Views, state: PhasorState) -> Rays:
    seen = views.panels_from_rays.numpy()
    return rays_of(seen / seen[..., 2:, 2:], state.sizes)


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["even", "tilted"])
@pytest.mark.parametrize(("channels", "threads"), [(1, 1), (3, 2)])
@pytest.mark.parametrize(
    ("pair", "own"),
    [(eyes(0.6, 0.05, 0.1), False), (eyes(0.6, 0.05, 0.1, roll_deg=20), False), (eyes(0.8, 0.01, 0.02), True)],
    ids=["drawn", "rolled", "own rays"],
)
def test_a_step_is_the_references(stack: PanelStack, channels: int, threads: int, pair: F64, own: bool) -> None:
    panels, targets, views = problem(stack, pair, own=own)
    state = state_of(panels, targets, channels, threads)
    ahead = last = torch.from_numpy(panels)[:, None]
    for size in (1.6, 1.4):
        last, ahead = step(last, ahead, torch.from_numpy(targets)[:, None], views, size=size, momentum=0.5)
        state.step(rays_to(views, state), size=size, momentum=0.5, floor=0.1)
    off = np.abs(state.last[:, :270, : 480 * channels : channels] / FULL - last[:, 0].numpy())
    # Where a ray leaves a panel, it counts or not with a whole tile of its row; a picture's rows are not level on the
    # panels, and the kernel takes each piece of them for a straight one.
    assert (off < (1e-2 if own else 2e-3)).mean() > (0.9 if own else 0.975)
    assert np.median(off) < 1e-3


def test_many_steps_with_momentum_do_not_diverge() -> None:
    panels, targets, views = problem(STACK, eyes(0.6))
    state = state_of(panels, targets, 1, 2)
    rays, changes = rays_to(views, state), []
    for _ in range(60):
        before = state.last.copy()
        state.step(rays, size=1.3, momentum=0.6, floor=0.1)
        changes.append(float(np.abs(state.last.astype(np.int32) - before).mean()))
    assert changes[-1] < 0.05 * changes[0]


def light_mse(layers: U8, pictures: list[U8], pair: F64, stack: PanelStack, rays: int) -> float:
    """Mean squared error of the mean light of `rays` by `rays` rays a picture's pixel, panels' pixels being boxes."""
    from runtime.optics.rpu import panel_from_image
    from runtime.optics.tilt import layer_from_seen, layer_pixels_from_seen

    height, width = pictures[0].shape[:2]
    v, u = np.mgrid[0:height, 0:width] + 0.5
    offsets, errors = (np.arange(rays) + 0.5) / rays - 0.5, []
    for eye, picture in zip(pair, pictures, strict=True):
        projection = image_from_stack(eye, width_px=width, height_px=height, fov_deg=FOV_DEG)
        light: F32 = np.zeros((height, width, 3), np.float32)
        inside = np.ones((height, width), bool)
        for down in offsets:
            for right in offsets:
                total = np.zeros((height, width, 3))
                for n in range(3):
                    panel = stack.panel(n)
                    layer = layer_pixels_from_seen(panel, layer_from_seen(stack, n, eye))
                    matrix = layer @ panel_from_image(projection, panel)
                    x, y, w = (row[0] * (u + right) + row[1] * (v + down) + row[2] for row in matrix)
                    x, y = x / w, y / w
                    inside &= (x > 0.5) & (x < stack.width_px - 0.5) & (y > 0.5) & (y < stack.height_px - 0.5)
                    at = np.clip(y, 0, stack.height_px - 1).astype(int), np.clip(x, 0, stack.width_px - 1).astype(int)
                    total += layers[n][at][..., :3] / 255
                light += np.sin(np.pi / 2 * total) ** 2
        errors.append(((light / rays**2 - picture[..., :3] / 255.0) ** 2)[inside])
    return float(np.concatenate(errors).mean())


@pytest.mark.parametrize("stack", [STACK, TILTED], ids=["even", "tilted"])
@pytest.mark.parametrize("sigma_mm", [0.0, 1.0])
def test_light_gets_better_on_rays_that_no_step_saw(stack: PanelStack, sigma_mm: float) -> None:
    """Four by four rays a pixel, of boxes, where steps look along one, bilinearly: no polish of those alone."""
    pair = eyes(0.6, 0.05, 0.1)
    pictures = [card_scene(eye) for eye in pair]
    predictor = load_predictor("fast", stack)
    layers = solve_still(*pictures, eyes_m=pair, fov_deg=FOV_DEG, predictor=predictor).layers.copy()
    projections = [image_from_stack(eye, width_px=480, height_px=270, fov_deg=FOV_DEG) for eye in pair]
    errors = [light_mse(layers, pictures, pair, stack, 4)]
    for count in (1, 3):
        made = refined(
            layers, pictures, stack, eyes_m=pair, projections=projections, eye_sigma_mm=sigma_mm,
            steps=STEPS[:count], box=WHOLE, channels=3, threads=2,
        )  # fmt: skip
        errors.append(light_mse(made, pictures, pair, stack, 4))
    assert all(after < before for before, after in pairwise(errors)), errors
    assert errors[-1] < 0.8 * errors[0]
    predictor.close()


def test_equal_grey_pictures_and_panels_that_show_them_stay() -> None:
    """Nothing is wrong, so that nothing moves; and what lies beside the box is let be."""
    pair = eyes(0.6)
    layers = np.full((3, 270, 480, 4), 128, np.uint8)
    layers[..., 3] = 255
    intensity = np.sin(np.pi / 2 * 3 * 128 / 255) ** 2
    picture = np.full((270, 480, 4), round(255 * intensity), np.uint8)
    projections = [image_from_stack(eye, width_px=480, height_px=270, fov_deg=FOV_DEG) for eye in pair]
    made = refined(
        layers, [picture, picture], STACK, eyes_m=pair, projections=projections, eye_sigma_mm=1.0, steps=STEPS,
        box=PixelRect(100, 50, 300, 200), channels=3, threads=1,
    )  # fmt: skip
    assert np.abs(made.astype(int) - layers).max() <= 1
    assert (made[:, :50] == layers[:, :50]).all() and (made[:, :, 300:] == layers[:, :, 300:]).all()
