"""Joint steps by shaders are those of the definition, in double precision."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import moderngl
import numpy as np
import pytest

from runtime.model.gl.joint import GlJoint
from runtime.model.gl.programs import Image, Passes
from runtime.optics.rect import PixelRect
from runtime.records import F64
from runtime.support.gl import offscreen_context
from tests.model.gl_account import counted

WIDTH, HEIGHT = 70, 40
FULL = 4080
HOW = {"size": 1.4, "momentum": 0.4, "floor": 0.1}
NO_ENDS = {"over": (0.0, 0.0, 0.0, 0.0)}


def seen_from(*shifts: tuple[float, float], tilt: float = 0.0) -> F64:
    """(rays, 3, 3, 3): the rear panel moves against the front one."""
    rays = []
    for right, down in shifts:
        rear = np.array([[0.96, 0.0, 1.4 - right], [tilt, 0.96, 0.8 - down], [0.0, tilt / 50, 1.0]])
        front = np.array([[1.04, 0.0, -1.3 + right], [-tilt, 1.04, -0.7 + down], [tilt / 50, 0.0, 1.0]])
        rays.append([rear, np.eye(3), front])
    return np.array(rays)


def bilinear(image: F64, place: F64) -> F64:
    low = np.floor(place - 0.5).astype(int)
    share = place - 0.5 - low

    def at(right: int, down: int) -> F64:
        return image[np.clip(low[1] + down, 0, HEIGHT - 1), np.clip(low[0] + right, 0, WIDTH - 1)]

    x, y = share[0][..., None], share[1][..., None]
    return (at(0, 0) * (1 - x) + at(1, 0) * x) * (1 - y) + (at(0, 1) * (1 - x) + at(1, 1) * x) * y


def places(matrix: F64) -> F64:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    x, y, w = (row[0] * u + row[1] * v + row[2] for row in matrix)
    return np.array([x / w, y / w])


def stepped(ahead: F64, last: F64, targets: F64, seen: F64, *, size: float, momentum: float, floor: float) -> Any:
    """(3, h, w, 3) panels from 0 to 1 after a step, with momentum and without."""
    total, weight = np.zeros_like(ahead), np.zeros_like(ahead)
    for ray, matrices in enumerate(seen):
        where = [places(matrix) for matrix in matrices]
        sums = sum(bilinear(panel, place) for panel, place in zip(ahead, where, strict=True))
        counts = np.ones((HEIGHT, WIDTH), bool)
        for place in where:
            counts &= (place[0] >= 0.5) & (place[0] <= WIDTH - 0.5) & (place[1] >= 0.5) & (place[1] <= HEIGHT - 0.5)
        slope = np.sin(np.pi * sums) * counts[..., None]
        push = slope * (np.sin(np.pi / 2 * sums) ** 2 - targets[ray % 2])
        for n, matrix in enumerate(matrices):
            back = places(np.linalg.inv(matrix))
            inside = ((back >= 0) & (back <= np.array([WIDTH, HEIGHT])[:, None, None])).all(axis=0)[..., None]
            total[n] += bilinear(push, back) * inside
            weight[n] += bilinear(slope**2, back) * inside
    now = np.clip(ahead - size * total / (1.5 * np.pi * np.maximum(weight, floor * len(seen))), 0, 1)
    return now + momentum * (now - last), now


@pytest.fixture(scope="module")
def context() -> Iterator[Any]:
    made = offscreen_context()
    with made:
        yield made
    made.release()


class Held:
    """Images by name, and what is in them."""

    def __init__(self, context: Any) -> None:
        self._context, self._images = context, {}  # type: ignore[var-annotated]
        self.passes = Passes(context)

    def image(self, panel: int, name: str, dtype: str) -> Image:
        if (panel, name) not in self._images:
            texture = self._context.texture((WIDTH, HEIGHT), 4, dtype=dtype)
            texture.filter = (moderngl.NEAREST, moderngl.NEAREST)
            self._images[panel, name] = Image(texture, WIDTH, HEIGHT)
        return self._images[panel, name]

    def written(self, panel: int, name: str, values: Any, dtype: str) -> Image:
        image = self.image(panel, name, dtype)
        whole = np.zeros((HEIGHT, WIDTH, 4), values.dtype)
        whole[..., :3] = values
        image.texture.write(whole)
        return image


@pytest.mark.parametrize("tilt", [0.0, 0.01], ids=["even", "tilted"])
@pytest.mark.parametrize("unsure", [False, True], ids=["sure", "unsure"])
def test_steps_are_those_of_the_definition(context: Any, unsure: bool, tilt: float) -> None:
    random = np.random.default_rng(1)
    held = Held(context)
    panels = random.integers(1000, 3000, (3, HEIGHT, WIDTH, 3))
    pictures = random.integers(0, 256, (2, HEIGHT, WIDTH, 3)).astype(np.uint8)
    targets = {
        eye: held.written(1, f"target {eye}", picture, "f1") for eye, picture in zip(("left", "right"), pictures)
    }
    joint = GlJoint(held.passes, held.image)
    joint.start({n: held.written(n, "begun", (panels[n] - FULL // 2).astype(np.int16), "i2") for n in range(3)})
    shifts = [(2.3, 0.0), (-2.3, 0.0)] if not unsure else [(2.6, 0.3), (-2.0, 0.3), (2.0, -0.3), (-2.6, -0.3)]
    seen = seen_from(*shifts, tilt=tilt)
    ahead = last = panels / FULL
    with held.passes.drawing():
        for _ in range(3):
            joint.step(seen, targets, ends=NO_ENDS, **HOW)
    for _ in range(3):
        ahead, last = stepped(ahead, last, pictures / 255, seen, **HOW)
    for n, image in joint.panels.items():
        found = np.frombuffer(image.texture.read(), np.int16).reshape(HEIGHT, WIDTH, 4)[..., :3] + FULL // 2
        error = np.abs(found - last[n] * FULL)
        assert np.percentile(error, 99) <= 16, n  # a code
        assert np.abs(panels[n] - found).mean() > 10 * error.mean()


def test_a_part_s_end_drives_nothing(context: Any) -> None:
    held, box = Held(context), PixelRect(20, 10, 50, 30)
    even = np.zeros((HEIGHT, WIDTH, 3), np.int16)
    white = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    targets = {eye: held.written(1, f"target {eye}", white, "f1") for eye in ("left", "right")}
    joint = GlJoint(held.passes, held.image)
    joint.start({n: held.written(n, "begun", even, "i2") for n in range(3)})
    ends = {
        "kept_box": (box.u0, box.v0, box.u1, box.v1),
        "over": (5.0, 5.0, 5.0, 5.0),
        "centre_from_here": (1.0, 1.0, 0.0, 0.0),
    }
    with counted() as account, held.passes.drawing():
        joint.step(seen_from((0.5, 0.0), (-0.5, 0.0)), targets, ends=ends, **HOW)
    assert account.passes == ["compare", "move", "move", "move"]
    centre = np.frombuffer(joint.panels[1].texture.read(), np.int16).reshape(HEIGHT, WIDTH, 4)[..., :3]
    assert (centre[12:28, 30:40] != 0).all()
    assert (centre[:9] == 0).all() and (centre[:, :19] == 0).all()
