"""Registration from photographs of the boards: positions, homographies, standard errors.

The stack's frame is the reference (middle) panel's: it stays where it is and its picture is not resampled. The other
panels get their true distance, and a homography that puts each of their pixels where a panel parallel to the
reference would have it: exact for every eye where the panel is parallel, and for an eye at the viewing place where
it is tilted. The models get the tilts, and solve for what other eyes see of such a panel.
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
from runtime.support.artifacts import write_json
from runtime.support.progress import status_line

MIN_PHOTOGRAPHS = 5  # that are usable
MIN_SPAN_DEG = 15.0  # between the two directions that lie farthest apart
DISAGREES = 0.4  # share of a photograph's points that do not fit
MISFIT_PX = 1.5  # of a photograph: panels that move, or no rigid stack at all
IMPLAUSIBLE_M = 0.010  # a panel farther off than hands put it
DOUBTFUL_PX = 0.3  # a corner that is not known better is not worth writing


@dataclass(frozen=True, slots=True)
class Registration:
    """Registered panels, with their uncertainty."""

    bundle: Bundle
    stack: PanelStack  # the geometry to configure: true distances, and tilts
    gap_sigma_m: F64  # (N-1,)
    homographies: F64  # (N, 3, 3) true pixels from ideal ones of `stack`
    corners_px: F64  # (N, 4, 2) displacement of the corners (0, 0), (W, 0), (W, H), (0, H)
    corner_sigma_px: F64  # (N, 4, 2)
    eye_m: F64  # (3,) the viewing place
    used: int  # photographs
    notes: list[str]  # photographs that were left out, and why

    @property
    def sigma_panel_px(self) -> F64:
        """(N,) RMS uncertainty of a panel's corner, distance in pixels of the panel."""
        return np.asarray(np.sqrt((self.corner_sigma_px**2).sum(-1).mean(-1)), dtype=np.float64)

    def eye_error_mm(self) -> float:
        """The eye's displacement that would look like the worst panel's uncertainty."""
        gap_m = np.abs(np.array(self.stack.x_m) - self.stack.x_m[self.bundle.reference])
        pitch_m, others = self.stack.width_m / self.stack.width_px, gap_m > 0
        return float((self.sigma_panel_px[others] * pitch_m * self.eye_m[0] / gap_m[others]).max()) * 1e3


def homographies(panels: Sequence[PlacedPanel], stack: PanelStack, eye_m: F64) -> F64:
    """(N, 3, 3) true pixels from ideal ones, as an eye sees them."""
    return np.stack([true_from_ideal_seen(panel, eye_m, stack, index) for index, panel in enumerate(panels)])


def geometry_of(panels: Sequence[PlacedPanel], stack: PanelStack, *, eye_m: F64) -> PanelStack:
    """The configurable geometry of posed panels: positions, tilts and homographies for an eye (3,).

    Raises Undetermined where the panels do not stand in order.
    """
    x_m = tuple(panel.axis_x_m for panel in panels)
    if any(b <= a for a, b in pairwise(x_m)):
        raise Undetermined("the panels do not stand one before the other in the order of the configuration")
    depth = tuple((0.0, float(right), float(up)) for right, up in (panel.slope + 0.0 for panel in panels))
    x, y, z = (float(value) for value in eye_m)
    return replace(stack, x_m=x_m, tilt=Tilt(depth, (x, y, z)))


def register_photographs(seen: Sequence[SeenMarks], stack: PanelStack, *, eye_m: F64) -> Registration:
    """Fit and judge. Raises Undetermined, saying what is wrong."""
    reference = stack.count // 2
    left_out = {s.name: s.fault for s in seen if s.fault}
    left_out |= _other_sizes([s for s in seen if not s.fault])
    good = [s for s in seen if s.name not in left_out]
    while True:
        _refuse_few(len(good), len(seen), left_out)
        bundle = adjust(good, stack, reference=reference)
        unfit = [1 - float(bundle.used[bundle.photograph == number].mean()) for number in range(len(good))]
        if max(unfit) <= DISAGREES:
            break
        odd = good.pop(int(np.argmax(unfit)))
        left_out[odd.name] = "does not agree with the others: another stack, or something moved"
    _refuse_one_place(bundle)
    if bundle.sigma_px > MISFIT_PX:
        raise Undetermined(
            f"the photographs do not show one rigid stack: points are {bundle.sigma_px:.1f} px off on average"
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
            f"the photographs leave a panel's corner uncertain by {worst_px:.2f} px: take more, from more directions"
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
        notes=[f"{name} {why}: left out" for name, why in left_out.items()],
    )


def _other_sizes(good: Sequence[SeenMarks]) -> dict[str, str]:
    sizes = [(s.width_px, s.height_px) for s in good]
    width, height = max(sizes, key=sizes.count, default=(0, 0))
    text = f"has another size than the others ({width}x{height}): one camera, one setting"
    return {s.name: text for s, size in zip(good, sizes, strict=True) if size != (width, height)}


def _refuse_few(good: int, count: int, left_out: dict[str, str]) -> None:
    if good < MIN_PHOTOGRAPHS:
        why = "; ".join(f"{name} {fault}" for name, fault in left_out.items())
        raise Undetermined(
            f"{good} of {count} photographs can be used, at least {MIN_PHOTOGRAPHS} are needed"
            + (f": {why}" if why else "")
        )


def _refuse_one_place(bundle: Bundle) -> None:
    directions = bundle.places_m - bundle.panels[bundle.reference].centre_m
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    span = float(np.degrees(np.arccos(np.clip((directions @ directions.T).min(), -1, 1))))
    if span < MIN_SPAN_DEG:
        raise Undetermined(
            f"the photographs are all from one place (their directions span {span:.0f} degrees, at least "
            f"{MIN_SPAN_DEG:.0f} are needed): take some from the left and the right, from above and below"
        )


def _refuse_implausible(bundle: Bundle, stack: PanelStack) -> None:
    for index, panel in enumerate(bundle.panels):
        off = panel.centre_m - [stack.x_m[index], 0.0, 0.0]
        if abs(off[0]) > IMPLAUSIBLE_M:
            origin_m = stack.x_m[bundle.reference]
            raise Undetermined(
                f"panel {index} stands {abs(panel.axis_x_m - origin_m) * 1e3:.1f} mm from panel {bundle.reference}, "
                f"the configuration says {abs(stack.x_m[index] - origin_m) * 1e3:.1f}: photographs of "
                "another stack, or stack.x_m, width_m and height_m are not this stack's"
            )
        if np.abs(off[1:]).max() > IMPLAUSIBLE_M:
            raise Undetermined(
                f"panel {index} lies {np.linalg.norm(off[1:]) * 1e3:.0f} mm beside panel {bundle.reference}: "
                "photographs of another stack, or a panel that is to be put right by hand first"
            )


def register_photos(
    pictures: Iterable[tuple[str, U8]], source: str, out: Path, settings: Settings, *, config: Path | None
) -> dict[str, Any]:
    """Register from named photographs (h, w), report, and optionally write into `config`.

    Raises InputError; nothing is written then.
    """
    stack = settings.stack.stack()
    if config is not None and len(settings.output.panels) not in (0, stack.count):
        problem = f"has {len(settings.output.panels)} tables for {stack.count} panels"
        raise InputError(config, "output.panels", problem)
    seen = []
    with status_line("photographs") as say:
        for name, picture in pictures:
            say(name)
            seen.append(find_marks(picture, stack, name=name))
    eye_m = viewing_place_m(settings.calibration)
    try:
        found = register_photographs(seen, stack, eye_m=eye_m)
    except Undetermined as problem:
        raise InputError(source, "photographs", str(problem)) from None
    summary = registration_summary(found) | {"source": source}
    write_json(out / "registration.json", summary)
    if config is not None:
        kept = rewrite(config, lambda configured: put_registration(configured, found))
        summary["kept_version"] = str(kept) if kept else None
    return summary


def put_registration(document: TOMLDocument, found: Registration) -> None:
    """Set distances, tilts and homographies in a configuration."""
    matrices = found.homographies.tolist()
    put_panels(document, "homography", dict(enumerate(matrices)), panels=len(matrices))
    tilt = found.stack.tilt
    table: dict[str, Any] = {"x_m": [round(float(x), 7) for x in found.stack.x_m]}
    if tilt is not None:
        table["tilt"] = [[round(right, 7), round(up, 7)] for _, right, up in tilt.depth]
        table["registered_from_m"] = [round(value, 7) for value in tilt.seen_from_m]
    put(document, "stack", table)


def registration_summary(found: Registration) -> dict[str, Any]:
    """What `registration.json` holds."""
    stack, bundle = found.stack, found.bundle
    rows = np.array([panel.rotation[:, 1] for panel in bundle.panels])
    tilt_deg = np.degrees(np.arctan([panel.slope for panel in bundle.panels]))
    panels = [
        {
            "x_m": stack.x_m[index],
            "tilt_deg": tilt_deg[index],  # by how much its right edge, and its top edge, come towards the viewer
            "turn_deg": np.degrees(np.arctan2(rows[index, 2], rows[index, 1])),  # counter-clockwise, in its own plane
            "homography": found.homographies[index],
            "corner_off_px": np.linalg.norm(found.corners_px[index], axis=1).max(),
            "sigma_px": found.sigma_panel_px[index],
        }
        for index in range(stack.count)
    ]
    notes = list(found.notes)
    if not stack.is_evenly_spaced:
        notes.append(f"the gaps differ by more than {100 * UNEVEN_MOST:.0f}%: the model sart serves them, no network")
    return {
        "reference": bundle.reference,
        "eye_m": found.eye_m,
        "gap_m": np.diff(stack.x_m),
        "gap_sigma_m": found.gap_sigma_m,
        "points": int(bundle.used.sum()),
        "outliers": int((~bundle.used).sum()),
        "used": found.used,
        "eye_error_mm": found.eye_error_mm(),
        "panels": panels,
        "notes": notes,
    }
