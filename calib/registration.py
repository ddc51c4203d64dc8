"""From photographs of the boards to what the runtime needs: distances, homographies, and how far to trust them.

The stack's frame is the reference (middle) panel's: it stays where it is and its picture is not resampled. The other
panels get their true distance, and a homography that puts each of their pixels where a panel parallel to the
reference would have it: exact for every eye where the panel is parallel, and for an eye at the viewing place where
it is tilted. The models get the tilts, and solve for what other eyes see of such a panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.bundle import Bundle, Undetermined, adjust
from calib.detect_marks import SeenMarks
from calib.placed import PlacedPanel, corner_pixels, found_stack, through, true_from_ideal_seen
from runtime.optics.stack import PanelStack, Tilt
from runtime.records import F64

MIN_PHOTOGRAPHS = 5
WANTED_PHOTOGRAPHS = 8
MIN_SPAN_DEG = 15.0  # between the two directions that lie farthest apart
DISAGREES = 0.4  # share of a photograph's points that do not fit
MISFIT_PX = 1.5  # of a photograph: panels that move, or no rigid stack at all
IMPLAUSIBLE_M = 0.010  # a panel farther off than hands put it
DOUBTFUL_PX = 0.3  # a corner that is not known better is not worth writing
FEWER_IS_NOTED_PX = 0.1


@dataclass(frozen=True, slots=True)
class Verdict:
    """What became of one photograph."""

    name: str
    used: bool
    points: int
    rms_px: float  # of its residuals that were used, in the photograph; infinite where it was not
    reason: str  # why it was left out; empty: it was not


@dataclass(frozen=True, slots=True)
class Registration:
    """Where the panels are, and how that is known."""

    bundle: Bundle
    stack: PanelStack  # the geometry to configure: true distances, or even ones near them, and tilts
    true_x_m: F64  # (N,)
    gap_sigma_m: F64  # (N-1,)
    homographies: F64  # (N, 3, 3) true pixels from ideal ones of `stack`
    corners_px: F64  # (N, 4, 2) displacement of the corners (0, 0), (W, 0), (W, H), (0, H)
    corner_sigma_px: F64  # (N, 4, 2)
    eye_m: F64  # (3,) the viewing place
    verdicts: tuple[Verdict, ...]
    notes: tuple[str, ...]

    @property
    def tilt_deg(self) -> F64:
        """(N, 2) by how much each panel's right edge, and its top edge, come towards the viewer."""
        return np.degrees(np.arctan([panel.slope for panel in self.bundle.panels]))

    @property
    def turn_deg(self) -> F64:
        """(N,) by how much each panel is turned in its own plane, counter-clockwise as the viewer sees it."""
        rows = np.array([panel.rotation[:, 1] for panel in self.bundle.panels])
        return np.asarray(np.degrees(np.arctan2(rows[:, 2], rows[:, 1])), dtype=np.float64)

    @property
    def sigma_panel_px(self) -> F64:
        """(N,) RMS uncertainty of a panel's corner, distance in pixels of the panel."""
        return np.asarray(np.sqrt((self.corner_sigma_px**2).sum(-1).mean(-1)), dtype=np.float64)

    def eye_error_mm(self) -> float:
        """The eye's displacement that would look like the worst panel's uncertainty."""
        reference = self.bundle.reference
        pitch_m, found = self.stack.width_m / self.stack.width_px, 0.0
        for index, sigma in enumerate(self.sigma_panel_px):
            gap = abs(self.stack.x_m[index] - self.stack.x_m[reference])
            if gap:
                found = max(found, float(sigma) * pitch_m * float(self.eye_m[0]) / gap)
        return found * 1e3


def homographies(panels: Sequence[PlacedPanel], stack: PanelStack, eye_m: F64) -> F64:
    """(N, 3, 3) true pixels from ideal ones, as an eye sees them."""
    return np.stack([true_from_ideal_seen(panel, eye_m, stack, index) for index, panel in enumerate(panels)])


def evenly_spaced(stack: PanelStack, *, reference: int) -> PanelStack:
    """The even distances nearest to a stack's, the reference panel kept: what the shipped networks serve."""
    steps = np.arange(stack.count) - reference
    gap = float((steps * (np.array(stack.x_m) - stack.x_m[reference])).sum() / (steps**2).sum())
    x_m = tuple(stack.x_m[reference] + gap * step for step in steps.tolist())
    return replace(stack, x_m=x_m)


def tilt_of(panels: Sequence[PlacedPanel], eye_m: F64) -> Tilt:
    """What models need to know of tilted panels whose homographies are for an eye (3,)."""
    x, y, z = np.asarray(eye_m, dtype=np.float64).tolist()
    depth = tuple((0.0, float(right), float(up)) for right, up in (panel.slope + 0.0 for panel in panels))
    return Tilt(depth, (x, y, z))


def geometry_of(
    panels: Sequence[PlacedPanel], stack: PanelStack, *, eye_m: F64, even: bool | None, reference: int
) -> PanelStack:
    """The geometry to configure for panels that stand so: their distances, or even ones near them, and tilts.

    even: as in `register_photographs`. Raises ValueError where the panels do not stand in order.
    """
    true = found_stack(panels, stack)
    if even is None:
        even = not true.is_evenly_spaced
    return replace(evenly_spaced(true, reference=reference) if even else true, tilt=tilt_of(panels, eye_m))


def register_photographs(
    seen: Sequence[SeenMarks], stack: PanelStack, *, eye_m: F64, even: bool | None
) -> Registration:
    """Fit and judge. Raises Undetermined, saying what is wrong.

    even: write even distances near the true ones; None: where those are too uneven for the shipped networks.
    """
    reference = stack.count // 2
    faults = {s.name: s.fault for s in seen if s.fault}
    faults |= _other_sizes([s for s in seen if not s.fault])
    bundle, good = None, [s for s in seen if s.name not in faults]
    while True:
        _refuse_few(good, seen, faults)
        bundle = adjust(good, stack, reference=reference)
        odd = _disagreeing(bundle, good)
        if not odd:
            break
        faults[odd] = "does not agree with the others: another stack, or something moved"
        good = [s for s in good if s.name != odd]
    _refuse_one_place(bundle)
    if bundle.sigma_px > MISFIT_PX:
        raise Undetermined(
            f"the photographs do not show one rigid stack: points are {bundle.sigma_px:.1f} px off on average"
        )
    try:
        model = geometry_of(bundle.panels, stack, eye_m=eye_m, even=even, reference=reference)
    except ValueError as problem:
        raise Undetermined(str(problem)) from None
    _refuse_implausible(bundle, stack)
    corners = corner_pixels(stack)

    def moved(panels: Sequence[PlacedPanel]) -> F64:
        matrices = homographies(panels, model, eye_m)
        return np.stack([through(matrix, corners) - corners for matrix in matrices])

    def gaps(panels: Sequence[PlacedPanel]) -> F64:
        return np.diff([panel.axis_x_m for panel in panels])

    corner_sigma_px = bundle.sigma_of(moved)
    worst = float(np.linalg.norm(corner_sigma_px, axis=-1).max())
    if worst > DOUBTFUL_PX:
        raise Undetermined(
            f"the photographs leave a panel's corner uncertain by {worst:.2f} px: take more, from more directions"
        )
    return Registration(
        bundle=bundle,
        stack=model,
        true_x_m=np.array([panel.axis_x_m for panel in bundle.panels]),
        gap_sigma_m=bundle.sigma_of(gaps),
        homographies=homographies(bundle.panels, model, eye_m),
        corners_px=moved(bundle.panels),
        corner_sigma_px=corner_sigma_px,
        eye_m=np.asarray(eye_m, dtype=np.float64),
        verdicts=_verdicts(bundle, good, seen, faults),
        notes=_notes(good, seen, faults, worst),
    )


def _other_sizes(good: Sequence[SeenMarks]) -> dict[str, str]:
    sizes = [(s.width_px, s.height_px) for s in good]
    if not sizes:
        return {}
    usual = max(set(sizes), key=sizes.count)
    text = f"has another size than the others ({usual[0]}x{usual[1]}): one camera, one setting"
    return {s.name: text for s, size in zip(good, sizes, strict=True) if size != usual}


def _refuse_few(good: Sequence[SeenMarks], seen: Sequence[SeenMarks], faults: dict[str, str]) -> None:
    if len(good) >= MIN_PHOTOGRAPHS:
        return
    why = "; ".join(f"{name} {fault}" for name, fault in faults.items())
    raise Undetermined(
        f"{len(good)} of {len(seen)} photographs can be used, at least {MIN_PHOTOGRAPHS} are needed"
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


def _disagreeing(bundle: Bundle, good: Sequence[SeenMarks]) -> str:
    """The name of the photograph that fits the others worst, if it does not fit; empty: all do."""
    shares = [1 - float(bundle.used[bundle.photograph == number].mean()) for number in range(len(good))]
    worst = int(np.argmax(shares))
    return good[worst].name if shares[worst] > DISAGREES else ""


def _verdicts(
    bundle: Bundle, good: Sequence[SeenMarks], seen: Sequence[SeenMarks], faults: dict[str, str]
) -> tuple[Verdict, ...]:
    numbers = {s.name: number for number, s in enumerate(good)}
    found = []
    for s in seen:
        if s.name in faults:
            found.append(Verdict(s.name, False, len(s.panel), float("inf"), faults[s.name]))
            continue
        mine = (bundle.photograph == numbers[s.name]) & bundle.used
        rms = float(np.sqrt((bundle.residual_px[mine] ** 2).sum(1).mean()))
        found.append(Verdict(s.name, True, int(mine.sum()), rms, ""))
    return tuple(found)


def _notes(
    good: Sequence[SeenMarks], seen: Sequence[SeenMarks], faults: dict[str, str], worst_px: float
) -> tuple[str, ...]:
    notes = [f"{s.name} {faults[s.name]}: left out" for s in seen if s.name in faults]
    if len(good) < WANTED_PHOTOGRAPHS:
        notes.append(f"{len(good)} photographs were used: 8 to 20 are better, and tell whether one of them is wrong")
    if worst_px > FEWER_IS_NOTED_PX:
        notes.append(f"a corner is uncertain by {worst_px:.2f} px: more photographs, from farther aside, would help")
    return tuple(notes)
