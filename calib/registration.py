"""Measure the panels' poses, with standard errors, from photographs of the calibration boards.

The middle panel is the reference: it defines the stack frame, and its picture is not resampled. For every other panel
the configuration stores the actual distance and a homography from the pixels of an ideal panel, parallel to the
reference, to the pixels of the actual panel. A parallel panel's homography is exact for every eye position. A tilted
panel's is exact only at the viewing position, and the models correct for the tilt at other positions.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from tomlkit import TOMLDocument

from calib.bundle import Bundle, Undetermined, adjust
from calib.config_file import put, put_panels, rewrite
from calib.detect_marks import SeenMarks, find_marks
from calib.placed import PlacedPanel, corner_pixels, through, true_from_ideal_seen
from calib.viewpoints import viewing_place_m
from runtime.config import Settings
from runtime.errors import InputError
from runtime.optics.stack import UNEVEN_MOST, PanelStack, Tilt
from runtime.records import F64, U8
from runtime.support.artifacts import OutputFolder, write_json
from runtime.support.progress import status_line

MIN_PHOTOGRAPHS = 5  # minimum number of usable photographs
MIN_SPAN_DEG = 15.0  # minimum angle between the two photographs whose directions differ most
DISAGREES = 0.4  # share of outliers above which a photograph is excluded
MISFIT_PX = 1.5  # residual above which the stack is not rigid or has moved
IMPLAUSIBLE_M = 0.010  # panel displacement that is too large to be an error in manual assembly
DOUBTFUL_PX = 0.3  # corner uncertainty above which a registration is refused


@dataclass(frozen=True, slots=True)
class Registration:
    """The stack's measured geometry and the panels' homographies, with their uncertainties."""

    bundle: Bundle  # poses of the panels and camera positions
    stack: PanelStack  # geometry to configure, with actual distances and tilts
    gap_sigma_m: F64  # (N-1,) standard deviations of the gaps
    homographies: F64  # (N, 3, 3) from ideal pixels of `stack` to pixels of the actual panels
    corners_px: F64  # (N, 4, 2) displacements of the corners (0, 0), (W, 0), (W, H), (0, H)
    corner_sigma_px: F64  # (N, 4, 2) standard deviations of the displacements
    eye_m: F64  # (3,) viewing position where the homographies are exact, frame `stack`
    used: int  # number of photographs used
    notes: list[str]  # the excluded photographs' names, with reasons

    @property
    def sigma_panel_px(self) -> F64:
        """RMS uncertainty (N,) of each panel's four corners, in panel pixels."""
        return np.asarray(np.sqrt((self.corner_sigma_px**2).sum(-1).mean(-1)), dtype=np.float64)

    def eye_error_mm(self) -> float:
        """Return the eye movement, in mm, that would have the same effect as the worst panel's uncertainty."""
        gap_m = np.abs(np.array(self.stack.x_m) - self.stack.x_m[self.bundle.reference])
        pitch_m, others = self.stack.width_m / self.stack.width_px, gap_m > 0
        return float((self.sigma_panel_px[others] * pitch_m * self.eye_m[0] / gap_m[others]).max()) * 1e3


def homographies(panels: Sequence[PlacedPanel], stack: PanelStack, eye_m: F64) -> F64:
    """Return the homographies (N, 3, 3) from ideal to actual pixels, as seen by an eye at `eye_m`."""
    return np.stack([true_from_ideal_seen(panel, eye_m, stack, index) for index, panel in enumerate(panels)])


def geometry_of(panels: Sequence[PlacedPanel], stack: PanelStack, *, eye_m: F64) -> PanelStack:
    """Return the geometry to configure for panels at their measured poses, registered for the viewing
    position `eye_m`. Raises Undetermined if the panels are not in the configured order.
    """
    x_m = tuple(panel.axis_x_m for panel in panels)
    if any(b <= a for a, b in pairwise(x_m)):
        raise Undetermined("the panels are not in the order of the configuration, from rear to front")
    depth = tuple((0.0, float(right), float(up)) for right, up in (panel.slope + 0.0 for panel in panels))
    x, y, z = (float(value) for value in eye_m)
    return replace(stack, x_m=x_m, tilt=Tilt(depth, (x, y, z)))


def register_photographs(seen: Sequence[SeenMarks], stack: PanelStack, *, eye_m: F64) -> Registration:
    """Fit the panels' poses, for the viewing position `eye_m`, to the marks found in photographs, and
    check the result. Photographs that are faulty, differ in size or contradict the others are excluded. Raises
    Undetermined, with the reason, if they are too few, too similar or inconsistent, or the result is implausible or too
    uncertain.
    """
    reference = stack.count // 2
    excluded = {s.name: s.fault for s in seen if s.fault}
    excluded |= _other_sizes([s for s in seen if not s.fault])
    good = [s for s in seen if s.name not in excluded]
    while True:
        _refuse_few(len(good), len(seen), excluded)
        bundle = adjust(good, stack, reference=reference)
        unfit = [1 - float(bundle.used[bundle.photograph == number].mean()) for number in range(len(good))]
        if max(unfit) <= DISAGREES:
            break
        odd = good.pop(int(np.argmax(unfit)))
        excluded[odd.name] = "contradicts the other photographs (it shows another stack, or something has moved)"
    _refuse_one_place(bundle)
    if bundle.sigma_px > MISFIT_PX:
        raise Undetermined(
            f"the photographs do not show one rigid stack: points deviate by {bundle.sigma_px:.1f} px on average"
        )
    model = geometry_of(bundle.panels, stack, eye_m=eye_m)
    _refuse_implausible(bundle, stack)
    corners = corner_pixels(stack)

    def moved(panels: Sequence[PlacedPanel]) -> F64:
        matrices = homographies(panels, model, eye_m)
        return np.stack([through(matrix, corners) - corners for matrix in matrices])

    corner_sigma_px = bundle.sigma_of(moved)
    worst_px = float(np.linalg.norm(corner_sigma_px, axis=-1).max())
    if worst_px > DOUBTFUL_PX:
        raise Undetermined(
            f"the photographs leave a panel's corner uncertain by {worst_px:.2f} px; take more from other directions"
        )
    return Registration(
        bundle=bundle,
        stack=model,
        gap_sigma_m=bundle.sigma_of(lambda panels: np.diff([panel.axis_x_m for panel in panels])),
        homographies=homographies(bundle.panels, model, eye_m),
        corners_px=moved(bundle.panels),
        corner_sigma_px=corner_sigma_px,
        eye_m=eye_m,
        used=len(good),
        notes=[f"{name} is not used because it {reason}" for name, reason in excluded.items()],
    )


def _other_sizes(good: Sequence[SeenMarks]) -> dict[str, str]:
    sizes = [(s.width_px, s.height_px) for s in good]
    width, height = max(sizes, key=sizes.count, default=(0, 0))
    text = f"has a different size from the other photographs ({width}x{height}); use one camera and one zoom setting"
    return {s.name: text for s, size in zip(good, sizes, strict=True) if size != (width, height)}


def _refuse_few(good: int, count: int, excluded: dict[str, str]) -> None:
    if good < MIN_PHOTOGRAPHS:
        reasons = "; ".join(f"{name} {fault}" for name, fault in excluded.items())
        raise Undetermined(
            f"only {good} of {count} photographs are usable, but at least {MIN_PHOTOGRAPHS} are needed"
            + (f": {reasons}" if reasons else "")
        )


def _refuse_one_place(bundle: Bundle) -> None:
    directions = bundle.places_m - bundle.panels[bundle.reference].centre_m
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    span = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))
    if span < MIN_SPAN_DEG:
        raise Undetermined(
            f"the photographs' directions span only {span:.0f} degrees, but at least {MIN_SPAN_DEG:.0f} are "
            "needed; take some from the left, from the right, from above and from below"
        )


def _refuse_implausible(bundle: Bundle, stack: PanelStack) -> None:
    for index, panel in enumerate(bundle.panels):
        off = panel.centre_m - [stack.x_m[index], 0.0, 0.0]
        if abs(off[0]) > IMPLAUSIBLE_M:
            origin_m = stack.x_m[bundle.reference]
            raise Undetermined(
                f"panel {index} is {abs(panel.axis_x_m - origin_m) * 1e3:.1f} mm from panel {bundle.reference}, but "
                f"{abs(stack.x_m[index] - origin_m) * 1e3:.1f} mm in the configuration; check that the photographs "
                "show this stack and that stack.x_m, width_m and height_m are correct"
            )
        if np.abs(off[1:]).max() > IMPLAUSIBLE_M:
            raise Undetermined(
                f"panel {index} is shifted by {np.linalg.norm(off[1:]) * 1e3:.0f} mm from panel {bundle.reference}; "
                "check that the photographs show this stack, or move the panel into place by hand"
            )


def register_photos(
    pictures: Iterable[tuple[str, U8]], source: str, out: Path, settings: Settings, *, config: Path | None
) -> dict[str, Any]:
    """Register the panels from photographs (names and grey pixels), and write `out/registration.json` and
    the `config`. Raises InputError, which names the `source`, if they do not determine the panels' poses, `config` has
    a different number of panels or cannot be updated, or `out` cannot be written to. `registration.json` is then not
    written.
    """
    stack = settings.stack.stack()
    if config is not None and len(settings.output.panels) not in (0, stack.count):
        problem = f"has {len(settings.output.panels)} tables, but the stack has {stack.count} panels"
        raise InputError(config, "output.panels", problem)
    seen = []
    with status_line("photographs") as say:
        for name, picture in pictures:
            say(name)
            seen.append(find_marks(picture, stack, name=name))
    eye_m = viewing_place_m(settings.calibration)
    try:
        registered = register_photographs(seen, stack, eye_m=eye_m)
    except Undetermined as problem:
        raise InputError(source, "photographs", str(problem)) from None
    summary = registration_summary(registered) | {"source": source}
    with OutputFolder(out) as folder:
        write_json(folder.staging / "registration.json", summary)
        if config is not None:
            kept = rewrite(config, lambda document: put_registration(document, registered))
            summary["kept_version"] = str(kept) if kept else None
    return summary


def put_registration(document: TOMLDocument, registered: Registration) -> None:
    """Set the panels' distances, tilts and homographies in a configuration."""
    matrices = registered.homographies.tolist()
    put_panels(document, "homography", dict(enumerate(matrices)), panels=len(matrices))
    tilt = registered.stack.tilt
    table: dict[str, Any] = {"x_m": [round(float(x), 7) for x in registered.stack.x_m]}
    if tilt is not None:
        table["tilt"] = [[round(right, 7), round(up, 7)] for _, right, up in tilt.depth]
        table["registered_from_m"] = [round(value, 7) for value in tilt.seen_from_m]
    put(document, "stack", table)


def registration_summary(registered: Registration) -> dict[str, Any]:
    """Return the contents of `registration.json`."""
    stack, bundle = registered.stack, registered.bundle
    rows = np.array([panel.rotation[:, 1] for panel in bundle.panels])
    tilt_deg = np.degrees(np.arctan([panel.slope for panel in bundle.panels]))
    panels = [
        {
            "x_m": stack.x_m[index],
            "tilt_deg": tilt_deg[index],  # tilt of the right and the top edge towards the viewer
            "turn_deg": np.degrees(np.arctan2(rows[index, 2], rows[index, 1])),  # counter-clockwise
            "homography": registered.homographies[index],
            "corner_off_px": np.linalg.norm(registered.corners_px[index], axis=1).max(),
            "sigma_px": registered.sigma_panel_px[index],
        }
        for index in range(stack.count)
    ]
    notes = list(registered.notes)
    if not stack.is_evenly_spaced:
        notes.append(
            f"the gaps differ by more than {100 * UNEVEN_MOST:.0f}%, which the networks do not support; use the model "
            "sart"
        )
    return {
        "reference": bundle.reference,
        "eye_m": registered.eye_m,
        "gap_m": np.diff(stack.x_m),
        "gap_sigma_m": registered.gap_sigma_m,
        "points": int(bundle.used.sum()),
        "outliers": int((~bundle.used).sum()),
        "used": registered.used,
        "eye_error_mm": registered.eye_error_mm(),
        "panels": panels,
        "notes": notes,
    }
