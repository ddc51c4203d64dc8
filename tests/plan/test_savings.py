"""What is left out, and that each saving can be switched off."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.optics.stack import PanelStack
from runtime.plan.savings import Measured, Plan, Saving, eyes_in_range, make_plan, seeing_eyes, selected_eyes

EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])
ASIDE = np.array([[0.09, 0.45, 0.0], [0.06, 0.50, 0.0]])


def planned(stack: PanelStack, info: ContentInfo | None = None, **options: object) -> Plan:
    settings = Settings.model_validate(options.pop("settings", {}))
    return make_plan(info or ContentInfo("a"), stack, settings, **options)  # type: ignore[arg-type]


def names(plan: Plan) -> set[str]:
    return {item.what for item in plan.items}


def test_a_still_scene_is_presented_again_and_a_moving_one_is_not(stack: PanelStack) -> None:
    assert "render and inference" in names(planned(stack))
    assert "render and inference" not in names(planned(stack, ContentInfo("a", moving=True)))


@pytest.mark.parametrize(("switch", "field"), [("reuse", "reuse"), ("focus", "focus")])
def test_each_saving_can_be_switched_off(stack: PanelStack, switch: str, field: str) -> None:
    assert getattr(planned(stack), field)
    assert not getattr(planned(stack, settings={"plan": {switch: False}}), field)
    assert not getattr(planned(stack, settings={"plan": {"enabled": False}}), field)


def test_numbers_are_those_that_were_measured(stack: PanelStack) -> None:
    plan = planned(stack, measured=Measured(focus=Saving(30.0, 0.05), active_fraction=0.12))
    (item,) = [item for item in plan.items if item.what == "inference beside the active window"]
    assert (item.saves_ms, item.costs_db) == (30.0, 0.05)
    assert "12%" in item.why


def test_a_whole_active_panel_saves_nothing_and_claims_nothing(stack: PanelStack) -> None:
    assert not any("inference beside" in name for name in names(planned(stack, measured=Measured())))


def test_flat_content_needs_no_network(stack: PanelStack) -> None:
    info = ContentInfo("a", flat_x_m=0.0)
    assert "inference" in names(planned(stack, info, measured=Measured(active_fraction=0.0)))


def test_an_eye_that_can_t_see_gives_way_to_the_other(stack: PanelStack) -> None:
    assert eyes_in_range(ASIDE, range_deg=80) == (True, False)
    plan = planned(stack, eyes_m=ASIDE)
    assert plan.eyes == (True, False)
    assert "the right eye" in names(plan)
    assert (selected_eyes(ASIDE, plan.eyes) == ASIDE[0]).all()
    assert planned(stack, eyes_m=ASIDE, settings={"plan": {"one_eye": False}}).eyes == (True, True)
    assert (selected_eyes(EYES, planned(stack, eyes_m=EYES).eyes) == EYES).all()


def test_a_given_eye_position_needs_no_sensor(stack: PanelStack) -> None:
    assert "the sensor" in names(planned(stack, settings={"sensor": {"driver": "fixed"}}))
    assert "the sensor" not in names(planned(stack))


def test_what_is_not_imported_is_said(stack: PanelStack) -> None:
    (item,) = [item for item in planned(stack, loaded_modules={"torch"}).items if item.what == "optional parts"]
    assert "torch" not in item.why
    assert "trimesh" in item.why


def test_only_a_head_at_rest_is_not_solved_for_unless_a_dead_band_is_set(stack: PanelStack) -> None:
    assert planned(stack).dead_band_m is None
    assert planned(stack, settings={"plan": {"dead_band_mm": 0.5}}).dead_band_m == pytest.approx(0.0005)


def at_angle(degrees: float) -> np.ndarray:
    """Eyes of which the right one is so far off the axis, at 0.5 m."""
    angle = np.radians(degrees)
    right = 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    return np.array([[0.5, 0.0, 0.0], right])


def test_an_eye_at_the_edge_of_the_range_does_not_flicker() -> None:
    random = np.random.default_rng(1)
    seeing, changes = (True, True), 0
    for step in range(2000):
        angle = 70.0 + 20.0 * step / 2000
        now = seeing_eyes(at_angle(angle) + random.normal(0.0, 0.002, (2, 3)), seeing, range_deg=80)
        changes += now != seeing
        seeing = now
    assert (seeing, changes) == ((True, False), 1)


def test_an_eye_returns_only_well_within_the_range() -> None:
    assert seeing_eyes(at_angle(79), (True, True), range_deg=80) == (True, True)
    assert seeing_eyes(at_angle(79), (True, False), range_deg=80) == (True, False)
    assert seeing_eyes(at_angle(76), (True, False), range_deg=80) == (True, True)


def test_one_channel_is_said_where_it_was_enough(stack: PanelStack) -> None:
    grey = Measured(channels=1, one_channel=Saving(20.0, 0.0))
    (item,) = [item for item in planned(stack, measured=grey).items if "channels" in item.what]
    assert (item.saves_ms, item.costs_db) == (20.0, 0.0)
    assert "two of three colour channels" not in names(planned(stack, measured=Measured()))
