"""Savings and their switches."""

from __future__ import annotations

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.model.job import Savings
from runtime.plan.savings import Measured, Plan, Saving, eyes_in_range, make_plan, seeing_eyes, selected_eyes

EYES = np.array([[0.6, -0.03, 0.05], [0.6, 0.03, 0.05]])
ASIDE = np.array([[0.09, 0.45, 0.0], [0.06, 0.50, 0.0]])


def planned(info: ContentInfo | None = None, **options: object) -> Plan:
    settings = Settings.model_validate(options.pop("settings", {}))
    return make_plan(info or ContentInfo("a"), settings, **options)  # type: ignore[arg-type]


def names(plan: Plan) -> set[str]:
    return {item.what for item in plan.items}


def test_a_still_scene_is_presented_again_and_a_moving_one_is_not() -> None:
    assert "render and inference" in names(planned())
    assert "render and inference" not in names(planned(ContentInfo("a", moving=True)))


def test_numbers_are_those_that_were_measured() -> None:
    plan = planned(measured=Measured(focus=Saving(30.0, 0.05), left_out=Savings(0.12)))
    (item,) = [item for item in plan.items if item.what == "inference outside the active window"]
    assert (item.saves_ms, item.costs_db) == (30.0, 0.05)
    assert "12%" in item.why


def test_a_whole_active_panel_saves_nothing_and_claims_nothing() -> None:
    assert not any("inference outside" in name for name in names(planned(measured=Measured())))


def test_flat_content_needs_no_network() -> None:
    info = ContentInfo("a", flat_x_m=0.0)
    assert "inference" in names(planned(info, measured=Measured(left_out=Savings(0.0))))


def test_an_eye_that_can_t_see_gives_way_to_the_other() -> None:
    assert eyes_in_range(ASIDE) == (True, False)
    plan = planned(eyes_m=ASIDE)
    assert plan.eyes == (True, False)
    assert "the right eye" in names(plan)
    assert (selected_eyes(ASIDE, plan.eyes) == ASIDE[0]).all()
    assert planned(eyes_m=ASIDE, settings={"plan": {"enabled": False}}).eyes == (True, True)
    assert (selected_eyes(EYES, planned(eyes_m=EYES).eyes) == EYES).all()


def test_a_given_eye_position_needs_no_sensor() -> None:
    assert "the sensor" in names(planned(settings={"sensor": {"driver": "fixed"}}))
    assert "the sensor" not in names(planned())


def at_angle(degrees: float) -> np.ndarray:
    """Eyes whose right one is off the axis by this much, at 0.5 m."""
    angle = np.radians(degrees)
    right = 0.5 * np.array([np.cos(angle), np.sin(angle), 0.0])
    return np.array([[0.5, 0.0, 0.0], right])


def test_an_eye_at_the_edge_of_the_range_does_not_flicker() -> None:
    random = np.random.default_rng(1)
    seeing, changes = (True, True), 0
    for step in range(2000):
        angle = 70.0 + 20.0 * step / 2000
        now = seeing_eyes(at_angle(angle) + random.normal(0.0, 0.002, (2, 3)), seeing)
        changes += now != seeing
        seeing = now
    assert (seeing, changes) == ((True, False), 1)


def test_an_eye_returns_only_well_within_the_range() -> None:
    assert seeing_eyes(at_angle(79), (True, True)) == (True, True)
    assert seeing_eyes(at_angle(79), (True, False)) == (True, False)
    assert seeing_eyes(at_angle(76), (True, False)) == (True, True)


def test_one_channel_is_said_where_it_was_enough() -> None:
    grey = Measured(left_out=Savings(1.0, 1), one_channel=Saving(20.0, 0.0))
    (item,) = [item for item in planned(measured=grey).items if "channels" in item.what]
    assert (item.saves_ms, item.costs_db) == (20.0, 0.0)
    assert "two of three colour channels" not in names(planned(measured=Measured()))
