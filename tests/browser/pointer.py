"""Measures the page of `phasestack try` in headless Chromium: how soon after the pointer it shows a picture
drawn for the new place, and how many solutions a second while it moves. Real clock, default panels; Chromium draws
without a GPU, on the same cores.

    NODE_PATH=... python -m tests.browser.pointer                          # needs what tests/browser needs
    NODE_PATH=... python -m tests.browser.pointer OTHER/.venv/bin/phasestack .venv/bin/phasestack --rounds 3

Several programs are measured in turn, as many times as `--rounds` says; other work on the machine counts against both.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from tests.browser.test_viewer import driven

PHASESTACK = Path(sys.executable).with_name("phasestack")


def measured(program: Path, *, moves: int, seconds: float) -> dict[str, Any]:
    """What pointer.mjs says of one run of `phasestack try`."""
    with tempfile.TemporaryDirectory() as folder:
        command = [program.absolute(), "try", "--no-browser", "--json"]
        environment = {**os.environ, "STATE_DIRECTORY": folder}
        with subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True) as served:
            assert served.stdout is not None
            try:
                return driven("pointer.mjs", json.loads(served.stdout.readline())["url"], moves, seconds)
            finally:
                served.terminate()


def line(told: list[dict[str, Any]]) -> str:
    """One program's figures over all rounds."""
    latencies = np.concatenate([one["latencies_ms"] for one in told])
    efforts = sum((Counter(one["efforts"]) for one in told), Counter[str]())
    solved, shown, frames = (np.mean([one[f"{name}_per_s"] for one in told]) for name in ("solved", "shown", "frames"))
    away_mm = np.concatenate([one["view_error_mm"] for one in told])
    return (
        f"{len(latencies)} moves ({sum(one['never_shown'] for one in told)} never shown): median "
        f"{np.median(latencies):.0f} ms, 99% within {np.quantile(latencies, 0.99):.0f} ms; while it moves "
        f"{solved:.1f} solutions a second ({shown:.1f} shown, {frames:.1f} frames), most with {efforts.most_common(2)}"
        + (f", drawn for a head {np.median(away_mm):.0f} mm away" if away_mm.size else "")
    )


def main() -> None:
    """Measure, and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("programs", type=Path, nargs="*", default=[PHASESTACK])
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--moves", type=int, default=100)
    parser.add_argument("--seconds", type=float, default=15.0)
    arguments = parser.parse_args()
    told: dict[Path, list[dict[str, Any]]] = defaultdict(list)
    for number in range(arguments.rounds):
        for program in arguments.programs:
            load = os.getloadavg()[0]
            told[program].append(measured(program, moves=arguments.moves, seconds=arguments.seconds))
            print(f"round {number + 1}, load {load:.1f}, {program}: {line(told[program][-1:])}", flush=True)
    for program, rounds in told.items():
        print(f"{program}: {line(rounds)}")


if __name__ == "__main__":
    main()
