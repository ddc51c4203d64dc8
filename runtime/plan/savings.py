"""What a scene, its display and its viewer allow to be left out: decisions alone, from what was measured."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

import numpy as np

from runtime.config import Settings
from runtime.content.base import ContentInfo
from runtime.optics.stack import PanelStack
from runtime.records import F64, PlanItem

OPTIONAL_PARTS = {
    "torch": "training",
    "openni": "the depth camera's SDK",
    "usb": "USB sensors",
    "trimesh": "meshes",
    "matplotlib": "reports",
}

RETURN_MARGIN_DEG = 3.0  # three standard deviations of an eye's direction: 3 mm of noise at 0.2 m


@dataclass(frozen=True, slots=True)
class Saving:
    """What leaving something out came to, in one run, with and without; None: not measured."""

    saves_ms: float | None = None
    costs_db: float | None = None


@dataclass(frozen=True, slots=True)
class Measured:
    """Times and errors on this machine, for this scene."""

    reuse: Saving = Saving()
    focus: Saving = Saving()
    one_channel: Saving = Saving()
    one_eye: Saving = Saving()
    channels: int = 3  # that the network solved
    active_fraction: float = 1.0  # of the panel's pixels that went through the network
    level: str = ""  # model and resolution that the budget chose; empty: no budget
    level_saving: Saving = Saving()


@dataclass(frozen=True, slots=True)
class Plan:
    """What is left out, as switches for the pipeline and as words for people."""

    reuse: bool
    focus: bool
    eyes: tuple[bool, bool]  # left, right: which are solved for
    dead_band_m: float | None  # eyes that moved less are not solved for anew; None: only those of a head at rest
    items: tuple[PlanItem, ...] = field(default=())


def eyes_in_range(eyes_m: F64, *, range_deg: float) -> tuple[bool, bool]:
    """Which of two eyes (2, 3) can see the display: before it, and not farther off its axis than `range_deg`."""
    off_axis = np.degrees(np.arctan2(np.linalg.norm(eyes_m[:, 1:], axis=1), eyes_m[:, 0]))
    left, right = (off_axis <= range_deg).tolist()
    return left, right


def seeing_eyes(eyes_m: F64, before: tuple[bool, bool], *, range_deg: float) -> tuple[bool, bool]:
    """The same for a viewer who is watched: an eye that is out comes back only well within the range.

    before: what this answered last. Without the margin an eye at the edge would flicker with the tracker's noise.
    """
    outer = eyes_in_range(eyes_m, range_deg=range_deg)
    inner = eyes_in_range(eyes_m, range_deg=range_deg - RETURN_MARGIN_DEG)
    left, right = (inner[eye] or (before[eye] and outer[eye]) for eye in (0, 1))
    return left, right


def selected_eyes(eyes_m: F64, seeing: tuple[bool, bool]) -> F64:
    """Eyes (2, 3) as they are drawn and solved for: one that can't see gives way to the other, and costs nothing."""
    if seeing == (True, False):
        return eyes_m[[0, 0]]
    if seeing == (False, True):
        return eyes_m[[1, 1]]
    return eyes_m


def make_plan(
    info: ContentInfo,
    stack: PanelStack,
    settings: Settings,
    *,
    eyes_m: F64 | None = None,
    seeing: tuple[bool, bool] | None = None,
    measured: Measured | None = None,
    can_focus: bool = True,
    loaded_modules: Collection[str] = (),
) -> Plan:
    """The plan for one scene and viewer. Make it again when either changes.

    eyes_m: (2, 3) where they are known; seeing: which of them can see the display, where a loop has watched them
    (`seeing_eyes`); can_focus: the model can be run on part of the panels; loaded_modules:
    names in `sys.modules`.
    """
    chosen, numbers = settings.plan, measured or Measured()
    on = chosen.enabled
    reuse = on and chosen.reuse
    focus = on and chosen.focus and can_focus
    if seeing is None and eyes_m is not None:
        seeing = eyes_in_range(eyes_m, range_deg=chosen.range_deg)
    if seeing is None or not any(seeing) or not (on and chosen.one_eye):
        seeing = (True, True)
    fixed_m = chosen.dead_band_mm / 1000 if chosen.dead_band_mm > 0 else None
    items: list[PlanItem] = []
    if reuse and not info.moving:
        band = f"the eyes stay within {chosen.dead_band_mm:g} mm" if fixed_m else "the head rests"
        why = f"the content stands still; as long as {band}, the same solution is shown"
        items.append(_item("render and inference", why, numbers.reuse))
    if on:
        items += network_items(info, numbers)
    if seeing != (True, True):
        side = "right" if seeing[0] else "left"
        items.append(_item(f"the {side} eye", f"it is over {chosen.range_deg:g} degrees off the axis", numbers.one_eye))
    items += [_item(part, f"`{info.name}` has none", Saving()) for part in (info.left_out if on else ())]
    if settings.sensor.driver == "fixed":
        items.append(_item("the sensor", "the eyes' position is given (sensor.driver = fixed)", Saving()))
    absent = [name for name in OPTIONAL_PARTS if name not in loaded_modules]
    if absent:
        why = "not needed here, not imported: " + ", ".join(f"{name} ({OPTIONAL_PARTS[name]})" for name in absent)
        items.append(_item("optional parts", why, Saving()))
    if numbers.level:
        why = f"the budget of {settings.model.budget_ms:g} ms: {numbers.level}"
        items.append(_item("model or resolution", why, numbers.level_saving))
    return Plan(reuse, focus, seeing, fixed_m, tuple(items))


def network_items(info: ContentInfo, numbers: Measured) -> list[PlanItem]:
    """What the model left out of the pictures that it was given."""
    items = _focus_items(info, numbers)
    if numbers.channels == 1:
        why = "the pictures are grey: one channel is solved for all three"
        items.append(_item("two of three colour channels", why, numbers.one_channel))
    return items


def _focus_items(info: ContentInfo, numbers: Measured) -> list[PlanItem]:
    if info.flat_x_m is not None and numbers.active_fraction == 0.0:
        why = "everything lies in the centre panel's plane: both eyes see the same"
        return [_item("inference", why, numbers.focus)]
    if numbers.active_fraction < 1.0:
        why = f"the two eyes differ on {numbers.active_fraction:.0%} of the panel; the rest is filled in closed form"
        return [_item("inference beside the active window", why, numbers.focus)]
    return []


def _item(what: str, why: str, saving: Saving) -> PlanItem:
    return PlanItem(what, why, _rounded(saving.saves_ms, 2), _rounded(saving.costs_db, 3))


def _rounded(number: float | None, digits: int) -> float | None:
    return None if number is None else round(number, digits)
