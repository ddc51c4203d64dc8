"""Answers given on the status socket about a run: its status, constant facts and pictures."""

from __future__ import annotations

import time
from base64 import b64encode
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from runtime.clock import NS_PER_MS
from runtime.config import PLACING, ContentSettings, Settings
from runtime.content.frames import PICTURES
from runtime.content.presets import preset_names
from runtime.content.registry import MESHES, PLAYLISTS, SPLATS
from runtime.content.scenes import SCENES
from runtime.daemon.build import Run
from runtime.evaluation.refresh_quality import view_error_mm
from runtime.frame.messages import Facts
from runtime.frame.refresh import Refresh, Status
from runtime.model.predictor import SHIPPED
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import U8, RefreshAccount
from runtime.support.picture_header import VIDEOS
from runtime.support.version import version

LIBRARY_MOST, LIBRARY_LOOKED_AT = 200, 2000  # limits: how many scenes are listed, how many folder entries are examined
IN_LIBRARY = {*PICTURES, *VIDEOS, *MESHES, *PLAYLISTS, *SPLATS}  # suffixes of files that can be used as scenes


def placing_in(settings: Settings) -> dict[str, Any]:
    """Return the current values of all settings that `ctl place` can change."""
    return settings.content.model_dump(include=set(PLACING))


def holds(facts: Facts, *, paused: bool, flat_asked: bool) -> dict[str, Any]:
    """Return the current scene, model, placement and pause, for inclusion in answers to commands."""
    return {
        "scene": facts.settings.content.scene,
        "content": facts.info.name,
        "model": facts.model.name,
        "placing": placing_in(facts.settings),
        "paused": paused,
        "flat_asked": flat_asked,
    }


def shown(status: Status, *, light: Mapping[str, Any], head_of: Callable[[int], int | None]) -> dict[str, Any]:
    """Return the facts of the latest refresh for a page that displays the panels.
    `head_of` returns the number of a person's head in the sensor's true eyes.
    """
    account, frame, solution = status.refresh.account, status.refresh.frame, status.refresh.solution
    solved_for = []
    if solution is not None and solution.solved_for_m is not None:
        solved_for = [*zip(solution.people, solution.solved_for_m.reshape(-1, 2, 3), strict=True)]
    return {
        "frame": account.frame,
        "state": status.name,
        "reason": status.reason,
        "people": [{"number": p.number, "eyes_m": p.eyes_m, "head": head_of(p.number)} for p in account.people],
        "capture_ns": account.capture_ns,
        "eyes_label": account.eyes_label,
        "eye_sigma_mm": account.eye_sigma_mm,
        "flatness": 1.0 if frame.solved is None else frame.flatness,
        "solved_for": [{"number": number, "eyes_m": eyes_m} for number, eyes_m in solved_for],
        "state_version": None if solution is None else solution.state_version,
        "is_current": solution is not None and solution.state_version == status.refresh.state_version,
        "scene": status.settings.content.scene,
        "model": status.settings.model.name,
        **light,
    }


def snapshot(status: Status, run: Run) -> dict[str, Any]:
    """Return the answer to a `status` request, with the figures that `run` has collected so far."""
    account, facts, live = status.refresh.account, status.facts, status.live
    return {
        "state": status.name,
        "reason": status.reason,
        "missing": status.missing,
        **holds(facts, paused=status.paused, flat_asked=status.flat_asked),
        "content_problem": live.problem,
        "content_left_out": facts.info.left_out,
        "program": live.program,
        "playlist": live.playlist,
        "plan": run.plan_items(facts, live),
        "model_asked": facts.settings.model.name,
        "provider": facts.model.provider,
        "backend": facts.backend,
        "backend_why": facts.backend_why,
        "panels": run.presenter.panels.name,
        "processes": run.processes(),
        "eyes_m": account.eyes_m,
        "people": people_served(account),
        "people_in_view": status.people_in_view,
        "eyes_label": account.eyes_label,
        "eye_sigma_now_mm": account.eye_sigma_mm,
        "solution": account.solution,
        # A solution computed for a time after this display time has no age yet.
        "solution_age_now_ms": None if account.solution_age_ms is None else max(0.0, account.solution_age_ms),
        "effort": account.effort,
        **run.observer.light(status.refresh),
        **run.observer.live(),
        "view_error_estimated_now_mm": _view_error_now_mm(account),
        "photon_now_ms": (account.photon_ns - account.capture_ns) / NS_PER_MS if account.capture_ns else None,
        "rejected_samples": status.rejected_samples,
        "sensor_hz": status.sensor_hz,
        **run.presenter.stats.rates_now(),
        **run.presenter.stats.summary(stale_inputs=status.stale_inputs),
    }


def people_served(account: RefreshAccount) -> list[dict[str, Any]]:
    """Return the number, the eyes and the estimated view error of each person who is served."""
    return [
        {
            "number": person.number,
            "eyes_m": person.eyes_m,
            "view_error_estimated_mm": None
            if person.solved_for_m is None
            else round(view_error_mm(person.eyes_m, person.solved_for_m), 2),
        }
        for person in account.people
    ]


def _view_error_now_mm(account: RefreshAccount) -> float | None:
    """Return the view error for the tracked eyes, in mm, or None without a viewer or a solution."""
    if account.eyes_m is None or account.solved_for_m is None:
        return None
    return round(view_error_mm(account.eyes_m, account.solved_for_m), 2)


def about(settings: Settings, stack: PanelStack) -> dict[str, Any]:
    """Return a run's constant facts and the models and scenes that can be chosen, for use by the page."""
    return {
        "version": version(),
        "stack": {"width_m": stack.width_m, "height_m": stack.height_m, "x_m": stack.x_m},
        "viewing_m": settings.calibration.viewing_m,
        "viewing_side_deg": settings.calibration.viewing_side_deg,
        "viewing_up_deg": settings.calibration.viewing_up_deg,
        "models": (*SHIPPED, "sart"),
        "scenes": (*SCENES, *library_scenes(settings.content)),
        "library": settings.content.library,
        "presets": preset_names(),  # scenes whose data is not shipped
    }


def library_scenes(settings: ContentSettings) -> tuple[str, ...]:
    """List at most `LIBRARY_MOST` paths of scenes in the library folder, those in UTF-8."""
    if not settings.library:
        return ()
    try:
        entries = sorted(Path(settings.library).absolute().iterdir())[:LIBRARY_LOOKED_AT]
    except (OSError, ValueError):
        return ()
    entries = [path for path in entries if not path.name.startswith(".") and path.name.isprintable()]
    scenes = [str(path) for path in entries if path.suffix.lower() in IN_LIBRARY or path.is_dir()]
    return tuple(scenes[:LIBRARY_MOST])


def pictures(status: Status | None, stack: PanelStack) -> dict[str, Any]:
    """Return base64-encoded JPEG thumbnails of the latest refresh, with its time and state."""
    if status is None:
        return {"frame": None, "jpegs": {}}
    jpegs = pictures_of(status.refresh, stack, fov_deg=status.settings.content.fov_deg)
    return {
        "frame": status.refresh.account.frame,
        "time_s": time.time(),
        "state": status.name,
        "eyes_m": _shown_to(status.refresh)[1],
        "jpegs": {name: b64encode(jpeg).decode() for name, jpeg in jpegs.items()},
    }


WIDTH_PX = 256  # width of each thumbnail on the page
JPEG_QUALITY = 80


def pictures_of(refresh: Refresh, stack: PanelStack, *, fov_deg: float) -> dict[str, bytes]:
    """Return thumbnails of a refresh as JPEG files, keyed by name. The layers are named `layer-0` (the
    rear panel), `layer-1` and so on. Each eye's view, `seen-left` and `seen-right`, is computed from reduced layers at
    the eye position that was solved for, because an exact view would take longer than a refresh.
    """
    shown, eyes_m = _shown_to(refresh)
    if shown is None:
        return {}
    width = min(WIDTH_PX, stack.width_px)
    small = replace(stack, width_px=width, height_px=max(1, round(width * stack.height_px / stack.width_px)))
    size = small.width_px, small.height_px
    part = slice(
        None, None, max(1, shown.shape[2] // (2 * width))
    )  # first sample at twice the final size, because averaging all pixels takes 15 ms
    parts = (np.ascontiguousarray(layer[part, part]) for layer in shown)
    resized = [cv2.resize(layer, size, interpolation=cv2.INTER_AREA) for layer in parts]
    layers: U8 = np.stack(resized).astype(np.uint8, copy=False)
    jpegs = {f"layer-{n}": _jpeg(layer) for n, layer in enumerate(layers)}
    for name, eye_m in zip(("seen-left", "seen-right"), () if eyes_m is None else eyes_m, strict=False):
        if eye_m[0] > max(stack.x_m):
            seen = seen_by(eye_m, layers, small, fov_deg=fov_deg)
            jpegs[name] = _jpeg(np.rint(255 * seen.image * seen.mask[..., None]).astype(np.uint8))
    return jpegs


def _shown_to(refresh: Refresh) -> tuple[U8 | None, Any]:
    """Return the layers that are shown, and the eye positions that they are for."""
    frame, account = refresh.frame, refresh.account
    is_flat = frame.solved is None or (frame.flat is not None and frame.flatness > 0.5)
    return (frame.flat, account.eyes_m) if is_flat else (frame.solved, account.solved_for_m)


def _jpeg(image: U8) -> bytes:
    """Encode a picture (h, w, 3 or 4) as JPEG, without any fourth channel."""
    done, coded = cv2.imencode(".jpg", image[..., 2::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError("OpenCV could not encode a picture as JPEG")
    return coded.tobytes()
