"""Solutions without end on the OpenGL backend, for a viewer who walks about, shown from the textures they were left in.

Under way the solver's context is lost, again and again.
"""

from __future__ import annotations

import ctypes
import gc
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S, MonotonicClock
from runtime.config import OutputSettings, Settings
from runtime.daemon.solver_parts import SolverMaker
from runtime.errors import PanelLost
from runtime.eyes.calibration import load_calibration
from runtime.frame.solver_host import still_there
from runtime.frame.solver_thread import SolverThread
from runtime.optics.stack import PanelStack
from runtime.panels.registry import open_panels
from runtime.records import PanelFrame, SolveRequest
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import LayerTextures, ShareGroup
from runtime.support.memory import give_back

SMALL = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 128, 72)
SETTINGS = {"model": {"name": "fast", "threads": 1, "backend": "gl"}, "content": {"scene": "demo"}}
NAMES = 200_000  # of OpenGL's objects that are looked at, of each kind: drivers count on with every context
PATIENCE_S = 120.0


@dataclass(frozen=True)
class Look:
    """What was there at one moment."""

    solutions: int
    resident_mib: float
    objects: dict[str, int]  # textures, buffers, programs, renderbuffers of the share group


@dataclass
class Soak:
    """What was seen."""

    lost: int = 0  # contexts
    looks: list[Look] = field(default_factory=list)
    shown: int = 0  # solutions, from the textures that they were left in


def soaked(solutions: int, *, lost_every: int, look_every: int) -> Soak:
    """So many solutions, one after the other, each shown; every so often the solver's context is lost."""
    context, found = offscreen_context(), Soak()
    sink = open_panels(OutputSettings(), SMALL, MonotonicClock(), context)
    settings = Settings.model_validate(SETTINGS)
    maker = SolverMaker(settings, SMALL, load_calibration(None), panels_group=lambda: sink.group)
    host = SolverThread(maker, MonotonicClock())
    host._late_ns, host._abandon_ns = 60 * NS_PER_S, NS_PER_S // 20
    try:
        host.wait_ready()
        newest = 0
        for number in range(1, solutions + 1):
            newest = next_shown(host, sink, number, after=newest)
            found.shown += 1
            if number % look_every == 0:
                found.looks.append(look(sink, number))
            if number % lost_every == 0 and number < solutions:
                lose(host, maker)
                found.lost += 1
    finally:
        host.close()
        sink.close()
        context.release()
    return found


def next_shown(host: SolverThread, sink: Any, number: int, *, after: int) -> int:
    """The number of the next solution, once the panels showed it from its textures; the flat picture where the one
    before it is no more."""
    deadline_s = monotonic() + PATIENCE_S
    while monotonic() < deadline_s:
        host.post(wish(number))
        news = still_there(host.news())
        solution, flat = news.solution, news.flat
        assert flat is not None
        try:
            if solution is None:
                sink.present(PanelFrame(number, None, 0, (), flat.made, flat.number, 1.0))
            elif solution.number > after or not isinstance(solution.made, LayerTextures):
                sink.present(PanelFrame(number, solution.made, solution.number))
                # Made while the panels had no context, it was read back; they have another as soon as they show it.
                if isinstance(solution.made, LayerTextures):
                    return solution.number
        except PanelLost:
            sleep(0.01)
        sleep(0.001)
    raise AssertionError(f"no solution after number {number}: {host.news().missing}")


def wish(number: int) -> SolveRequest:
    angle = number * 0.1
    middle = np.array([0.6 + 0.05 * np.sin(angle * 0.3), 0.1 * np.sin(angle), 0.05 * np.cos(angle * 0.7)])
    half = np.array([0.0, 0.031, 0.004 * np.sin(angle)])
    sigma_m = 0.001 + 0.002 * (number % 3)
    return SolveRequest(number, np.array([middle - half, middle + half]), "predicted", sigma_m, flat_wanted=False)


def lose(host: SolverThread, maker: SolverMaker) -> None:
    """Take the solver's context away; answers when there is another."""
    before = maker.parts

    def release(parts: Any) -> bool:
        parts.context.extra.release()
        return True

    host.do(release)
    deadline_s = monotonic() + PATIENCE_S
    number = 0
    while maker.parts is before:
        host.post(wish(number := number + 1))
        still_there(host.news())
        assert monotonic() < deadline_s, "the solver did not notice"
        sleep(0.01)


def look(sink: Any, number: int) -> Look:
    gc.collect()
    give_back()
    return Look(number, round(resident_mib(), 1), objects(sink.group))


def objects(group: ShareGroup) -> dict[str, int]:
    """How many of each kind OpenGL holds for a group, by asking it for every name."""
    library = ctypes.CDLL("libGL.so.1")
    with group.borrowed():
        return {
            kind: sum(bool(is_one(ctypes.c_uint(name))) for name in range(1, NAMES))
            for kind, is_one in (
                ("textures", library.glIsTexture),
                ("buffers", library.glIsBuffer),
                ("programs", library.glIsProgram),
                ("renderbuffers", library.glIsRenderbuffer),
            )
        }


def resident_mib() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (resident,) = (line for line in lines if line.startswith("VmRSS:"))
    return int(resident.split()[1]) / 1024
