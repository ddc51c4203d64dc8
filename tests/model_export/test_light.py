"""The reference of light and of a step: geometry, mathematics and gradients, each against something that is not it."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch")
from model_export.light import FLOOR, Views, light, step, traced  # noqa: E402
from model_export.scene import Parallelogram, draw, random_scene  # noqa: E402
from runtime.optics.stack import PanelStack, Tilt  # noqa: E402
from runtime.optics.views import image_from_raster, image_from_stack  # noqa: E402

ROOT = Path(__file__).resolve().parents[2]
EYES = np.array([[0.62, -0.04, 0.03], [0.6, 0.024, 0.035]])
STACK = PanelStack(0.5184, 0.2916, (-0.02, 0.0, 0.03), 12, 8)
STACKS = {
    "three": STACK,
    "two": PanelStack(0.5184, 0.2916, (-0.03, 0.01), 12, 8),
    "four": PanelStack(0.5184, 0.2916, (-0.05, -0.02, 0.0, 0.03), 12, 8),
}


def views_of(stack: PanelStack, **more: Any) -> Views:
    return Views.of(stack, EYES, **{"width_px": stack.width_px, "height_px": stack.height_px, "fov_deg": 40.0, **more})


def random_panels(stack: PanelStack, channels: int = 1) -> Any:
    shape = (stack.count, channels, stack.height_px, stack.width_px)
    return torch.from_numpy(np.random.default_rng(3).uniform(0.2, 0.8, shape))


@pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS)
def test_a_pictures_ray_meets_each_panel_where_the_eye_sees_that_pixel(stack: PanelStack) -> None:
    views = views_of(stack)
    for eye, matrices in zip(EYES, views.panels_from_rays.numpy(), strict=True):
        image = image_from_stack(eye, width_px=stack.width_px, height_px=stack.height_px, fov_deg=40.0)
        for n, matrix in enumerate(matrices):
            for pixel in ((0.5, 0.5), (7.0, 2.5)):
                seen = image_from_raster(image, stack.panel(n)) @ matrix @ (*pixel, 1.0)
                assert seen[:2] / seen[2] == pytest.approx(pixel, abs=1e-9)


def test_a_head_elsewhere_looks_through_the_same_points_of_the_centre_panel() -> None:
    place = (0.01, 0.02, -0.005)
    views = views_of(STACK, places_m=((0.0, 0.0, 0.0), place))
    assert len(views.panels_from_rays) == 4
    at = np.array([3.0, 2.0, 1.0])
    for eye, here, there in zip(EYES, views.panels_from_rays.numpy()[:2], views.panels_from_rays.numpy()[2:]):
        points = [STACK.panel(n).stack_from_raster() @ (m @ at / (m @ at)[2]) for n, m in enumerate(there)]
        assert points[1] == pytest.approx(STACK.panel(1).stack_from_raster() @ (here[1] @ at / (here[1] @ at)[2]))
        along = np.array(points) - (eye + place)
        assert np.cross(along[0], along[2]) == pytest.approx(0, abs=1e-9)
        assert np.cross(along[0], along[1]) == pytest.approx(0, abs=1e-9)


def test_content_on_the_centre_panels_pixels_is_seen_there() -> None:
    tilt = Tilt(((0.001, 0.002, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, -0.003)), (0.6, 0.0, 0.0))
    for stack in (STACK, PanelStack(0.5184, 0.2916, STACK.x_m, 12, 8, tilt)):
        matrices = views_of(stack, fov_deg=None).panels_from_rays.numpy()
        assert np.allclose(matrices[:, 1] / matrices[:, 1, 2:, 2:], np.eye(3))
        assert not np.allclose(matrices[0, 0] / matrices[0, 0, 2, 2], np.eye(3), atol=1e-3)


def plain_light(codes: np.ndarray, stack: PanelStack, eye: np.ndarray, size: tuple[int, int], rays: int) -> np.ndarray:
    """(h, w, C) an eye's view of uniform boxes, nan where a ray is lost, computed line by line without matrices."""
    height, width = size
    pose = image_from_stack(eye, width_px=width, height_px=height, fov_deg=40.0)
    v, u = ((np.arange(n * rays) + 0.5) / rays for n in size)
    pixels = np.stack(np.broadcast_arrays(u, v[:, None], 1.0), axis=-1)
    toward = pixels @ np.linalg.inv(pose[:, :3]).T
    total: Any = 0.0
    for n, x_m in enumerate(stack.x_m):
        y, z = (eye[k] + toward[..., k] * ((x_m - eye[0]) / toward[..., 0]) for k in (1, 2))
        column, row = (y / stack.width_m + 0.5) * stack.width_px, (0.5 - z / stack.height_m) * stack.height_px
        lost = (np.minimum(column, row) < 0.5) | (column > stack.width_px - 0.5) | (row > stack.height_px - 0.5)
        i, j = (np.clip(a.astype(int), 0, most - 1) for a, most in zip((row, column), codes.shape[1:3]))
        total = total + np.where(lost[..., None], np.nan, codes[n, i, j])
    seen = np.sin(np.pi / 2 * total) ** 2
    return seen.reshape(height, rays, width, rays, -1).mean(axis=(1, 3))


def decibels(errors: Any) -> float:
    return float(-10 * np.log10(np.nanmean(errors)))


@pytest.fixture(scope="module")
def still() -> tuple[PanelStack, Any]:
    """Panels, and a scene of textured cards as either eye should see it."""
    stack = PanelStack(0.5184, 0.2916, (-0.02, 0.0, 0.02), 96, 54)
    scene = random_scene(np.random.default_rng(5), stack, EYES.mean(axis=0))
    size = {"width_px": 96, "height_px": 54}
    images = [draw(scene, image_from_stack(eye, **size, fov_deg=40.0), **size) for eye in EYES]
    return stack, torch.stack([torch.from_numpy(image / 255).permute(2, 0, 1) for image in images])


def test_steps_raise_the_light_of_real_pixels_and_say_how_much(still: tuple[PanelStack, Any]) -> None:
    """From grey. For the displayed result `light` nearly equals rays through uniform boxes, `traced` exactly."""
    stack, targets = still
    views, random = views_of(stack), torch.Generator().manual_seed(1)
    x = y = torch.full((3, 3, 54, 96), 0.5, dtype=torch.float64)
    reached = []
    for size in (0.0, *[1.0] * 6):
        x, y = step(x, y, targets, views, size=size, momentum=0.5)
        codes = (x * 255).round() / 255
        seen, counts = light(codes, views)
        reached.append(decibels(np.where(counts, (seen - targets) ** 2, np.nan)))
    boxes = np.stack([plain_light(codes.permute(0, 2, 3, 1).numpy(), stack, eye, (54, 96), 16) for eye in EYES])
    boxes = boxes.transpose(0, 3, 1, 2)
    true = decibels((boxes - targets.numpy()) ** 2)
    a, b = (traced(codes, views, rays=4, random=random)[0] - targets for _ in range(2))
    unbiased = decibels(np.where(np.isnan(boxes), np.nan, a * b))
    assert all(after > before for before, after in pairwise(reached)) and reached[-1] > reached[0] + 15
    assert unbiased == pytest.approx(true, abs=0.1)
    assert reached[-1] == pytest.approx(true, abs=0.25)


def test_a_pixel_counts_only_where_all_its_rays_cross_every_panel() -> None:
    even, views = torch.full((3, 1, 8, 12), 0.2, dtype=torch.float64), views_of(STACK)
    seen, counts = traced(even, views, rays=2, random=torch.Generator().manual_seed(1))
    assert seen[counts].numpy() == pytest.approx(np.sin(np.pi / 2 * 0.6) ** 2)
    assert 0 < counts.sum() < light(even, views)[1].sum()


@pytest.mark.parametrize("stack", STACKS.values(), ids=STACKS)
@pytest.mark.filterwarnings("ignore:Casting complex values")
def test_gradients_of_light_and_step_are_finite_differences(stack: PanelStack) -> None:
    stack = PanelStack(0.5184, 0.2916, stack.x_m, 6, 5)
    views = views_of(stack, width_px=5, height_px=4, fov_deg=30.0, places_m=((0, 0, 0), (0, 0.002, 0.001)))
    x = random_panels(stack).requires_grad_()
    targets = torch.from_numpy(np.random.default_rng(4).uniform(0.2, 0.8, (2, 1, 4, 5)))
    close = {"eps": 1e-6, "atol": 1e-6, "rtol": 0.0}
    assert torch.autograd.gradcheck(lambda panels: light(panels, views)[0], (x,), **close)
    size, momentum = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.2, 0.5))

    def steps(panels: Any, size: Any, momentum: Any) -> Any:
        new, ahead = step(panels, panels, targets, views, size=size, momentum=momentum)
        return step(new, ahead, targets, views, size=size, momentum=momentum)[0]

    assert torch.autograd.gradcheck(steps, (x, size, momentum), **close)


def test_a_step_is_bounded_by_the_curvature_and_its_floor() -> None:
    """One pixel, seen through its middle: L5 in numbers."""
    views = Views(torch.eye(3, dtype=torch.float64).repeat(2, 2, 1, 1), 2, 2)
    for values in ((0.3, 0.5), (0.02, 0.01)):
        x = torch.tensor(values, dtype=torch.float64).reshape(2, 1, 1, 1).expand(2, 1, 2, 2)
        new, _ = step(x, x, torch.zeros(2, 1, 2, 2, dtype=torch.float64), views, size=0.5)
        s = np.pi * sum(values)
        moved = 0.5 * 2 * (1 - np.cos(s)) / 2 * np.sin(s) / (1.5 * np.pi * max(2 * np.sin(s) ** 2, FLOOR * 2)) * 3 / 2
        assert (x - new).numpy() == pytest.approx(np.full((2, 1, 2, 2), moved), abs=1e-12)


def test_what_lies_behind_the_eye_is_not_seen() -> None:
    red = np.zeros((8, 8, 4), np.uint8)
    red[...] = (255, 0, 0, 255)
    # A wall next to the eye, from far in front of it to as far behind it.
    wall = Parallelogram(red, np.array([-2.0, 0.3, 0.5]), np.array([4.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0]))
    size = {"width_px": 64, "height_px": 36}
    image = draw((wall,), image_from_stack(np.array([0.6, 0.0, 0.0]), **size, fov_deg=90.0), **size)
    assert (image[18, 50:, 0] > 200).all() and (image[18, :32] == 0).all()
