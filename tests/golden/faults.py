"""Faults that a golden run must notice, each a small edit of one module, made in a process of its own.

`python -m tests.golden.faults` prints the table; `python -m tests.golden.faults NAME` plays one.
"""

from __future__ import annotations

import argparse
import logging
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tests.mutation.imports import put_in_place_of

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, slots=True)
class Fault:
    """`old` becomes `new` in a module; `case` is the golden run that must notice."""

    kind: str
    module: str
    old: str
    new: str
    case: str = "fault"

    @property
    def path(self) -> Path:
        return ROOT / (self.module.replace(".", "/") + ".py")

    def source(self) -> str:
        """The module with the fault. Raises ValueError where `old` is not there exactly once."""
        text = self.path.read_text(encoding="utf-8")
        if text.count(self.old) != 1:
            raise ValueError(f"{self.module} has {self.old!r} {text.count(self.old)} times")
        return text.replace(self.old, self.new)


FAULTS = {
    "eyes-swapped-by-the-calibration": Fault(
        "eyes swapped",
        "runtime.eyes.calibration",
        "eyes_m=self.points(eyes.eyes_m))",
        "eyes_m=self.points(eyes.eyes_m[::-1]))",
    ),
    "eyes-swapped-when-drawing": Fault(
        "eyes swapped",
        "runtime.plan.drawing",
        "for side, eye in enumerate(eyes_m)\n    )\n    return left, right\n\n\ndef retina_view",
        "for side, eye in enumerate(eyes_m[::-1])\n    )\n    return left, right\n\n\ndef retina_view",
    ),
    "eyes-swapped-in-the-solver": Fault(
        "eyes swapped", "runtime.model.opencv_surround", "enumerate((-half, half))", "enumerate((half, -half))"
    ),
    "transposed-calibration": Fault(
        "a transposed matrix",
        "runtime.eyes.calibration",
        "return points @ self.stack_from_sensor[:3, :3].T +",
        "return points @ self.stack_from_sensor[:3, :3] +",
    ),
    "transposed-content": Fault(
        "a transposed matrix",
        "runtime.content.procedural",
        "matrix[:3, :3] = turn * self._scale",
        "matrix[:3, :3] = turn.T * self._scale",
    ),
    "transposed-mounting": Fault(
        "a transposed matrix",
        "runtime.panels.presentation",
        "tuple(mounting.layer_from_screen.T.ravel())",
        "tuple(mounting.layer_from_screen.ravel())",
        case="four-panels",
    ),
    "half-a-pixel-of-the-panels": Fault(
        "half a pixel",
        "runtime.optics.stack",
        "left_m=-self.width_m / 2,",
        "left_m=-self.width_m / 2 + self.width_m / self.width_px / 2,",
    ),
    "half-a-pixel-of-the-shader": Fault(
        "half a pixel", "runtime.panels.presentation", "solved_from_shown.zw - 0.5,", "solved_from_shown.zw,"
    ),
    "half-a-pixel-of-the-reference": Fault(
        "half a pixel", "runtime.optics.alignment", "(np.arange(count) + 0.5) * scale", "np.arange(count) * scale"
    ),
    "half-a-pixel-of-sart": Fault(
        "half a pixel",
        "runtime.model.sart",
        "[[1.0, 0.0, -0.5], [0.0, 1.0, -0.5],",
        "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0],",
        case="four-panels",
    ),
    "the-wrong-branch": Fault(
        "the wrong branch", "runtime.optics.malus", "root if branch == 1 else 2 - root", "root if branch else 2 - root"
    ),
    "the-wrong-branch-of-the-flat-picture": Fault(
        "the wrong branch", "runtime.model.flat", "phase_codes(2)", "phase_codes(1)", case="scenes"
    ),
    "panels-swapped-by-the-solver": Fault(
        "panels swapped",
        "runtime.model.compiled.level",
        "self._copy(self.outer[n], layers[n], boxes[n])",
        "self._copy(self.outer[n], layers[2 - n], boxes[n])",
    ),
    "panels-swapped-by-the-shader": Fault(
        "panels swapped",
        "runtime.panels.presentation",
        "textures.use(frame, index)",
        "textures.use(frame, 2 - index)",
    ),
    "mm-for-m-of-the-tracker": Fault("mm for m", "runtime.optics.pupil", "tracker_sigma_m * 1e3)", "tracker_sigma_m)"),
    "mm-for-m-of-the-doubt": Fault(
        "mm for m", "runtime.model.chain", "moved_m = eye_sigma_mm / 1e3 * reach", "moved_m = eye_sigma_mm * reach"
    ),
    "mm-for-m-of-the-resting-head": Fault(
        "mm for m",
        "runtime.frame.viewer",
        "most_m = (plan.dead_band_mm or plan.most_band_mm) / 1000",
        "most_m = plan.dead_band_mm or plan.most_band_mm",
        case="still",
    ),
    "a-dropped-clip-of-the-outer-panels": Fault(
        "a dropped clip",
        "runtime.model.compiled.level",
        "limits=(0.0, FULL)",
        "limits=(-FARTHEST, FARTHEST)",
    ),
    "a-dropped-clip-of-the-centre": Fault(
        "a dropped clip",
        "runtime.model.compiled.passes",
        "best[U(k)] = min(max(best[U(k)], none), most)",
        "best[U(k)] = best[U(k)]",
    ),
    "a-dropped-clip-of-sart": Fault(
        "a dropped clip",
        "runtime.model.sart",
        "                    np.clip(panels[n], 0, 1, out=panels[n])\n",
        "",
        case="four-panels",
    ),
    "a-stale-solution": Fault(
        "a stale solution",
        "runtime.frame.solver_host",
        "step.solution or news.solution,",
        "news.solution or step.solution,",
    ),
    "a-stale-texture": Fault(
        "a stale solution",
        "runtime.panels.presentation",
        "and frame.solved_version != self._solved_version",
        "and self._solved_version is None",
    ),
    "stale-content": Fault(
        "a stale solution",
        "runtime.frame.solver",
        "state.content, eyes_m, time_ns=request.time_ns)",
        "state.content, eyes_m, time_ns=request.time_ns - 100_000_000)",
        case="walk",
    ),
    "a-stale-alignment": Fault(
        "a stale solution",
        "runtime.frame.presenter",
        "if self._aligned is None or self._aligned[:2] != (solution.number, key):",
        "if self._aligned is None or self._aligned[0] != solution.number:",
    ),
    "a-refresh-lost": Fault(
        "a refresh lost",
        "runtime.frame.presenter",
        "if frame.solved is None and frame.flat is None:",
        "if frame.number == 30:",
    ),
    "a-refresh-skipped": Fault(
        "a refresh lost",
        "runtime.frame.pacing",
        "target_ns = self._target_ns + self.period_ns\n",
        "target_ns = self._target_ns + self.period_ns * (1 + (self._number == 40))\n",
    ),
    "a-sample-lost": Fault(
        "a refresh lost",
        "runtime.frame.samples",
        "        self.stale_inputs += max(0, len(frames) - 1)\n",
        "        frames = [frame for frame in frames if frame.sequence != 20]\n",
    ),
}


def played(name: str) -> subprocess.CompletedProcess[str]:
    """The golden run of a fault, in a process of its own: rc 1 and the differences where it is noticed."""
    with tempfile.TemporaryDirectory() as cache:
        # Compiled code is kept by its file, which has no fault.
        kept = {"XDG_CACHE_HOME": cache} if ".compiled." in FAULTS[name].module else {}
        return subprocess.run(
            [sys.executable, "-m", "tests.golden.faults", name],
            capture_output=True, text=True, timeout=300, cwd=ROOT, env=os.environ | kept,
        )  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.golden.faults", description=__doc__)
    parser.add_argument("name", nargs="?", choices=[*FAULTS, []], help="play this one; none: the table of all")
    name = parser.parse_args().name
    if not name:
        unnoticed = 0
        print("| fault | edit | run | fields that moved | the first |\n| --- | --- | --- | ---: | --- |")
        for one, fault in FAULTS.items():
            result = played(one)
            lines = result.stdout.splitlines() if result.returncode == 1 else []
            unnoticed += not lines
            first = lines[0].partition(": ")[2].split("; ")[0] if lines else "**nothing**"
            print(f"| {fault.kind} | {one.replace('-', ' ')} | `{fault.case}` | {len(lines)} | {first} |", flush=True)
        return 1 if unnoticed else 0
    fault = FAULTS[name]
    logging.getLogger("phasestack").addHandler(logging.NullHandler())
    finder = put_in_place_of(fault.module, compile(fault.source(), str(fault.path), "exec"))
    from tests.golden.references import check

    try:
        lines = check(fault.case)
    except Exception as error:
        lines = [f"{fault.case}: does not end: {type(error).__name__}: {error}"]
    assert finder.used, "the module was not imported"
    print("\n".join(lines))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
