"""The unrolled solver's steps, their order stated once, and what a device has to do for them.

A backend (`cpu`, `gl`) does single steps, and knows neither their order nor when a panel is rounded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Protocol

import numpy as np

from runtime.model.assembly import Assembly
from runtime.model.chain import ChainFrame, ColumnLaw
from runtime.model.compiled.passes import fade_codes
from runtime.model.contract import Contract, Step
from runtime.model.fade import Fade
from runtime.model.job import Picture
from runtime.model.reprojection import CENTRE, FRONT, OUTER, REAR, START, coarser, spreads
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.optics.tilt import coarse_layer_from_seen
from runtime.records import F64, I16, Layers
from runtime.support.threads import at_once


@dataclass(frozen=True, slots=True)
class Problem:
    """What one solution is for."""

    contract: Contract
    stack: PanelStack
    boxes: tuple[PixelRect, ...]  # per panel, what the eyes look through
    eyes_m: F64  # (2, 3) left and right, frame `stack`
    frame: ChainFrame  # the network's raster
    eye_sigma_mm: float  # standard deviation of where light enters the eyes, an axis
    channels: int  # 1 or 3
    fade: Fade | None  # how the panels end, where they are a part of larger ones

    @property
    def rasters(self) -> tuple[PlaneRaster, ...]:
        """The panels' pixels within their boxes."""
        return tuple(box.cut(self.stack.panel(n)) for n, box in enumerate(self.boxes))

    @property
    def reduced_size(self) -> tuple[int, int]:
        """(width, height) of the centre panel's pixels that the network's pictures are taken from."""
        reduction, box = self.contract.reduction, self.boxes[CENTRE]
        return max(1, box.width_px // reduction), max(1, box.height_px // reduction)

    @property
    def reduction(self) -> int:
        """How many times coarser than panels corrections are: as the network's pictures, where eyes are so unsure that
        they see nothing finer of the outer panels."""
        spread = spreads(self.rasters, self.eyes_m, eye_sigma_mm=self.eye_sigma_mm)
        least_px = min(px for n in OUTER for px in spread.get(n, (0.0,)))
        return self.contract.reduction if least_px >= BLURRED_COARSE_PX * self.contract.reduction else 1

    def coarser_rasters(self, reduction: int) -> tuple[PlaneRaster, ...]:
        """`rasters`, of pixels so many times as wide."""
        return tuple(coarser(raster, reduction) for raster in self.rasters)

    def reduced_from_frame(self, side: int) -> F64:
        """3x3: those pixels from the network's raster (`ChainFrame.columns`), as one eye sees them in line."""
        width, height = self.reduced_size
        centre = self.boxes[CENTRE].cut(self.stack.panel(CENTRE))
        reduced_from_full = np.diag([width / centre.width_px, height / centre.height_px, 1.0])
        reduced_from_plane = reduced_from_full @ centre.raster_from_plane()
        return reduced_from_plane @ self.frame.plane_from_frame(self.eyes_m[side], x_m=self.stack.x_m[CENTRE])

    def answer_from_raster(self, panel: int, raster: PlaneRaster) -> F64:
        """3x3: the network's answer's pixels (`answer_columns`) from an outer panel's, in line as seen from between the
        eyes."""
        seen_from_layer = np.linalg.inv(coarse_layer_from_seen(self.stack, panel, self.frame.middle_m))
        matrix = self.frame.frame_from_plane(x_m=raster.x_m) @ seen_from_layer @ raster.plane_from_raster()
        # The answer begins one parallax before the first column.
        shifted = np.array([[1.0, 0.0, self.frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]) @ matrix
        return np.asarray(shifted / shifted[2, 2], np.float64)

    @property
    def answer_columns(self) -> ColumnLaw:
        """Of the network's answer."""
        law = self.frame.columns
        return ColumnLaw(law.bend, law.middle + self.frame.cell_px)

    def faded(self, panels: Answer) -> Answer:
        """The network's answer that ends within a part of the panels; in place."""
        if self.fade is None:
            return panels
        frame, first = self.frame, next(iter(panels.values()))
        plane_from_wave = frame.plane_from_frame(frame.middle_m, x_m=self.stack.x_m[CENTRE])
        plane_from_wave = plane_from_wave @ np.array([[1.0, 0.0, -frame.cell_px], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        rows, columns = first.shape[:2]
        weights = self.fade.wave_weights(
            self.centre_from(plane_from_wave), rows=rows, columns=columns, law=self.answer_columns
        )
        ends, channels = weights[..., 0], first.size // (rows * columns)
        at_once(lambda panel: fade_codes(panel.reshape(rows, -1), ends, START, channels), list(panels.values()))
        return panels

    def centre_from(self, plane_from_raster: F64) -> F64:
        """3x3: the centre panel's pixels from a raster's on its plane."""
        return self.stack.panel(CENTRE).raster_from_plane() @ plane_from_raster


BLURRED_COARSE_PX = 0.4  # standard deviation, coarse pixels, of what unsure eyes see: with less, light is lost
Answer = Mapping[int, I16]  # per outer panel, (rows, columns[, 3]) on the network's raster, sixteenths of a code
Network = Callable[[tuple[I16, I16]], Answer]


class SolverState(Protocol):
    """The panels of one size on one device, and what changes them. Lives from frame to frame; one thread uses it."""

    def begin(self, pictures: Sequence[Picture], problem: Problem) -> AbstractContextManager[None]:
        """Take two pictures (h, w, 4) of the centre panel's pixels: cut to its box, the target phase sums of both eyes.
        The steps are done within what it answers."""

    def network_pictures(self) -> tuple[I16, I16]:
        """Each eye's residual while the outer panels are even, on the network's raster: (rows, columns[, 3])."""

    def set_panel(self, panel: int, codes: I16, *, shown: bool) -> None:
        """An outer panel as the network has it; shown: rounded to what 8 bits can show."""

    def project(self, panels: Sequence[int]) -> None:
        """See outer panels anew through the centre panel's pixels."""

    def correct(self, panel: int, *, size: float, shown: bool) -> None:
        """Change one outer panel by both eyes' residuals along the rays through each of its pixels, when the centre
        panel is the best one for the outer panels."""

    def finish(self) -> Layers:
        """(N, h, w, 4): the centre panel closed, all of them in 8-bit codes, even beside the boxes;
        an array is the state's own until the next frame."""

    def close(self) -> None:
        """Release threads and textures. May be called twice."""


class SolverBackend(Protocol):
    """A device that does what surrounds the network."""

    name: str  # as `model.backend` calls it
    context: object  # of OpenGL, whose textures it reads; None: it reads arrays

    def state(self, contract: Contract, stack: PanelStack, *, threads: int) -> SolverState:
        """For a model and stacks of this one's size. Raises InputError where that does not fit."""

    def assembly(self, stack: PanelStack) -> Assembly:
        """For a model that solves a part of a stack; made on any thread."""

    def close(self) -> None:
        """Release what its states shared, once they are closed. May be called twice."""


def run_steps(
    steps: Sequence[Step], state: SolverState, network: Network, *, deadline_ns: int | None = None
) -> tuple[Layers, int]:
    """The layers of the problem that was begun, every step in its order, but for those after the deadline; and how many
    were done.

    An outer panel is rounded to what 8 bits show where it is changed last, so that the centre panel, closed at the end,
    answers to what the eyes will really see.
    """
    last = {n: _last_change(steps, n) for n in OUTER}
    done = 0
    for index, step in enumerate(steps):
        if index and deadline_ns is not None and perf_counter_ns() >= deadline_ns:
            break
        done += 1
        shown = {n: index == last[n] for n in OUTER}
        changed: tuple[int, ...] = OUTER
        if step.kind == "chain":
            for n, codes in network(state.network_pictures()).items():
                state.set_panel(n, codes, shown=shown[n])
        else:
            changed = (FRONT if step.kind == "front" else REAR,)
            state.correct(changed[0], size=step.size, shown=shown[changed[0]])
        state.project(changed)
    return state.finish(), done


def _last_change(steps: Sequence[Step], panel: int) -> int:
    """The last step that changes an outer panel."""
    kinds = {"chain", "front" if panel == FRONT else "rear"}
    return max(index for index, step in enumerate(steps) if step.kind in kinds)
