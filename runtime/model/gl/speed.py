"""How fast a driver moves pixels: what bounds every pass, and what tells a software rasteriser."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any

import moderngl
import numpy as np

from runtime.model.gl.programs import source
from runtime.support.gl import linked_program

SIDE_PX = 1024
RUNS = 3  # timed, of which the fastest counts
SLOW_GB_S = 15.0  # copied; at a fifth of a small GPU's rate the processor's own passes are as fast


@dataclass(frozen=True, slots=True)
class Speed:
    """In 10^9 bytes a second."""

    copy_gb_s: float  # read and written by a shader that copies
    down_gb_s: float  # read back by the processor

    @property
    def slow(self) -> bool:
        """Whether passes of shaders can't be worth it."""
        return self.copy_gb_s < SLOW_GB_S


def measured_speed(context: Any) -> Speed:
    """Of a context that is current on this thread; takes some tens of milliseconds on a software rasteriser."""
    size = (SIDE_PX, SIDE_PX)
    first, second = (context.texture(size, 4, dtype="i2") for _ in range(2))
    target = context.framebuffer([second])
    program = linked_program(context, vertex=source("whole.vert.glsl"), fragment=source("copy.frag.glsl"))
    array = context.vertex_array(program, [])
    held = np.empty((SIDE_PX, SIDE_PX, 4), np.int16)
    try:
        context.enable_only(moderngl.NOTHING)
        target.use()
        first.use(0)

        def copy() -> None:
            array.render(moderngl.TRIANGLES, vertices=3)
            context.finish()

        def down() -> None:
            target.read_into(held, components=4, dtype="i2")

        copy_ms, down_ms = (_fastest_ms(call) for call in (copy, down))
    finally:
        context.detect_framebuffer(0).use()
        for thing in (array, program, target, first, second):
            thing.release()
    total = held.nbytes / 1e6  # bytes a millisecond are 10^-6 of 10^9 a second
    return Speed(2 * total / copy_ms, total / down_ms)


def _fastest_ms(call: Any) -> float:
    call()
    times = []
    for _ in range(RUNS):
        begin_ns = perf_counter_ns()
        call()
        times.append((perf_counter_ns() - begin_ns) / 1e6)
    return min(times)
