"""The loop's solver with the OpenGL backend: it solves what the processor solves, and a lost context leaves nothing."""

from __future__ import annotations

import ctypes
import gc
from collections import Counter
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import numpy as np
import pytest

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
from runtime.support.gl_sharing import LayerTextures
from runtime.support.memory import give_back
from tests.model.plain_panels import hold_exactly

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 240, 136)
SMALL = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 128, 72)
NAMES = 200_000  # of OpenGL's objects that are looked at, of each kind: drivers count on with every context
PATIENCE_S = 120.0


def maker_of(model: str, backend: str, scene: str, stack: PanelStack, **more: Any) -> SolverMaker:
    tables = {"model": {"name": model, "threads": 1, "backend": backend}, "content": {"scene": scene}}
    return SolverMaker(Settings.model_validate(tables), stack, load_calibration(None), **more)


@pytest.mark.parametrize("scene", ["demo", "grey"])
def test_pictures_in_textures_are_solved_as_pictures_in_arrays_are(scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    hold_exactly(monkeypatch)
    eyes_m = np.array([[0.6, -0.031, 0.05], [0.6, 0.031, 0.05]])
    request = SolveRequest(0, eyes_m, "predicted", 0.001, flat_wanted=False)
    layers = []
    for backend in ("gl", "cpu"):
        context = offscreen_context()
        with context:
            made = maker_of("balanced", backend, scene, STACK)(context=context, simulated=True)
            made.step(request)
            solution = made.step(request).solution
            assert solution is not None
            layers.append(solution.layers.astype(np.int16))
            made.close()
    assert (np.abs(layers[0] - layers[1]) <= 1).mean() >= 0.999


class Walk:
    """Solutions one after the other for a viewer who walks about, each shown from the textures it was left in."""

    def __init__(self) -> None:
        self._context = offscreen_context()
        self.sink: Any = open_panels(OutputSettings(), SMALL, MonotonicClock(), self._context)
        self.maker = maker_of("fast", "gl", "demo", SMALL, panels_group=lambda: self.sink.group)
        self.host = SolverThread(self.maker, MonotonicClock())
        self.host._late_ns, self.host._abandon_ns = 60 * NS_PER_S, NS_PER_S // 20
        self._shown = 0

    def close(self) -> None:
        self.host.close()
        self.sink.close()
        self._context.release()

    def next_shown(self, number: int) -> None:
        """Until the panels showed the next solution; the flat picture where the one before it is no more."""
        deadline_s = monotonic() + PATIENCE_S
        while monotonic() < deadline_s:
            self.ask(number)
            news = still_there(self.host.news())
            solution, flat = news.solution, news.flat
            assert flat is not None
            try:
                if solution is None:
                    self.sink.present(PanelFrame(number, None, 0, (), flat.made, flat.number, 1.0))
                elif solution.number > self._shown or not isinstance(solution.made, LayerTextures):
                    self.sink.present(PanelFrame(number, solution.made, solution.number))
                    # Made while the panels had no context, it was read back; they have another as soon as they show it.
                    if isinstance(solution.made, LayerTextures):
                        self._shown = solution.number
                        return
            except PanelLost:
                sleep(0.01)
            sleep(0.001)
        raise AssertionError(f"no solution after number {self._shown}: {self.host.news().missing}")

    def ask(self, number: int) -> None:
        angle = number * 0.1
        middle = np.array([0.6 + 0.05 * np.sin(angle * 0.3), 0.1 * np.sin(angle), 0.05 * np.cos(angle * 0.7)])
        half = np.array([0.0, 0.031, 0.004 * np.sin(angle)])
        eyes_m, sigma_m = np.array([middle - half, middle + half]), 0.001 + 0.002 * (number % 3)
        self.host.post(SolveRequest(number, eyes_m, "predicted", sigma_m, flat_wanted=False))

    def lose_context(self) -> None:
        """Take the solver's context away, until there is another."""
        before, deadline_s, number = self.maker.parts, monotonic() + PATIENCE_S, 0

        def release(parts: Any) -> bool:
            parts.context.extra.release()
            return True

        self.host.do(release)
        while self.maker.parts is before:
            self.ask(number := number + 1)
            still_there(self.host.news())
            assert monotonic() < deadline_s, "the solver did not notice"
            sleep(0.01)

    def objects(self) -> Counter[str]:
        """How many of each kind OpenGL holds for the panels' group, by asking it for every name."""
        library = ctypes.CDLL("libGL.so.1")
        kinds = {kind: getattr(library, f"glIs{kind}") for kind in ("Texture", "Buffer", "Program", "Renderbuffer")}
        gc.collect()
        with self.sink.group.borrowed():
            return Counter(
                {kind: sum(bool(is_one(name)) for name in range(1, NAMES)) for kind, is_one in kinds.items()}
            )


def resident_mib() -> float:
    give_back()
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (resident,) = (line for line in lines if line.startswith("VmRSS:"))
    return int(resident.split()[1]) / 1024


@pytest.mark.parametrize(
    ("solutions", "lost_every"), [(15, 5), pytest.param(2000, 500, marks=pytest.mark.slow)], ids=["some", "thousands"]
)
def test_solutions_with_contexts_lost_under_way_leave_no_object_and_no_memory_behind(
    solutions: int, lost_every: int
) -> None:
    """Depth once lay in renderbuffers, which Mesa keeps where another context of the group releases them."""
    walk, looks, resident = Walk(), [], []
    try:
        walk.host.wait_ready()
        for number in range(1, solutions + 1):
            walk.next_shown(number)
            if number in (lost_every, solutions):
                looks.append(walk.objects())
                resident.append(resident_mib())
            if number % lost_every == 0:
                walk.lose_context()
        assert walk.maker.parts is not None and walk.maker.parts.backend.backend.name == "gl"
    finally:
        walk.close()
    assert {look["Renderbuffer"] for look in looks} == {0}
    assert looks[-1].total() <= looks[0].total() + 6  # two solutions more may be held just then
    assert solutions < 1000 or resident[-1] - resident[0] < 64  # once it is warm: of the process's
