"""What the OpenGL backend reads and writes for one solution: from it anyone can work out what their GPU will do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from runtime.config import ModelSettings, StackGeometry
from runtime.model.gl.backend import GlBackend
from runtime.model.gl.programs import Account, Pass
from runtime.model.predictor import load_predictor
from runtime.plan.drawing import drawn_for
from runtime.report.pairs import Painter, eyes_at

SPEEDS_GB_S = (25, 100, 400)  # of a processor's own graphics, a small GPU's memory, a large one's
CASES = ((0.0, False), (0.0, True), (3.0, False))  # eye sigma in mm; corrections in one pass


@dataclass(frozen=True, slots=True)
class Solution:
    """One solution's passes."""

    model: str
    width_px: int
    height_px: int
    eye_sigma_mm: float
    at_once: bool  # corrections in one pass each
    passes: tuple[Pass, ...]

    @property
    def drawn(self) -> tuple[Pass, ...]:
        """Those of the GPU."""
        return tuple(one for one in self.passes if not one.crosses)

    @property
    def moved_bytes(self) -> int:
        """Read and written by the GPU, every image of a pass once."""
        return sum(one.read_bytes + one.written_bytes for one in self.drawn)

    def crossing_bytes(self, *names: str) -> int:
        """Between GPU and processor."""
        return sum(one.read_bytes + one.written_bytes for one in self.passes if one.name in names)

    def least_ms(self, gb_s: float) -> float:
        """As long as a memory of that speed takes for what is moved."""
        return self.moved_bytes / gb_s / 1e6


def counted(
    models: Sequence[str],
    *,
    width_px: int,
    height_px: int,
    cases: Sequence[tuple[float, bool]] = CASES,
    timed: bool = False,
) -> list[Solution]:
    """Of real solutions, one a model and case, drawn and solved in one context as the daemon does.

    timed: each pass by a timer query, in a second solution, whose programs are compiled and whose images are there.
    Raises MissingPart without OpenGL.
    """
    stack = replace(StackGeometry().stack(), width_px=width_px, height_px=height_px)
    eyes_m, found = eyes_at(distance_m=0.6), []
    with Painter("demo", stack) as painter:
        backend = GlBackend(painter.context, stack)
        for model in models:
            predictor = load_predictor(model, stack, ModelSettings(name=model))
            for sigma_mm, at_once in cases:
                backend.at_once = at_once
                predictor.surround_with(backend)
                images = drawn_for(predictor, painter.content, eyes_m, time_ns=0)
                if timed:
                    predictor.predict(images, eyes_m, eye_sigma_mm=sigma_mm)
                backend.passes.account = account = Account(timed=timed)
                predictor.predict(images, eyes_m, eye_sigma_mm=sigma_mm)
                backend.passes.account = None
                found.append(Solution(model, width_px, height_px, sigma_mm, at_once, tuple(account.passes)))
            predictor.close()
        backend.passes.release()
    return found


def table(solutions: Iterable[Solution]) -> list[str]:
    """Lines of markdown."""
    speeds = "".join(f" {speed} GB/s |" for speed in SPEEDS_GB_S)
    lines = [
        "| model | eyes unsure by | corrections | passes | read and written, MB | network's raster, MB | layers, MB |"
        + speeds,
        "| --- | --- | --- | --- | --- | --- | --- |" + " --- |" * len(SPEEDS_GB_S),
    ]
    for one in solutions:
        raster = one.crossing_bytes("network down", "answer up") / 1e6
        layers = one.crossing_bytes("layer down") / 1e6
        times = "".join(f" {one.least_ms(speed):.1f} ms |" for speed in SPEEDS_GB_S)
        unsure = any(step.name == "correct_unsure" for step in one.drawn)
        how = "in five, and two of the mean" if unsure else "in one pass" if one.at_once else "in two"
        lines.append(
            f"| {one.model} | {one.eye_sigma_mm:g} mm | {how} | {len(one.drawn)} | {one.moved_bytes / 1e6:.0f} | "
            f"{raster:.1f} | {layers:.1f} |{times}"
        )
    return lines
