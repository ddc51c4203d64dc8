"""`calibrate panels cost|simulate`: displayed dB of displaced panels, and what registering them gains."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from calib.misregistration import corrected, displayed_quality, shifted
from calib.panel_figures import cost_figure
from calib.panel_run import asked_settings, fit_registration
from calib.pictures import file_pictures, layers_for, scene_pictures
from calib.registration import error_over_panel_px, register, true_from_ideal
from calib.vernier import simulate, write_settings
from runtime.config import Settings
from runtime.errors import EyesNotServed, InputError
from runtime.optics.stack import PanelStack
from runtime.records import F64
from runtime.report.page import Figure, Page, in_columns, section_of
from runtime.support.artifacts import write_json

SHIFTS_PX = (0.0, 0.1, 0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
JUDGED_EYES_M = ((0.6, -0.03, 0.0), (0.6, 0.03, 0.0))
MISPLACED_PX = 4.0  # of a simulated stack's corners, all together, standard deviation
MISSHAPEN_PX = 2.0  # each corner for itself


def measure_cost(
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    eyes_m: tuple[tuple[float, float, float], ...],
    pictures: tuple[Path, Path] | None,
    model: str,
) -> tuple[dict[str, Any], str]:
    """Displace each panel in turn, to the side. Raises InputError, MissingPart."""
    eyes, fov_deg = np.array(eyes_m), settings.content.fov_deg
    wanted = scene_pictures(settings, stack, eyes) if pictures is None else file_pictures(pictures)
    try:
        layers = layers_for(wanted, stack, eyes, settings=settings, model=model, fov_deg=fov_deg)
    except EyesNotServed as error:
        raise InputError("calibrate panels cost", "--left-eye, --right-eye", str(error)) from None
    found: dict[str, list[float]] = {f"panel {index}": [] for index in reversed(range(stack.count))}
    work = [(index, shift) for index in range(stack.count) for shift in SHIFTS_PX]
    for index, shift in track(work, "displacements", console=Console(stderr=True), transient=True):
        matrices = shifted(stack, index=index, shift_px=(shift, 0.0))
        result = displayed_quality(layers, wanted, eyes, stack, matrices, fov_deg=fov_deg)
        found[f"panel {index}"].append(result.psnr_db)
    summary = {"shifts_px": list(SHIFTS_PX), "psnr_db": found, "model": model, "eyes_m": eyes}
    rows = [["displaced", *[f"{shift:g} px" for shift in SHIFTS_PX]]]
    rows += [[name, *[f"{value:.2f}" for value in values]] for name, values in found.items()]
    figure = Figure("cost", cost_figure(SHIFTS_PX, found), "Displayed PSNR against a panel's displacement")
    lead = f"Layers by {model}; one panel displaced to the side, the others right; displayed PSNR, dB."
    page = Page("What registration error costs", lead, [replace(section_of("dB", rows), figures=[figure])])
    page.write(out, record="cost.json", data=summary)
    return summary, in_columns(rows)


def misaligned(stack: PanelStack, *, reference: int, random: np.random.Generator) -> list[F64]:
    """A stack as hands build it: every panel but the reference displaced, turned, scaled and keystoned a little."""
    found = []
    for index in range(stack.count):
        corners = random.normal(scale=MISSHAPEN_PX, size=(4, 2)) + random.normal(scale=MISPLACED_PX, size=2)
        corners *= stack.width_px / 1920
        found.append(
            np.eye(3)
            if index == reference
            else true_from_ideal(corners, width_px=stack.width_px, height_px=stack.height_px)
        )
    return found


def simulate_registration(
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    eye_m: tuple[float, float, float],
    seed: int,
    noise_px: float,
    viewpoint_error_m: float,
    model: str,
) -> tuple[dict[str, Any], str]:
    """Misalign, set, register, and look: errors in pixels and, with a model, displayed dB. Raises InputError."""
    random = np.random.default_rng(seed)
    reference = stack.count // 2
    truth = misaligned(stack, reference=reference, random=random)
    asked = asked_settings(stack, eye_m=eye_m, reference=reference)
    offset_m = random.normal(scale=1.0, size=3) * viewpoint_error_m
    taken = simulate(asked, stack, truth, noise_px=noise_px, viewpoint_error_m=offset_m, random=random)
    registration = register(taken, stack, reference=reference)
    found = [panel.true_from_ideal for panel in registration.panels]
    size = {"width_px": stack.width_px, "height_px": stack.height_px}
    errors = [error_over_panel_px(a, b, **size) for a, b in zip(found, truth, strict=True)]
    before = [error_over_panel_px(np.eye(3), b, **size) for b in truth]
    summary: dict[str, Any] = {
        "seed": seed,
        "noise_px": noise_px,
        "viewpoint_error_m": offset_m,
        "misaligned_rms_px": [_rms(e) for e in before],
        "error_rms_px": [_rms(e) for e in errors],
        "error_max_px": [float(e.max()) for e in errors],
    }
    if model:
        summary["psnr_db"] = _gain(settings, stack, truth, found, model=model)
    write_settings(out / "vernier.csv", taken)
    fit_registration(out / "vernier.csv", out, settings, stack, reference=reference, config=None)
    write_json(out / "simulation.json", summary)
    lines = [
        f"panel {index}: misaligned by {_rms(before[index]):.2f} px RMS, recovered to {_rms(errors[index]):.3f} px "
        f"RMS, {errors[index].max():.3f} px at most"
        for index in range(stack.count)
        if index != reference
    ]
    if model:
        lines.append(", ".join(f"{name} {value:.2f} dB" for name, value in summary["psnr_db"].items()))
    return summary, "\n".join(lines)


def _rms(values: F64) -> float:
    return float(np.sqrt((values**2).mean()))


def _gain(settings: Settings, stack: PanelStack, truth: list[F64], found: list[F64], *, model: str) -> dict[str, float]:
    eyes, fov_deg = np.array(JUDGED_EYES_M), settings.content.fov_deg
    wanted = scene_pictures(settings, stack, eyes)
    layers = layers_for(wanted, stack, eyes, settings=settings, model=model, fov_deg=fov_deg)
    straight = [np.eye(3)] * stack.count
    shown = {
        "perfect stack": (layers, straight),
        "misaligned": (layers, truth),
        "registered": (corrected(layers, found), truth),
        "registered, error-free": (corrected(layers, truth), truth),
    }
    return {
        name: displayed_quality(picture, wanted, eyes, stack, matrices, fov_deg=fov_deg).psnr_db
        for name, (picture, matrices) in shown.items()
    }
