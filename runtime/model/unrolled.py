"""The unrolled solver: a network along the eyes' line, local corrections, and the centre panel in closed form.

`schedule` says what is done in which order; a backend does all of it but the network. One correction changes one
panel, rear and front in turn: twice as much for the time as both at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.errors import EyesNotServed, ModelFailure
from runtime.model.assembly import Assembly
from runtime.model.base import Prediction, Predictor
from runtime.model.chain import chain_frame, chain_modes
from runtime.model.channels import is_grey
from runtime.model.fade import Fade
from runtime.model.opencv_surround import OpenCvBackend
from runtime.model.pyramid_level import CENTRE, FRONT, REAR, START
from runtime.model.schedule import Answer, Backend, Picture, Problem, Surround, carry_on, carry_out
from runtime.model.session import ModelSession
from runtime.model.timing import Stopwatch
from runtime.model.visible import visible_boxes
from runtime.optics.pupil import PUPIL_SIGMA_MM
from runtime.optics.rect import PixelRect
from runtime.optics.stack import PanelStack, PlaneRaster
from runtime.records import F64, I16
from runtime.support.gl import DrawnPicture

HALF_IPD_M = 0.031


class UnrolledPredictor(Predictor):
    """Models of `input_frame` chain: three panels, evenly spaced or nearly so, any pose.

    Where `one_channel` is set, grey pictures are solved in one channel of three: in less than half the time.
    """

    def __init__(
        self,
        session: ModelSession,
        stack: PanelStack,
        *,
        threads: int = 2,
        one_channel: bool = False,
        surroundings: Backend | None = None,
    ) -> None:
        """one_channel: whether pictures without colour are solved in a single channel. surroundings: who does what
        surrounds the network; None: OpenCV."""
        self.session, self.stack = session, stack
        self.name, self.provider = session.contract.name, session.provider
        self.parameters, self.fell_back = session.contract.parameters, session.fell_back
        self.one_channel = one_channel
        self.surroundings: Backend = surroundings or OpenCvBackend()
        self._threads = threads
        self._twin: UnrolledPredictor | None = None  # for eyes above each other
        self.fade: Fade | None = None  # how this stack ends, where it is a part of larger panels
        self._made: Surround | None = None
        self._turner: Assembly | None = None  # for the twin's pictures and layers

    @property
    def backend(self) -> str:  # type: ignore[override]
        return self.surroundings.name

    def reads_textures_of(self, context: object) -> bool:
        return context is not None and self.surroundings.context is context

    def on_panels(self, stack: PanelStack) -> UnrolledPredictor:
        return UnrolledPredictor(self.session, stack, threads=self._threads, one_channel=self.one_channel)

    def surround_with(self, backend: Backend) -> None:
        self.close()
        self.surroundings, self._made, self._twin, self._turner = backend, None, None, None

    def rasters(self, eyes_m: F64) -> tuple[PlaneRaster, ...]:
        return (self.stack.panel(CENTRE),)

    @property
    def interpolation(self) -> str:
        return self.session.contract.interpolation

    @property
    def pre_emphasis(self) -> float:
        return self.session.contract.emphasis

    def windows(self, eyes_m: F64) -> tuple[tuple[slice, slice], ...]:
        return (visible_boxes(eyes_m, self.stack)[CENTRE].slices,)

    def predict(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        return self._solved(images, eyes_m, eye_sigma_mm=eye_sigma_mm, again=False)

    @property
    def refines(self) -> bool:
        return self.session.contract.refining > 0

    def refine(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float = PUPIL_SIGMA_MM
    ) -> Prediction:
        return self._solved(images, eyes_m, eye_sigma_mm=eye_sigma_mm, again=True)

    def _solved(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float, again: bool
    ) -> Prediction:
        """again: by the last steps alone, on the panels of the last call."""
        across_m = np.abs(eyes_m[1] - eyes_m[0])
        if across_m[2] > across_m[1]:
            return self._turned(images, eyes_m, eye_sigma_mm=eye_sigma_mm, again=again)
        watch = Stopwatch()
        contract = self.session.contract
        # One eye that stands for both asks for no difference: the chain may run along any line.
        along_m = eyes_m if across_m.any() else eyes_m + HALF_IPD_M * np.array([[0.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
        try:
            frame = chain_frame(along_m, self.stack, cell_px=contract.cell_px, reduction=contract.reduction)
        except ValueError as error:
            raise EyesNotServed(str(error)) from None
        boxes = visible_boxes(eyes_m, self.stack)
        pictures = [image[0] for image in images]
        grey = self.one_channel and all(_is_grey(picture, boxes[CENTRE]) for picture in pictures)
        self.channels = 1 if grey else 3
        problem = Problem(contract, self.stack, boxes, eyes_m, frame, eye_sigma_mm, self.channels, self.fade)
        surround = self._surround()
        with surround.begin(pictures, problem, again=again):
            if again:
                layers = carry_on(contract.steps[-contract.refining :], surround)
            else:
                layers = carry_out(contract.steps, surround, lambda seen: self._network(seen, problem, watch))
        watch.lap("finish")
        return Prediction(layers, watch.stage_ms)

    def close(self) -> None:
        if self._made is not None:
            self._made.close()
        if self._twin is not None:
            self._twin.close()
        if self._turner is not None:
            self._turner.close()

    def _surround(self) -> Surround:
        """Made when it is first needed, on the thread that uses it. Raises InputError where the stack is too large."""
        if self._made is None:
            self._made = self.surroundings.surround(self.session.contract, self.stack, threads=self._threads)
        return self._made

    def _turned(
        self, images: Sequence[Sequence[Picture]], eyes_m: F64, *, eye_sigma_mm: float, again: bool
    ) -> Prediction:
        """Eyes above each other: the same problem with rows for columns, solved by a twin for panels turned so."""
        stack = self.stack
        if self._twin is None or self._turner is None:
            self._twin = UnrolledPredictor(
                self.session, stack.turned(), threads=self._threads, surroundings=self.surroundings
            )
            self._turner = self.surroundings.assembly(stack)
        twin, turner = self._twin, self._turner
        twin.one_channel, twin.fade = self.one_channel, self.fade and self.fade.turned()
        # A picture's rows become its columns: what was down (-z) is to the right (+y), what was right is down.
        turned_m = np.stack([eyes_m[:, 0], -eyes_m[:, 2], -eyes_m[:, 1]], axis=1)
        order = (0, 1) if turned_m[1, 1] > turned_m[0, 1] else (1, 0)
        pictures = [[turner.turned_picture(images[side][0], side)] for side in order]
        solve = twin.refine if again else twin.predict
        solved = solve(pictures, turned_m[list(order)], eye_sigma_mm=eye_sigma_mm)
        self.channels = twin.channels
        return Prediction(turner.turned(solved.made), solved.stage_ms)

    def _network(self, seen: tuple[I16, I16], problem: Problem, watch: Stopwatch) -> Answer:
        """The network's answer: both outer panels on the chain frame's raster, from one parallax before its first
        column, in fixed-point codes."""
        frame = problem.frame
        waves, shifted_waves, spectrum, modes_in = chain_modes(frame.cells)
        left, right = (image.reshape(frame.rows, frame.cells, -1) for image in seen)
        feeds: dict[str, NDArray[Any]] = {
            "left": left,
            "right": right,
            "waves": waves,
            "shifted_waves": shifted_waves,
            "spectrum": spectrum,
            "modes_in": modes_in,
            "doubt": frame.doubt(self.stack, eye_sigma_mm=problem.eye_sigma_mm),
        }
        shape = (frame.rows, frame.cells + 1, left.shape[2])
        watch.lap("prepare")
        answer = self.session.run(feeds, {"rear": shape, "front": shape, "check": (1,)})
        if not np.isfinite(answer["check"]).all():
            raise ModelFailure("the network answered with numbers that are not finite")
        watch.lap("inference")
        tail = seen[0].shape[2:]
        panels = {n: answer[name].reshape(frame.rows, -1, *tail) for n, name in ((REAR, "rear"), (FRONT, "front"))}
        return problem.faded(panels, start=START, fade_codes=self.surroundings.fade_codes)


def _is_grey(picture: Picture, box: PixelRect) -> bool:
    """Whether there is no colour in a box of a picture; as far as it is told, where that was left in a texture."""
    return picture.grey if isinstance(picture, DrawnPicture) else is_grey(picture[box.slices])
