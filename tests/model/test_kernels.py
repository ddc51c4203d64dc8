"""The compiled loops: Python's copies of their constants, and the same panels from every instruction set."""

from __future__ import annotations

import ctypes
import re
import subprocess
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime import kernels
from runtime.errors import MissingPart
from runtime.model import cpu
from runtime.model.buffers import LayerPool
from runtime.model.contract import Step
from runtime.model.predictor import load_predictor
from tests.model.scenes import eyes
from tests.model.test_steps import STACK, STACKS, begun, panels_of

ROOT = Path(__file__).parents[2]
NEEDS = {
    "x86_64_v4": {"avx512f", "avx512bw", "avx512vl", "avx512dq"},
    "x86_64_v3": {"avx2", "fma", "bmi2"},
    "default": set(),
}


@pytest.mark.parametrize("name", ["problem_bytes", "warp_bytes", "view_bytes", "max_sets"])
def test_kernels_of_another_layout_or_limit_are_refused(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(kernels.COMPILED, name, kernels.COMPILED[name] + 1)
    kernels.library.cache_clear()
    with pytest.raises(MissingPart, match="was built from another version"):
        load_predictor("sart", STACK)
    monkeypatch.undo()
    kernels.library()


def clones(instructions: str) -> Any:
    """The compiled loops for one instruction set, which the loader would choose on another processor."""
    built = kernels.library()
    table = subprocess.run(["nm", built._name], capture_output=True, text=True, check=True).stdout
    offsets = {row.split()[-1]: int(row.split()[0], 16) for row in table.splitlines() if row[0] == "0"}
    begin = ctypes.addressof(ctypes.c_int32.in_dll(built, "problem_bytes")) - offsets["problem_bytes"]
    suffix = instructions if instructions == "default" else f"arch_{instructions}"
    return SimpleNamespace(
        **{
            name: ctypes.CFUNCTYPE(None, *getattr(built, name).argtypes)(begin + offsets[f"{name}.{suffix}"])
            for name in ("step", "close_middle", "show")
        }
    )


def usable_sets() -> list[str]:
    """Instruction sets of this machine that the loops were compiled for, the best first."""
    flags = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    has = set(flags[1].split()) if flags else set()
    return [name for name, needs in NEEDS.items() if needs <= has]


@pytest.mark.parametrize("stack", ["three", "tilted", "four"])
@pytest.mark.parametrize("channels", [1, 3])
def test_every_instruction_set_makes_the_same_panels(
    stack: str, channels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To the byte, although AVX-512 and AVX2 round a product and its sum once, and the plain build twice."""
    made, sets = [], usable_sets()
    if len(sets) < 2:
        pytest.skip("this machine has one instruction set only")
    for instructions in sets:
        loops = clones(instructions)
        monkeypatch.setattr(cpu, "library", lambda loops=loops: loops)
        state, _, geometry = begun(STACKS[stack], eyes(0.4, 0.2, roll_deg=10), own=True, channels=channels)
        state.close_middle()
        for places in ("rising", "middle", "falling"):
            state.step(Step(size=1.4, places=places))
        buffer = LayerPool(STACKS[stack]).take()
        state.write(buffer, 128)
        made.append((np.concatenate([panel.ravel() for panel in panels_of(state, geometry, channels)]), buffer.pixels))
    for panels, layers in made[1:]:
        assert np.abs(panels - made[0][0]).max() == 0 and (layers == made[0][1]).all()


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("own", [True, False])
def test_whatever_the_loops_read_in_whole_vectors_has_a_margin(channels: int, own: bool) -> None:
    """A read past the last page of a thread's memory ended the process."""
    state, _, _ = begun(STACKS["three"], eyes(0.4, 0.2), own=own, channels=channels)
    for array in (*state._targets, state._tapers[0]):
        assert array.flags.c_contiguous
        assert array.base is not None and array.base.size >= array.size + kernels.MARGIN


def test_a_step_s_symbols_have_one_name_everywhere() -> None:
    """D was `bound` in torch, `curvature` in C++ and GLSL, and either in the mathematics."""
    page = (ROOT / "docs/mathematics.md").read_text(encoding="utf-8")
    row = re.search(r"^\| e, g, D in a step \|.*\| (.*) \|$", page, re.MULTILINE)
    assert row is not None
    for path in ("runtime/kernels/solver.cpp", "runtime/model/gl/shaders/compare.frag.glsl", "model_export/light.py"):
        words = set(re.findall(r"\w+", (ROOT / path).read_text(encoding="utf-8")))
        assert set(re.findall(r"`(\w+)`", row[1])) <= words, path
