"""Measure a refresh's quality at the eyes it was aligned to and, live, at the true eyes."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field

import numpy as np

from runtime.evaluation.contact_sheet import Moment
from runtime.evaluation.displayed import EyeViews, displayed
from runtime.optics.carried import PLENTY, carried_db, expected_psnrs_db, intensities
from runtime.optics.focus import FocusTargets
from runtime.optics.light import Sampling, squared_errors
from runtime.optics.pupil import TRACKING_SIGMA_MM
from runtime.optics.quality import Quality
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8, Eyes, RefreshAccount

log = logging.getLogger("phasestack.quality")

# Sampling of light. A displaced view has its errors at edges, so if only a quarter of a small picture's pixels are
# sampled, the measured live quality is off by 0.6 dB.
ALIGNED, LIVE = Sampling(step=2), Sampling(rays=4)
QUICK = Sampling(step=4)  # within 0.1 dB of `ALIGNED` in a third of the time, for a live page
ALIGNED_LARGE, LIVE_LARGE = Sampling(step=4), Sampling(step=2)  # for pictures with more values than `PLENTY`
FIGURES = ("light_db", "psnr_db", "ssim", "carried_db", "psnr_db_true_eyes", "carried_db_true_eyes")
Pictures = tuple[U8, ...]  # (h, w, 3) pictures for the left and right eyes of each person, at a panel's resolution


@dataclass(frozen=True, slots=True)
class RefreshTargets:
    """Target pictures to measure a refresh against. Pictures that were not drawn are None."""

    fov_deg: float  # all pictures' horizontal field of view
    solved: Pictures | None = None  # content at the solution's instant, for the eyes it was solved for
    used: Pictures | None = None  # content at the solution's instant, for the eyes the layers were aligned to
    true: Pictures | None = None  # content at the display time, for the true eyes
    focused: FocusTargets | None = None  # content at the solution's instant, for focusing eyes that it was solved for


@dataclass(frozen=True, slots=True)
class RefreshQuality:
    """Measurements from one refresh, and the pictures for its contact sheet."""

    figures: dict[str, float] = field(default_factory=dict)  # measured values, keyed by name (FIGURES)
    live_error: float | None = None  # mean squared error of the light at the true eyes
    people_errors: dict[int, float] = field(default_factory=dict)  # the same, by number of the person
    moment: Moment | None = None  # pictures for the contact sheet and the viewer page


def view_error_mm(eyes_m: Eyes, solved_for_m: Eyes) -> float:
    """Return the distance, in millimetres, between the midpoints of two pairs of eyes, each (2, 3)."""
    return 1000 * float(np.linalg.norm((eyes_m - solved_for_m).mean(axis=0)))


def live_error(layers: U8, targets: Pictures, stack: PanelStack, *, eyes_m: Eyes, fov_deg: float) -> float:
    """Return the mean squared error of the light at two eyes. Raises ValueError if they see nothing."""
    pictures = [intensities(picture) for picture in targets]
    sampling = LIVE_LARGE if pictures[0].size > PLENTY else LIVE
    errors = squared_errors(
        layers, pictures, stack, solved_for_m=eyes_m, eyes_m=eyes_m, fov_deg=fov_deg, sampling=sampling
    )
    return float(errors[0])


def measure_refresh(
    account: RefreshAccount,
    layers: U8,
    carried: tuple[U8, U8] | None,
    targets: RefreshTargets,
    stack: PanelStack,
    *,
    for_page: bool = False,
) -> RefreshQuality:
    """Measure a refresh's quality for all targets that were drawn, unless the eyes see no part of the
    panels. `carried` are the layers aligned as if all content were on the middle panel, and those before alignment;
    None if more than a solution was shown. `for_page` measures only the light at the aligned eyes, on fewer pixels,
    against what these eyes should see.
    """
    errors = _live_errors(account, layers, targets, stack)
    error = float(np.mean(list(errors.values()))) if errors else None
    try:
        moment, figures = _at_aligned_eyes(account, layers, carried, targets, stack, for_page=for_page)
    except ValueError as why:
        log.info("the quality of this refresh was not measured: %s", why)
        return RefreshQuality(live_error=error, people_errors=errors)
    return RefreshQuality(figures, error, errors, moment)


def true_eyes_of(account: RefreshAccount) -> dict[int, F64]:
    """Return the true eyes (2, 3) of all people served, by number. While there are none, a present viewer
    has number 0.
    """
    people = {person.number: person.true_eyes_m for person in account.people} or {0: account.true_eyes_m}
    return {number: eyes_m for number, eyes_m in people.items() if eyes_m is not None}


def _live_errors(account: RefreshAccount, layers: U8, targets: RefreshTargets, stack: PanelStack) -> dict[int, float]:
    errors: dict[int, float] = {}
    for n, (number, true_m) in enumerate(true_eyes_of(account).items() if targets.true is not None else ()):
        assert targets.true is not None
        pictures = targets.true[2 * n : 2 * n + 2]
        try:
            errors[number] = live_error(layers, pictures, stack, eyes_m=true_m, fov_deg=targets.fov_deg)
        except ValueError as why:
            log.info("the live quality of this refresh was not measured: %s", why)
    return errors


def solved_eyes_of(account: RefreshAccount) -> tuple[F64, F64] | None:
    """Return the eyes that the solution was computed for and those it was aligned to.

    Both are (2P, 3), of the people it was computed for. The result is None without such people.
    """
    solved: list[F64] = []
    used: list[F64] = []
    for person in account.people or (account,):
        if person.solved_for_m is not None and person.eyes_m is not None:
            solved.append(person.solved_for_m)
            used.append(person.eyes_m)
    return (np.concatenate(solved), np.concatenate(used)) if solved else None


def _at_aligned_eyes(
    account: RefreshAccount,
    layers: U8,
    carried: tuple[U8, U8] | None,
    targets: RefreshTargets,
    stack: PanelStack,
    *,
    for_page: bool,
) -> tuple[Moment | None, dict[str, float]]:
    fov_deg, eyes = targets.fov_deg, solved_eyes_of(account)
    if carried is None or eyes is None or targets.solved is None or targets.used is None:
        return None, {}
    solved_for_m, eyes_m = eyes
    true = [*true_eyes_of(account).values()]
    true_m = np.concatenate(true) if 2 * len(true) == len(eyes_m) else None

    aligned, unaligned = carried

    def one_ray_db(layers: U8, pictures: Pictures, *, drawn_for_m: F64, seen_from_m: F64) -> float:
        return carried_db(layers, pictures, stack, solved_for_m=drawn_for_m, eyes_m=seen_from_m, fov_deg=fov_deg)

    unseen = EyeViews((), targets.used, Quality(math.nan, math.nan, ()), stack, eyes_m, fov_deg)
    views = unseen if for_page else displayed(layers, targets.used, stack, eyes_m=eyes_m, fov_deg=fov_deg)
    thorough = ALIGNED_LARGE if targets.solved[0].size > PLENTY else ALIGNED
    # A live page compares the panels' picture with these eyes' target; reprojected content may be torn.
    shown, drawn, drawn_for_m = (layers, targets.used, eyes_m) if for_page else (aligned, targets.solved, solved_for_m)
    light = expected_psnrs_db(
        shown,
        drawn,
        stack,
        eyes_m=drawn_for_m,
        seen_from_m=eyes_m,
        sigmas_mm=(TRACKING_SIGMA_MM,),
        fov_deg=fov_deg,
        sampling=QUICK if for_page else thorough,
    )
    light_db = light[TRACKING_SIGMA_MM]
    moment = Moment(layers, views, light_db, (_line(account),), unaligned, solved_for_m, targets.solved)
    if for_page:
        return moment, {"light_db": light_db}
    values = [light_db, views.quality.psnr_db, views.quality.ssim]
    values.append(one_ray_db(aligned, targets.solved, drawn_for_m=solved_for_m, seen_from_m=eyes_m))
    if targets.true is not None and true_m is not None:
        values.append(one_ray_db(layers, targets.true, drawn_for_m=true_m, seen_from_m=true_m))
        values.append(one_ray_db(aligned, targets.solved, drawn_for_m=solved_for_m, seen_from_m=true_m))
    return moment, dict(zip(FIGURES, values, strict=False))


def _line(account: RefreshAccount) -> str:
    """Return the contact sheet's line that states the refresh's number and view error."""
    assert account.eyes_m is not None and account.solved_for_m is not None
    moved_mm = view_error_mm(account.eyes_m, account.solved_for_m)
    return (
        f"Refresh {account.frame}: the eyes were {moved_mm:.0f} mm from the position that the layers were solved for, "
        "so the outer panels were shifted to match"
    )
