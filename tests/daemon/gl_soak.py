"""Solutions without end on the OpenGL backend, for a viewer who walks about, shown from the textures they were left in.

python -m tests.daemon.gl_soak --solutions 100000

Under way, in turn: the solver's context is lost, the panels' context is reset, and with --windows a monitor is
unplugged and plugged in again, so that windows are closed and reopened (Xorg with its dummy driver).
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np

from runtime.clock import MonotonicClock
from runtime.config import OutputSettings, PanelSettings, Settings
from runtime.daemon.solver_parts import SolverMaker
from runtime.errors import PanelLost
from runtime.eyes.calibration import load_calibration
from runtime.frame.solver_host import still_there
from runtime.frame.solver_thread import SolverThread
from runtime.optics.stack import PanelStack
from runtime.panels import window
from runtime.panels.registry import open_panels
from runtime.records import PanelFrame, SolveRequest
from runtime.support.gl import offscreen_context
from runtime.support.gl_sharing import LayerTextures, ShareGroup
from runtime.support.memory import give_back
from tests.panels import xserver

SMALL = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 128, 72)
ON_WINDOWS = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), xserver.WIDTH_PX, xserver.HEIGHT_PX)
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

    events: dict[str, int] = field(default_factory=dict)
    looks: list[Look] = field(default_factory=list)
    shown: int = 0  # solutions, from the textures that they were left in


def soaked(
    solutions: int,
    *,
    upset_every: int,
    look_every: int,
    server: xserver.XServer | None = None,
    tell: Callable[[str], None] = print,
) -> Soak:
    """So many solutions, one after the other, each shown; every so often something is lost.

    server: panels are windows on its monitors; None: offscreen. The contexts of this thread are the panels'.
    """
    context, found = offscreen_context(), Soak()
    stack = SMALL if server is None else ON_WINDOWS
    output = OutputSettings()
    if server is not None:
        panels = tuple(PanelSettings(connector=f"DUMMY{index}") for index in range(3))
        output = OutputSettings(kind="windows", vsync=False, panels=panels)
    sink = open_panels(output, stack, MonotonicClock(), context)
    maker = SolverMaker(
        Settings.model_validate(SETTINGS), stack, load_calibration(None), on_start=lambda _: True,
        panels_group=lambda: sink.group,
    )  # fmt: skip
    host = SolverThread(maker, MonotonicClock(), late_s=60.0, abandon_s=0.05)
    upsets: list[tuple[str, Callable[[], None]]] = [("solver's context lost", lambda: lose(host, maker))]
    if server is not None:
        upsets += [("panels' context reset", lambda: reset(sink)), ("windows reopened", lambda: replug(sink, server))]
    try:
        host.wait_ready()
        newest = 0
        for number in range(1, solutions + 1):
            newest = next_shown(host, sink, number, after=newest)
            found.shown += 1
            if number % look_every == 0:
                found.looks.append(look(sink, number))
                tell(str(found.looks[-1]))
            if number % upset_every == 0 and number < solutions:
                name, upset = upsets[number // upset_every % len(upsets)]
                upset()
                found.events[name] = found.events.get(name, 0) + 1
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


def reset(sink: Any) -> None:
    """What the driver says after a GPU's reset, once."""
    told, window._reset_status = window._reset_status, lambda: "was reset (0x8253)"
    try:
        sink.present(PanelFrame(0, np.zeros((3, xserver.HEIGHT_PX, xserver.WIDTH_PX, 4), np.uint8), -1))
    except PanelLost:
        return
    finally:
        window._reset_status = told
    raise AssertionError("the panels did not notice")


def replug(sink: Any, server: xserver.XServer) -> None:
    """A monitor goes, the panels notice, and it comes back."""
    server.unplug(1)
    layers = np.zeros((3, xserver.HEIGHT_PX, xserver.WIDTH_PX, 4), np.uint8)
    for _ in range(1000):
        try:
            sink.present(PanelFrame(0, layers, -1))
        except PanelLost:
            break
    else:
        raise AssertionError("the panels did not notice")
    server.plug(1)


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


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--solutions", type=int, default=100_000)
    arguments.add_argument("--upset-every", type=int, default=2_000)
    arguments.add_argument("--look-every", type=int, default=1_000, help="solutions between two looks at memory")
    arguments.add_argument("--windows", action="store_true")
    given = arguments.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        screen = xserver.XServer(Path(folder)) if given.windows else None
        if screen is not None:
            os.environ["DISPLAY"] = screen.name
        try:
            result = soaked(
                given.solutions,
                upset_every=given.upset_every,
                look_every=given.look_every,
                server=screen,
                tell=lambda line: print(line, flush=True),
            )
        finally:
            if screen is not None:
                screen.stop()
    print(f"{result.shown} solutions shown, {result.events}")
