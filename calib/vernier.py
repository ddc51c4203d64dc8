"""Vernier charts: two halves of a cross on two panels, nudged until they meet; and their settings on disk."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.keys import Key
from calib.registration import Setting, ideal_partner, through
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support import foreign
from runtime.support.artifacts import write_text

COLUMNS = (
    "reference", "panel", "eye_x", "eye_y", "eye_z", "reference_u", "reference_v", "panel_u", "panel_v",
)  # fmt: skip
NODES = (5, 3)  # across and down
ARM_PX = 60
GAP_PX = 3
WIDTH_PX = 3
STEPS_PX = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0)


def nodes(eye_m: Sequence[float], stack: PanelStack, *, reference: int, panel: int) -> F64:
    """(K, 2) pixels of `reference`, an even grid over what the eye sees of both panels, a cross's arm inside."""
    size = np.array([stack.width_px, stack.height_px], dtype=np.float64)
    clear = np.minimum(ARM_PX + 4.0, size / 8)
    inner = np.array([clear, size - clear])
    partner = ideal_partner(inner, eye_m, stack, reference=panel, panel=reference)
    low, high = np.maximum(inner[0], partner[0]), np.minimum(inner[1], partner[1])
    if (high <= low).any():
        raise ValueError(f"from there no point of panel {panel} lies over panel {reference}")
    across, down = (np.linspace(low[axis], high[axis], NODES[axis]) for axis in (0, 1))
    return np.array([(u, v) for v in down for u in across])


def draw(layers: U8, *, index: int, at_px: Sequence[float], first_half: bool) -> None:
    """Add half of a cross to one panel of (N, H, W, 4) layers: left and up, or right and down; exact to sub-pixels.

    The panels turn no light but in the lines, so that the halves are white on black, each on its own panel.
    """
    u, v = float(at_px[0]), float(at_px[1])
    height, width = layers.shape[1:3]
    near, far, half = GAP_PX, ARM_PX, WIDTH_PX / 2
    direction = -1 if first_half else 1
    spans = (
        (sorted((u + direction * near, u + direction * far)), (v - half, v + half)),
        ((u - half, u + half), sorted((v + direction * near, v + direction * far))),
    )
    for horizontal, vertical in spans:
        left, right = max(0, math.floor(horizontal[0])), min(width, math.ceil(horizontal[1]))
        top, bottom = max(0, math.floor(vertical[0])), min(height, math.ceil(vertical[1]))
        if left >= right or top >= bottom:
            continue
        cover = np.outer(_cover(top, bottom, vertical), _cover(left, right, horizontal))
        part = layers[index, top:bottom, left:right, :3]
        np.maximum(part, np.rint(255 * cover).astype(np.uint8)[..., None], out=part)


def _cover(start: int, stop: int, span: Sequence[float]) -> F64:
    """How much of each pixel from start to stop lies in a span."""
    edges = np.arange(start, stop)
    found: F64 = np.clip(np.minimum(edges + 1, span[1]) - np.maximum(edges, span[0]), 0.0, 1.0)
    return found


def chart(stack: PanelStack, settings: Sequence[Setting]) -> U8:
    """(N, H, W, 4) layers with both halves of every setting."""
    layers = np.zeros((stack.count, stack.height_px, stack.width_px, 4), np.uint8)
    layers[..., 3] = 255
    for s in settings:
        draw(layers, index=s.reference, at_px=s.reference_px, first_half=True)
        draw(layers, index=s.panel, at_px=s.panel_px, first_half=False)
    return layers


def nominal(eye_m: Sequence[float], stack: PanelStack, *, reference: int) -> list[Setting]:
    """Every vernier of every panel against the reference, where a perfect stack would have it."""
    found = []
    eye = (float(eye_m[0]), float(eye_m[1]), float(eye_m[2]))
    for panel in range(stack.count):
        if panel == reference:
            continue
        points = nodes(eye, stack, reference=reference, panel=panel)
        partner = ideal_partner(points, eye, stack, reference=reference, panel=panel)
        found += [
            Setting(reference, panel, eye, (p[0], p[1]), (q[0], q[1]))
            for p, q in zip(points.tolist(), partner.tolist(), strict=True)
        ]
    return found


def simulate(
    asked: Sequence[Setting],
    stack: PanelStack,
    truth: Sequence[F64],
    *,
    noise_px: float,
    viewpoint_error_m: F64,
    random: np.random.Generator,
) -> list[Setting]:
    """What a person sets on a stack that is misaligned by `truth` (3x3 for each panel, true pixels from ideal).

    The fixed half lies where the reference panel really is; the person stands off the mark by
    `viewpoint_error_m` (3,) and sets each half to `noise_px`.
    """
    found = []
    for s in asked:
        ideal = through(np.asarray(np.linalg.inv(truth[s.reference]), dtype=np.float64), np.array([s.reference_px]))
        place = np.array(s.eye_m) + viewpoint_error_m
        partner = ideal_partner(ideal, place, stack, reference=s.reference, panel=s.panel)
        met = through(truth[s.panel], partner)[0] + random.normal(scale=noise_px, size=2) * (noise_px > 0)
        found.append(replace(s, panel_px=(float(met[0]), float(met[1]))))
    return found


@dataclass
class Nudging:
    """The person's way through the verniers: arrows move, f and c change the step, Enter takes."""

    asked: list[Setting]
    done: list[Setting]
    index: int = 0
    step: int = 3
    finished: bool = False

    @property
    def current(self) -> Setting:
        """The vernier that is shown."""
        return self.asked[self.index]

    def press(self, key: Key) -> bool:
        """Do what a key says; True where a setting was taken."""
        u, v = self.current.panel_px
        length = STEPS_PX[self.step]
        moves = {Key.LEFT: (-length, 0), Key.RIGHT: (length, 0), Key.UP: (0, -length), Key.DOWN: (0, length)}
        if key in moves:
            du, dv = moves[key]
            self.asked[self.index] = replace(self.current, panel_px=(u + du, v + dv))
        elif key is Key.FINER:
            self.step = max(0, self.step - 1)
        elif key is Key.COARSER:
            self.step = min(len(STEPS_PX) - 1, self.step + 1)
        elif key is Key.PREVIOUS:
            self.index = max(0, self.index - 1)
        elif key is Key.NEXT:
            self._advance()
        elif key is Key.QUIT:
            self.finished = True
        elif key is Key.ACCEPT:
            self.done = [s for s in self.done if _where(s) != _where(self.current)] + [self.current]
            self._carry()
            self._advance()
            return True
        return False

    def _carry(self) -> None:
        """Begin the next vernier of the same panels with this one's correction: it is nearly right."""
        following = self.index + 1
        if following == len(self.asked):
            return
        untouched = self.asked[following]
        taken = any(_where(s) == _where(untouched) for s in self.done)
        if untouched.panel == self.current.panel and not taken:
            nominal_px = np.array(self._nominal(self.current))
            du, dv = np.array(self.current.panel_px) - nominal_px
            place = self._nominal(untouched)
            self.asked[following] = replace(untouched, panel_px=(place[0] + du, place[1] + dv))

    def _nominal(self, setting: Setting) -> tuple[float, float]:
        return self.nominal_px[_where(setting)]

    def __post_init__(self) -> None:
        self.nominal_px = {_where(s): s.panel_px for s in self.asked}

    def _advance(self) -> None:
        if self.index + 1 == len(self.asked):
            self.finished = True
        else:
            self.index += 1


def resumed(asked: Sequence[Setting], taken: Sequence[Setting]) -> Nudging:
    """Go on where an earlier walk stopped: at the first vernier that is not taken, the others kept.

    Files round: a setting belongs to the vernier of the same panels and eye less than half a pixel away.
    """

    def same(a: Setting, b: Setting) -> bool:
        panels = (a.reference, a.panel) == (b.reference, b.panel)
        near = np.allclose(a.reference_px, b.reference_px, rtol=0, atol=0.5)
        return panels and near and np.allclose(a.eye_m, b.eye_m, rtol=0, atol=1e-6)

    nudging = Nudging(list(asked), [])
    open_numbers = set(range(len(asked)))
    for setting in taken:
        mine = next((number for number, vernier in enumerate(asked) if same(vernier, setting)), None)
        if mine is not None:
            open_numbers.discard(mine)
            setting = replace(asked[mine], panel_px=setting.panel_px)
            nudging.asked[mine] = setting
        nudging.done.append(setting)
    nudging.finished = not open_numbers
    nudging.index = min(open_numbers, default=0)
    return nudging


def _where(setting: Setting) -> tuple[object, ...]:
    return setting.reference, setting.panel, setting.eye_m, setting.reference_px


def write_settings(path: Path, settings: Sequence[Setting]) -> None:
    """All settings as CSV, atomically."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for s in settings:
        numbers = (*s.eye_m, *s.reference_px, *s.panel_px)
        writer.writerow([s.reference, s.panel, *[f"{value:.9g}" for value in numbers]])
    write_text(path, text.getvalue())


def read_settings(path: Path, stack: PanelStack) -> list[Setting]:
    """Settings from CSV. Raises InputError, naming the row and the column."""
    try:
        with io.StringIO(foreign.read_text(path), newline="") as file:
            reader = csv.DictReader(file, skipinitialspace=True)
            missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
            if missing:
                raise InputError(path, missing[0], "column is missing (wanted: " + ", ".join(COLUMNS) + ")")
            return [_setting(path, reader.line_num, row, stack) for row in reader]
    except csv.Error as error:
        raise InputError(path, "", f"malformed: {error}") from None


def _setting(path: Path, line: int, row: dict[str, str | None], stack: PanelStack) -> Setting:
    values = {}
    for name in COLUMNS:
        try:
            values[name] = float(row[name] or "")
        except ValueError:
            values[name] = math.nan
        if not math.isfinite(values[name]):
            raise InputError(path, f"line {line}, {name}", f"is not a number: {row[name]}")
    for name in ("reference", "panel"):
        if values[name] not in range(stack.count):
            raise InputError(path, f"line {line}, {name}", f"must be 0 to {stack.count - 1}")
    if values["reference"] == values["panel"]:
        raise InputError(path, f"line {line}, panel", "is its own reference")
    if values["eye_x"] <= max(stack.x_m):
        raise InputError(path, f"line {line}, eye_x", "the eye must be in front of every panel")
    return Setting(
        int(values["reference"]),
        int(values["panel"]),
        (values["eye_x"], values["eye_y"], values["eye_z"]),
        (values["reference_u"], values["reference_v"]),
        (values["panel_u"], values["panel_v"]),
    )
