"""The glass of the panels: registered as it is seen, what an eye sees through it agrees to a fraction of a pixel."""

from __future__ import annotations

import numpy as np
import pytest

from calib.board import board
from calib.detect_marks import find_marks
from calib.photo_registration import register_photographs
from calib.placed import in_frame_of, misplaced
from calib.registration import through
from calib.simulator import (
    Exposure,
    Glass,
    Scene,
    by_hand,
    camera_from_stack,
    camera_rays,
    crossing,
    phone,
    photograph,
    smaller,
)
from calib.viewpoints import viewing_place_m
from runtime.config import Settings, StackGeometry

STACK = StackGeometry().stack()
EYE = viewing_place_m(Settings().calibration)


@pytest.mark.slow
def test_two_millimetres_of_glass_a_panel_are_seen_as_nearer_panels_and_no_more() -> None:
    random = np.random.default_rng(4)
    hands = misplaced(STACK, shift_m=0.002, turn_deg=0.3, gap_m=0.001, random=random)
    panels = in_frame_of(hands, reference=1, reference_x_m=0.0)
    layers = np.stack([board(STACK, index) for index in range(3)])
    scene = Scene(STACK, panels, layers, Glass(thickness_m=0.002, index=1.5))
    lens = smaller(phone(random=random), 0.8)
    rays = camera_rays(lens)
    poses = by_hand(8, STACK, random=random)
    seen = [
        find_marks(photograph(scene, lens, pose, Exposure(), random=random, rays=rays), STACK, name=str(number))
        for number, pose in enumerate(poses)
    ]
    found = register_photographs(seen, STACK, eye_m=EYE, even=False)
    # A plate of thickness t brings what lies behind it nearer by t(1 - 1/n), seen straight: the gaps look smaller.
    straight_m = 0.002 * (1 - 1 / 1.5)
    gaps = np.diff([panel.axis_x_m for panel in panels]) - straight_m
    assert np.diff(found.true_x_m) == pytest.approx(gaps, abs=0.15e-3)
    # The eye's rays through the reference panel's pixels, and where they cross the others: traced, and as registered.
    pose = camera_from_stack(EYE, towards_m=np.zeros(3))
    tan = np.stack(np.meshgrid(np.linspace(-0.35, 0.35, 13), np.linspace(-0.2, 0.2, 9)), axis=-1).reshape(-1, 2)
    x, y = (tan[:, axis].astype(np.float32)[None] for axis in (0, 1))
    on = [np.stack(crossing(scene, index, pose, x, y), axis=-1)[0].astype(np.float64) for index in range(3)]
    inside = np.all([((p > 0) & (p < [1920, 1080])).all(axis=1) for p in on], axis=0)
    assert inside.sum() > 40
    for index in (0, 2):
        share = (EYE[0] - found.stack.x_m[index]) / EYE[0]
        pitch = STACK.width_m / STACK.width_px
        plane = np.column_stack([on[1][:, 0] * pitch - 0.2592, 0.1458 - on[1][:, 1] * pitch])
        ideal_m = EYE[1:] + (plane - EYE[1:]) * share
        ideal = np.column_stack([(ideal_m[:, 0] + 0.2592) / pitch, (0.1458 - ideal_m[:, 1]) / pitch])
        error = np.linalg.norm(through(found.homographies[index], ideal) - on[index], axis=1)[inside]
        assert np.sqrt((error**2).mean()) < 0.15
