"""`calibrate panels photo-trial`: registration by photographs tried on simulated stacks, against the truth."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calib.board import board
from calib.bundle import Undetermined
from calib.detect_marks import find_marks
from calib.photo_judge import displayed_db
from calib.photo_registration import PhotoRegistration, corner_pixels, homographies, register_photographs
from calib.photo_run import wants_even
from calib.placed import PlacedPanel, in_frame_of, misplaced
from calib.registration import through
from calib.simulator import Exposure, Scene, by_hand, camera_rays, phone, photograph, smaller
from calib.viewpoints import viewing_place_m
from runtime.config import Settings
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.report.progress import tracked
from runtime.support.artifacts import OutputFolder, write_json, write_png

PHONE_MEGAPIXELS = 12.0
HALF_WIDTH_95 = 1.959964


@dataclass(frozen=True, slots=True)
class Errors:
    """What a registration is off by, in the frame of the reference panel."""

    pixels: F64  # (K,) distance over an even grid of points of every panel but the reference
    gap_m: F64  # (N-1,)
    inside_95: Any  # (M,) which of the stated 95% intervals hold the truth: gaps, then corners' coordinates


def errors_of(found: PhotoRegistration, truth: tuple[PlacedPanel, ...]) -> Errors:
    """Compare with the true panels, in any frame."""
    stack, reference = found.stack, found.bundle.reference
    true = in_frame_of(truth, reference=reference, reference_x_m=stack.x_m[reference])
    matrices = homographies(true, stack, found.eye_m)
    u, v = np.meshgrid(np.linspace(0, stack.width_px, 17), np.linspace(0, stack.height_px, 10))
    grid, corners = np.column_stack([u.ravel(), v.ravel()]), corner_pixels(stack)
    moving = [index for index in range(stack.count) if index != reference]
    distance = [
        np.linalg.norm(through(found.homographies[i], grid) - through(matrices[i], grid), axis=1) for i in moving
    ]
    corner_off = np.stack([through(found.homographies[i], corners) - through(matrices[i], corners) for i in moving])
    gap_m = np.diff(found.true_x_m) - np.diff([panel.axis_x_m for panel in true])
    inside = np.concatenate([
        np.abs(gap_m) <= HALF_WIDTH_95 * found.gap_sigma_m,
        (np.abs(corner_off) <= HALF_WIDTH_95 * found.corner_sigma_px[moving]).ravel(),
    ])  # fmt: skip
    return Errors(np.concatenate(distance), gap_m, inside)


def simulated_photographs(
    stack: PanelStack, truth: tuple[PlacedPanel, ...], *, count: int, megapixels: float, random: np.random.Generator
) -> list[U8]:
    """`count` photographs (h, w) by hand of the boards on a stack, with one phone of many."""
    layers = np.stack([board(stack, index) for index in range(stack.count)])
    lens = smaller(phone(random=random), float(np.sqrt(megapixels / PHONE_MEGAPIXELS)))
    scene, rays = Scene(stack, truth, layers), camera_rays(lens)
    poses = by_hand(count, stack, random=random)
    return [photograph(scene, lens, pose, Exposure(), random=random, rays=rays) for pose in poses]


def run_trial(
    out: Path,
    settings: Settings,
    stack: PanelStack,
    *,
    stacks: int,
    count: int,
    seed: int,
    megapixels: float,
    off_m: float,
    turn_deg: float,
    model: str,
    keep: bool,
) -> tuple[dict[str, Any], str]:
    """Simulate, photograph, register, compare. Raises InputError, MissingPart."""
    eye_m = viewing_place_m(settings.calibration)
    even = wants_even(settings, stack)
    rows: list[dict[str, Any]] = []
    with OutputFolder(out) as folder:
        for number in tracked("stacks", range(seed, seed + stacks)):
            random = np.random.default_rng(number)
            truth = misplaced(stack, shift_m=off_m, turn_deg=turn_deg, gap_m=off_m, random=random)
            pictures = simulated_photographs(stack, truth, count=count, megapixels=megapixels, random=random)
            if keep:
                for index, picture in enumerate(pictures):
                    write_png(folder.staging / f"stack-{number}" / f"photograph-{index + 1:02d}.png", picture)
            begin = time.perf_counter()
            seen = [find_marks(picture, stack, name=str(index + 1)) for index, picture in enumerate(pictures)]
            row: dict[str, Any] = {"seed": number}
            try:
                found = register_photographs(seen, stack, eye_m=eye_m, even=even)
            except Undetermined as problem:
                rows.append(row | {"refused": str(problem)})
                continue
            row["seconds"] = time.perf_counter() - begin
            errors = errors_of(found, truth)
            row |= {
                "used": sum(v.used for v in found.verdicts),
                "rms_px": float(np.sqrt((errors.pixels**2).mean())),
                "max_px": float(errors.pixels.max()),
                "gap_error_mm": (errors.gap_m * 1e3).tolist(),
                "inside_95": int(errors.inside_95.sum()),
                "intervals": len(errors.inside_95),
                "sigma_px": found.bundle.sigma_px,
            }
            if model:
                reference = stack.count // 2
                true = in_frame_of(truth, reference=reference, reference_x_m=stack.x_m[reference])
                row["psnr_db"] = displayed_db(found, settings, stack, model=model, truth=true, even=even)
            rows.append(row)
        summary = _summary(rows) | {"stacks": rows, "photographs": count, "megapixels": megapixels}
        write_json(folder.staging / "trial.json", summary)
    return summary, _text(summary)


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    done = [row for row in rows if "refused" not in row]
    if not done:
        return {"registered": 0, "refused": len(rows)}
    found: dict[str, Any] = {
        "registered": len(done),
        "refused": len(rows) - len(done),
        "rms_px": float(np.sqrt(np.mean([row["rms_px"] ** 2 for row in done]))),
        "worst_px": max(row["max_px"] for row in done),
        "worst_gap_mm": max(abs(value) for row in done for value in row["gap_error_mm"]),
        "coverage_95": sum(row["inside_95"] for row in done) / sum(row["intervals"] for row in done),
        "seconds_max": max(row["seconds"] for row in done),
    }
    judged = [row["psnr_db"] for row in done if "psnr_db" in row]
    if judged:
        found["psnr_db"] = {name: float(np.mean([db[name] for db in judged])) for name in judged[0]}
        for name, way in (("worst_loss_db", "registered"), ("worst_loss_without_error_db", "registered without error")):
            found[name] = max(db["perfect stack"] - db[way] for db in judged)
    return found


def _text(summary: dict[str, Any]) -> str:
    lines = [
        f"stack {row['seed']}: "
        + (
            f"refused: {row['refused']}"
            if "refused" in row
            else f"{row['rms_px']:.3f} px RMS, {row['max_px']:.3f} at worst, gaps off by "
            + ", ".join(f"{value:+.3f}" for value in row["gap_error_mm"])
            + f" mm, {row['seconds']:.1f} s"
            + "".join(f", {name} {value:.2f} dB" for name, value in row.get("psnr_db", {}).items())
        )
        for row in summary["stacks"]
    ]
    if summary["registered"]:
        lines.append(
            f"all: {summary['rms_px']:.3f} px RMS, {summary['worst_px']:.3f} at worst, gaps within "
            f"{summary['worst_gap_mm']:.3f} mm, {100 * summary['coverage_95']:.0f}% of the 95% intervals hold the truth"
        )
    return "\n".join(lines)
