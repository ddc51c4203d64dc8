"""Solutions without end on the OpenGL backend, for a viewer who walks about; contexts are lost under way.

python -m tests.daemon.gl_soak --solutions 100000
"""

from __future__ import annotations

import argparse
import gc
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from runtime.config import Settings
from runtime.daemon.solver_parts import RunningSolver, SolverMaker
from runtime.errors import ContextLost
from runtime.eyes.calibration import load_calibration
from runtime.optics.stack import PanelStack
from runtime.records import SolveRequest
from runtime.support.gl import offscreen_context
from runtime.support.memory import give_back

STACK = PanelStack(0.5184, 0.2916, (-0.06, 0.0, 0.06), 128, 72)
SETTINGS = {"model": {"name": "fast", "threads": 1, "backend": "gl"}, "content": {"scene": "demo"}}
LOOKS = 20  # at memory, spread over the run


@dataclass
class Soak:
    """What was seen at each look."""

    lost: int = 0
    textures: list[int] = field(default_factory=list)
    resident_mib: list[float] = field(default_factory=list)


def soaked(solutions: int, *, lose_every: int) -> Soak:
    """So many solutions, one after the other; the context is taken away now and then."""
    maker = SolverMaker(Settings.model_validate(SETTINGS), STACK, load_calibration(None), on_start=lambda _: True)
    context, found = offscreen_context(), Soak()
    parts = maker(context=context, simulated=True)
    _step(parts, 0)  # the flat picture
    for number in range(1, solutions + 1):
        if number % lose_every == 0 and number < solutions:
            context.release()
            try:
                _step(parts, number)
            except ContextLost:
                found.lost += 1
            parts.close()
            context = offscreen_context()
            parts = maker(context=context, simulated=True)
            _step(parts, 0)
        _step(parts, number)
        if number >= 100 and number % max(1, solutions // LOOKS) == 0:
            gc.collect()
            give_back()
            found.textures.append(_textures(parts))
            found.resident_mib.append(_resident_mib())
    parts.close()
    context.release()
    return found


def _step(parts: RunningSolver, number: int) -> None:
    angle = number * 0.1
    middle = np.array([0.6 + 0.05 * np.sin(angle * 0.3), 0.1 * np.sin(angle), 0.05 * np.cos(angle * 0.7)])
    half = np.array([0.0, 0.031, 0.004 * np.sin(angle)])
    sigma_m = 0.001 + 0.002 * (number % 3)
    parts.step(SolveRequest(number, np.array([middle - half, middle + half]), "predicted", sigma_m, flat_wanted=False))


def _textures(parts: RunningSolver) -> int:
    """GL objects that the model's surroundings hold."""
    backend = parts.backend.backend
    passes = backend.passes  # type: ignore[attr-defined]
    return len(passes._targets)


def _resident_mib() -> float:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    (resident,) = (line for line in lines if line.startswith("VmRSS:"))
    return int(resident.split()[1]) / 1024


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--solutions", type=int, default=100_000)
    arguments.add_argument("--lose-every", type=int, default=10_000)
    given = arguments.parse_args()
    result = soaked(given.solutions, lose_every=given.lose_every)
    print(f"{result.lost} contexts lost; framebuffers {result.textures}; resident MiB {result.resident_mib}")
