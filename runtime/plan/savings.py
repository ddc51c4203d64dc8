"""Decide which work can be skipped for the current scene, display and viewer."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.model.job import Savings
from runtime.records import F64, Eyes, PlanItem

VISIBLE_DEG = 80.0  # an eye farther than this from the display's axis cannot see the display
RETURN_MARGIN_DEG = 3.0  # three standard deviations of an eye's direction at 0.2 m with 3 mm of noise


@dataclass(frozen=True, slots=True)
class Saving:
    """Measured effect of skipping some work. Values that were not measured are None."""

    saves_ms: float | None = None  # time saved per frame
    costs_db: float | None = None  # quality lost


@dataclass(frozen=True, slots=True)
class Measured:
    """The effects of all savings, measured on this machine for one scene."""

    reuse: Saving = Saving()  # showing the previous solution again
    focus: Saving = Saving()  # solving only the window where the eyes' pictures differ
    one_channel: Saving = Saving()  # solving only one channel for grey pictures
    one_eye: Saving = Saving()  # solving only for the eye that sees the display
    left_out: Savings = field(default_factory=Savings)  # work skipped by the newest job


@dataclass(frozen=True, slots=True)
class Plan:
    """The eyes to solve for, and a description of all skipped work for an operator to read."""

    eyes: tuple[bool, ...]  # (left, right of each person), True for each eye to solve for
    items: tuple[PlanItem, ...] = field(default=())  # one item for each kind of skipped work


def eyes_in_range(eyes_m: Eyes, *, range_deg: float = VISIBLE_DEG) -> tuple[bool, ...]:
    """Return, for each eye, True if it is within `range_deg` of the axis, seen from the centre."""
    off_axis = np.degrees(np.arctan2(np.linalg.norm(eyes_m[:, 1:], axis=1), eyes_m[:, 0]))
    return tuple((off_axis <= range_deg).tolist())


def seeing_eyes(eyes_m: Eyes, before: tuple[bool, ...]) -> tuple[bool, ...]:
    """Return, for each eye, True if it can see the display, given the previous result. An excluded eye
    must come `RETURN_MARGIN_DEG` inside the range, so that noise does not switch it on and off.
    """
    before = (*before, *(True,) * len(eyes_m))
    outer = eyes_in_range(eyes_m)
    inner = eyes_in_range(eyes_m, range_deg=VISIBLE_DEG - RETURN_MARGIN_DEG)
    return tuple(inner[eye] or (before[eye] and outer[eye]) for eye in range(len(eyes_m)))


def selected_eyes(eyes_m: Eyes, seeing: tuple[bool, ...]) -> F64:
    """Return the (2P, 3) eyes to solve for. If one cannot see, the person's other one replaces it."""
    if all(seeing):
        return eyes_m
    other = [eye ^ 1 if not seeing[eye] and seeing[eye ^ 1] else eye for eye in range(len(seeing))]
    return eyes_m if other == list(range(len(seeing))) else eyes_m[other]


def make_plan(
    info: ContentInfo,
    settings: Settings,
    *,
    eyes_m: Eyes | None = None,
    seeing: tuple[bool, ...] | None = None,
    measured: Measured | None = None,
) -> Plan:
    """Return the plan for a scene and a viewer, valid until one of them changes. `seeing` is by default
    computed from `eyes_m`. Items quote the `measured` effects of savings.
    """
    on, numbers = settings.plan.enabled, measured or Measured()
    if seeing is None and eyes_m is not None:
        seeing = eyes_in_range(eyes_m)
    if seeing is None or not any(seeing) or not on:
        seeing = (True,) * len(seeing or (True, True))
    items: list[PlanItem] = []
    if on and not info.moving:
        why = "the content does not move, so the same solution is shown while the head is at rest"
        items.append(_item("render and inference", why, numbers.reuse))
    if on:
        items += network_items(info, numbers)
    for eye, sees in enumerate(seeing):
        if not sees:
            name = f"the {('left', 'right')[eye % 2]} eye" + (f" of person {eye // 2 + 1}" if len(seeing) > 2 else "")
            items.append(_item(name, f"this eye is more than {VISIBLE_DEG:g} degrees off the axis", numbers.one_eye))
    if settings.sensor.driver == "fixed":
        items.append(_item("the sensor", "the eye positions are fixed because sensor.driver is `fixed`", Saving()))
    return Plan(seeing, tuple(items))


def network_items(info: ContentInfo, numbers: Measured) -> list[PlanItem]:
    """Return the plan items for work that the model skipped in the newest job (`Measured.left_out`)."""
    items, share = [], numbers.left_out.solved_share
    if info.flat_x_m is not None and share == 0.0:
        why = "everything is in the centre panel's plane, so both eyes see the same picture"
        items.append(_item("inference", why, numbers.focus))
    elif share < 1.0:
        why = f"the two eyes' pictures differ on {share:.0%} of the panel; the rest has a closed-form solution"
        items.append(_item("inference outside the active window", why, numbers.focus))
    if numbers.left_out.channels == 1:
        why = "the pictures are grey, so one channel is solved for all three"
        items.append(_item("two of three colour channels", why, numbers.one_channel))
    return items


def _item(what: str, why: str, saving: Saving) -> PlanItem:
    saves_ms, costs_db = saving.saves_ms, saving.costs_db
    rounded_ms = None if saves_ms is None else round(saves_ms, 2)
    return PlanItem(what, why, rounded_ms, None if costs_db is None else round(costs_db, 3))
