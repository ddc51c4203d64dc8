"""The unrolled solver: a network along the eyes' line, local corrections, and the centre panel in closed form.

Phases are fixed-point (sixteenths of an 8-bit code). Outer panels are kept rounded to what 8 bits can show, so
that every correction answers to what the eyes will really see. One correction changes one panel, rear and front in
turn: twice as much for the time as both at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.errors import ModelFailure
from runtime.model.chain import ChainFrame, chain_frame, chain_modes, relative_tolerance_mm
from runtime.model.contract import Step
from runtime.model.predictor import Prediction, Predictor
from runtime.model.resample import buffer, resample, target_from_source
from runtime.model.rows import RowPool
from runtime.model.session import ModelSession
from runtime.model.timing import Stopwatch
from runtime.model.transfer import FULL, SUBCODE, emphasised, phase_codes
from runtime.model.visible import Box, visible_boxes
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, U8

I16 = NDArray[np.int16]
REAR, CENTRE, FRONT = 0, 1, 2
BUFFERS = ("rear", "front", *(f"seen-{n}-{side}" for n in (0, 2) for side in (0, 1)), "residual-0", "residual-1",
           "back-0", "back-1")  # fmt: skip
START = FULL // 2  # of every outer panel: the middle of its range


class UnrolledPredictor(Predictor):
    """Models of `input_frame` chain: three evenly spaced panels, any pose."""

    def __init__(self, session: ModelSession, stack: PanelStack, *, tolerance_mm: float, threads: int = 2) -> None:
        self.session, self.stack = session, stack
        self.name, self.provider = session.contract.name, session.provider
        self.parameters = session.contract.parameters
        self.tolerance_mm = tolerance_mm
        self._rows = RowPool(threads)
        self._boxes: tuple[Box, ...] = ()
        self._drawn: tuple[Box, ...] = ()  # where the layers hold more than even panels
        self._whole = {name: buffer(stack.height_px, stack.width_px) for name in BUFFERS}
        self._layers = np.full((3, stack.height_px, stack.width_px, 4), 255, np.uint8)
        self._chain_buffers: dict[tuple[int, int], Any] = {}

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(CENTRE),)

    @property
    def interpolation(self) -> str:
        return self.session.contract.interpolation

    @property
    def emphasis(self) -> float:
        return self.session.contract.emphasis

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return (visible_boxes(eyes_m, self.stack)[CENTRE].slices,)

    def predict(self, images: Sequence[Sequence[U8]], eyes_m: F64) -> Prediction:
        watch = Stopwatch()
        contract = self.session.contract
        try:
            frame = chain_frame(eyes_m, self.stack, cell_px=contract.cell_px, reduction=contract.reduction)
        except ValueError as error:
            raise ModelFailure(str(error)) from None
        self._look_through(visible_boxes(eyes_m, self.stack))
        table = phase_codes(contract.branch)
        pictures = [emphasised(image[0][self._boxes[CENTRE].slices], contract.emphasis) for image in images]
        wanted = [cv2.LUT(cv2.cvtColor(picture, cv2.COLOR_RGBA2RGB), table) for picture in pictures]
        first = True
        last = {n: _last_change(contract.steps, n) for n in (REAR, FRONT)}
        for index, step in enumerate(contract.steps):
            shown = {n: index == last[n] for n in (REAR, FRONT)}
            if not first:
                self._lacks(wanted)
            if step.kind == "chain":
                needs = self._first_needs(pictures, table) if first else self._later_needs()
                self._chain(needs, frame, eyes_m, watch, size=step.size, first=first, shown=shown)
                changed: tuple[int, ...] = (REAR, FRONT)
            else:
                changed = (FRONT if step.kind == "front" else REAR,)
                self._correct(changed[0], eyes_m, size=step.size, shown=shown[changed[0]])
            first = False
            for n in changed:
                for side, eye_m in enumerate(eyes_m):
                    self._between(self._outer[n], eye_m, of=n, on=CENTRE, out=self._seen[n, side])
        self._close_centre(wanted)
        if self._drawn != self._boxes:
            self._layers[..., :3] = START // SUBCODE
            self._drawn = self._boxes
        self._put(CENTRE, self._centre)
        for n in (REAR, FRONT):
            self._put(n, cv2.convertScaleAbs(self._outer[n], alpha=1 / SUBCODE))
        watch.lap("finish")
        return Prediction(self._layers, watch.stage_ms)

    def close(self) -> None:
        self._rows.close()

    def _look_through(self, boxes: tuple[Box, ...]) -> None:
        """Cut every raster and buffer to what the eyes look through; panels are even beside it."""
        if boxes == self._boxes:
            return
        self._boxes = boxes
        self._rasters = tuple(box.cut(self.stack.panel(n)) for n, box in enumerate(boxes))

        def view(name: str, box: Box) -> I16:
            return _view(self._whole[name], box.height_px, box.width_px)

        centre = boxes[CENTRE]
        self._outer = {REAR: view("rear", boxes[REAR]), FRONT: view("front", boxes[FRONT])}
        self._seen = {(n, side): view(f"seen-{n}-{side}", centre) for n in (REAR, FRONT) for side in (0, 1)}
        self._residual = (view("residual-0", centre), view("residual-1", centre))
        self._centre: U8 = np.empty((centre.height_px, centre.width_px, 3), np.uint8)
        self._back = {n: (view("back-0", boxes[n]), view("back-1", boxes[n])) for n in (REAR, FRONT)}

    def _put(self, panel: int, codes: Any) -> None:
        self._layers[panel][self._boxes[panel].slices] = cv2.cvtColor(codes, cv2.COLOR_RGB2RGBA)

    def _between(self, image: I16, eye_m: F64, *, of: int, on: int, out: I16) -> I16:
        """Panel `of`'s pixels on panel `on`'s raster, as an eye sees them in line."""
        matrix = target_from_source(eye_m, source=self._rasters[on], target=self._rasters[of])
        return resample(image, image_from_result=matrix, out=out, outside=0 if of == CENTRE else START)

    def _lacks(self, wanted: Sequence[Any]) -> None:
        """What each eye still lacks when the centre panel is the best one for the outer panels."""
        rear, front, residual = self._seen_of(REAR), self._seen_of(FRONT), self._residual

        def work(rows: slice) -> None:
            left, right = residual[0][rows], residual[1][rows]
            np.subtract(wanted[0][rows], rear[0][rows], out=left)
            np.subtract(left, front[0][rows], out=left)
            np.subtract(wanted[1][rows], rear[1][rows], out=right)
            np.subtract(right, front[1][rows], out=right)
            best = left + right
            np.right_shift(best, 1, out=best)
            np.clip(best, 0, FULL, out=best)
            np.subtract(left, best, out=left)
            np.subtract(right, best, out=right)

        self._rows.each(self._boxes[CENTRE].height_px, work)

    def _close_centre(self, wanted: Sequence[Any]) -> None:
        """The best centre panel for the outer ones, per pixel and in closed form, in 8-bit codes."""
        rear, front, centre = self._seen_of(REAR), self._seen_of(FRONT), self._centre

        def work(rows: slice) -> None:
            best = wanted[0][rows] + wanted[1][rows]
            for seen in (*rear, *front):
                np.subtract(best, seen[rows], out=best)
            np.add(best, SUBCODE, out=best)
            np.right_shift(best, 5, out=best)
            np.clip(best, 0, 255, out=best)
            centre[rows] = best

        self._rows.each(self._boxes[CENTRE].height_px, work)

    def _seen_of(self, panel: int) -> tuple[I16, I16]:
        return self._seen[panel, 0], self._seen[panel, 1]

    def _correct(self, panel: int, eyes_m: F64, *, size: float, shown: bool) -> None:
        """Change one outer panel by what both eyes lack along the rays through each of its pixels."""
        back = self._back[panel]
        for side, eye_m in enumerate(eyes_m):
            self._between(self._residual[side], eye_m, of=CENTRE, on=panel, out=back[side])
        outer = self._outer[panel]
        eighths = np.int16(round(size * 8))

        def work(rows: slice) -> None:
            change = back[0][rows] + back[1][rows]
            np.right_shift(change, 3, out=change)
            np.multiply(change, eighths, out=change)
            np.add(change, outer[rows], out=change)
            _settle(change, outer[rows], shown=shown)

        self._rows.each(self._boxes[panel].height_px, work)

    def _first_needs(self, pictures: Sequence[U8], table: NDArray[np.int16]) -> list[I16]:
        """What each eye lacks while the outer panels are even, at the network's coarser raster."""
        size = self._reduced_size()
        left, right = (
            cv2.LUT(cv2.cvtColor(cv2.resize(p, size, interpolation=cv2.INTER_AREA), cv2.COLOR_RGBA2RGB), table)
            for p in pictures
        )
        half = (np.asarray(right, np.int16) - np.asarray(left, np.int16)) >> 1
        return [-half, half]

    def _later_needs(self) -> list[I16]:
        size = self._reduced_size()
        return [np.asarray(cv2.resize(r, size, interpolation=cv2.INTER_AREA), np.int16) for r in self._residual]

    def _reduced_size(self) -> tuple[int, int]:
        reduction, box = self.session.contract.reduction, self._boxes[CENTRE]
        return max(1, box.width_px // reduction), max(1, box.height_px // reduction)

    def _chain(
        self,
        needs: Sequence[I16],
        frame: ChainFrame,
        eyes_m: F64,
        watch: Stopwatch,
        *,
        size: float,
        first: bool,
        shown: dict[int, bool],
    ) -> None:
        """The network's correction: what the outer panels must carry for the eyes to differ as they should."""
        width, height = self._reduced_size()
        centre = self._rasters[CENTRE]
        reduced_from_full = np.diag([width / centre.width_px, height / centre.height_px, 1.0])
        reduced_from_plane = reduced_from_full @ centre.raster_from_plane()
        key = (frame.rows, frame.width_px)
        if key not in self._chain_buffers:
            self._chain_buffers = {key: (buffer(*key), buffer(*key))}
        seen = self._chain_buffers[key]
        for side, eye_m in enumerate(eyes_m):
            matrix = reduced_from_plane @ frame.plane_from_frame(eye_m, x_m=self.stack.x_m[CENTRE])
            resample(needs[side], image_from_result=matrix, out=seen[side])
        difference = np.subtract(seen[1], seen[0], dtype=np.float32)
        difference *= 1 / FULL
        watch.lap("prepare")
        answer = self.session.run(
            difference.reshape(frame.rows, frame.cells, -1),
            *chain_modes(frame.cells),
            np.array([relative_tolerance_mm(self.tolerance_mm, eyes_m)], np.float32),
            output_shape=(frame.rows, frame.cells + 1, 2 * frame.cell_px * 3),
        )
        if not np.isfinite(answer.sum()):
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        wave = answer.reshape(frame.rows, -1, 3)
        for n, sign in ((REAR, -1.0), (FRONT, 1.0)):
            panel = self._rasters[n]
            matrix = frame.frame_from_plane(x_m=panel.x_m) @ panel.plane_from_raster()
            matrix[0, 2] += frame.cell_px  # the answer begins one parallax before the first column
            codes = cv2.addWeighted(wave, sign * FULL * size, wave, 0.0, START if first else 0.0, dtype=cv2.CV_16S)
            target = self._outer[n] if first else self._back[n][0]
            resample(codes, image_from_result=matrix, out=target, outside=START if first else 0, cubic=True)
            self._take(n, None if first else target, shown=shown[n])

    def _take(self, panel: int, change: I16 | None, *, shown: bool) -> None:
        outer = self._outer[panel]

        def work(rows: slice) -> None:
            codes = outer[rows] if change is None else outer[rows] + change[rows]
            _settle(codes, outer[rows], shown=shown)

        self._rows.each(self._boxes[panel].height_px, work)


def _view(whole: I16, height_px: int, width_px: int) -> I16:
    """The first rows and columns of a `buffer`, with margins of its own."""
    parent = whole.base
    assert isinstance(parent, np.ndarray)
    return parent[:height_px, :width_px]


def _settle(codes: I16, out: I16, *, shown: bool) -> None:
    """Keep within the panel's range; what will be shown is rounded to what 8 bits can show.

    Rounded any earlier, corrections of less than half a code would be lost.
    """
    if shown:
        np.add(codes, SUBCODE // 2, out=codes)
        np.bitwise_and(codes, -SUBCODE, out=codes)
    np.clip(codes, 0, FULL, out=out)


def _last_change(steps: Sequence[Step], panel: int) -> int:
    """The last step that changes an outer panel."""
    kinds = {"chain", "front" if panel == FRONT else "rear"}
    return max(index for index, step in enumerate(steps) if step.kind in kinds)
