"""Corrections by the definition, on whole images: what the compiled ones and OpenGL are held to."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil

import cv2
import numpy as np
import pytest

import runtime.model.cpu
from runtime.model.compiled.panels import Panels, show_panels
from runtime.model.reprojection import CENTRE, EYES, FRONT, OUTER, REAR, START, reprojection
from runtime.model.targets import FULL, SLOPE_FLOOR, SUBCODE
from runtime.optics.rect import PixelRect
from runtime.records import F32, F64, I16, U8
from tests.model.exact import exact_resample

WHOLE = 1 << 14  # of a weight, in whole numbers


class PlainPanels(Panels):
    """`Panels` whose corrections and closing are slow and plain."""

    def set_eyes(self, eyes_m: F64, *, eye_sigma_mm: float = 0.0) -> None:
        super().set_eyes(eyes_m, eye_sigma_mm=eye_sigma_mm)
        self._eyes_m = eyes_m
        self._means: dict[int, F64] = {}  # of the outer panels, taken from coarser ones

    def take(self, coarse: Panels) -> None:
        assert isinstance(coarse, PlainPanels)
        for n in OUTER:
            mean = coarse._blurred(coarse._image(coarse.outer[n]), n)
            self.set_panel(n, coarse.outer[n], shown=True)
            size = self.outer[n].shape[1::-1]
            finer = cv2.resize(mean.astype(np.int16), size, interpolation=cv2.INTER_CUBIC)
            self._means[n] = self._image(np.clip(finer, 0, FULL))

    def project(self, panels: Sequence[int]) -> None:
        """It looks anew in every step."""

    def step(self, panel: int, *, size: float, shown: bool, fading: tuple[F32, F32] | None = None) -> None:
        other = REAR if panel == FRONT else FRONT
        weights, lacks, residual = self._weights(), self._lacks(), []
        best = _best(lacks, weights)
        for side in EYES:
            left = lacks[side] - best
            if self.spread:
                seen = self._seen(other, side)
                left = left + seen - self._blurred(seen, panel, twice=True)
            for line in fading or ():
                left = np.floor(left * (line[None, :, None] if len(line) == left.shape[1] else line[:, None, None]))
            residual.append(np.rint(weights[side] * left))
        back = [self._between(image, side, of=CENTRE, on=panel, outside=0) for side, image in enumerate(residual)]
        held = [np.rint(image * WHOLE) for image in weights]
        weighed = [self._between(image, side, of=CENTRE, on=panel, outside=WHOLE) for side, image in enumerate(held)]
        change = np.rint((back[0] + back[1]) * 2 * WHOLE / (weighed[0] + weighed[1]))
        outer = self._image(self.outer[panel])
        if self.spread:
            noise = outer - self._blurred(self._blurred(outer, panel), panel)
            change = self._blurred(change, panel) - 2 * noise
        codes = np.clip(outer + np.clip(size * change, -FULL, FULL), 0, FULL)
        codes = np.floor(codes / SUBCODE + 0.5) * SUBCODE if shown else np.rint(codes)
        self.outer[panel][...] = codes.reshape(self.outer[panel].shape)

    def show(self, layers: U8, boxes: Sequence[PixelRect]) -> None:
        outer = {n: np.ascontiguousarray(self.outer[n]) for n in OUTER}
        numbers = {n: codes.reshape(codes.shape[0], -1) for n, codes in outer.items()}
        show_panels(numbers, layers, boxes, channels=self._channels, threads=self._threads)
        layers[CENTRE][boxes[CENTRE].slices] = 255
        layers[CENTRE][boxes[CENTRE].slices][..., :3] = np.floor(_best(self._lacks(), self._weights()) / SUBCODE + 0.5)

    def _lacks(self) -> list[F64]:
        """What the outer panels leave each eye to be filled."""
        return [self._image(self.target[side]) - self._seen(REAR, side) - self._seen(FRONT, side) for side in EYES]

    def _weights(self) -> list[F64]:
        """Of both eyes' rays: the slope of sin² at the phase sums that are to be seen, 1 at its steepest."""
        part = [np.mod(self._image(image) / FULL, 1) for image in self.target]
        return [SLOPE_FLOOR + (1 - SLOPE_FLOOR) * 4 * one * (1 - one) for one in part]

    def _seen(self, panel: int, side: int) -> F64:
        """How an eye sees an outer panel through the centre panel's pixels, in the mean."""
        blurred = self._means.get(panel)
        if blurred is None:
            blurred = self._blurred(self._image(self.outer[panel]), panel)
        return self._between(blurred, side, of=panel, on=CENTRE, outside=START)

    def _between(self, image: F64, side: int, *, of: int, on: int, outside: float) -> F64:
        raster = self.rasters[on]
        out = np.empty((raster.height_px, raster.width_px, image.shape[2]))
        matrix = reprojection(self._stack, self.rasters, self._eyes_m[side], of=of, on=on)
        exact_resample(image, image_from_result=matrix, out=out, outside=outside)
        return out

    def _blurred(self, image: F64, panel: int, *, twice: bool = False) -> F64:
        """What is left of an image in the mean over where the eyes may be, as an outer panel's pixels move."""
        if panel not in self.spread:
            return image
        u, v = (s * np.sqrt(2.0) if twice else s for s in self.spread[panel])
        size = 2 * ceil(3 * max(u, v)) + 1
        blurred = cv2.GaussianBlur(image, (size, size), sigmaX=u, sigmaY=v, borderType=cv2.BORDER_REPLICATE)
        return np.asarray(np.rint(blurred), np.float64).reshape(image.shape)

    @staticmethod
    def _image(codes: I16) -> F64:
        """(h, w, channels)."""
        return codes.astype(np.float64).reshape(*codes.shape[:2], -1)


def _best(lacks: Sequence[F64], weights: Sequence[F64]) -> F64:
    """The centre panel that leaves both eyes least."""
    total = sum(weight * lack for weight, lack in zip(weights, lacks, strict=True)) / (weights[0] + weights[1])
    return np.asarray(np.clip(total, 0, FULL), np.float64)


def hold_exactly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the processor sample by the definition: its own sampling is off by up to a twelfth of a pixel."""
    monkeypatch.setattr(runtime.model.cpu, "resample", exact_resample)
    monkeypatch.setattr(runtime.model.cpu, "Panels", PlainPanels)
