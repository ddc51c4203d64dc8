"""Fuzz every reader of foreign bytes for some time each, each in a process of its own.

    python -m tests.fuzz [--seconds 60] [--target NAME ...] [--seed N]

A finding is an exception that is no refusal of ours, a signal, more than CASE_S seconds or more than CASE_MIB for one
case; its bytes are kept in tests/fuzz/corpus/NAME/, which `tests/fuzz/test_corpus.py` tries at every change.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any

CORPUS = Path(__file__).parent / "corpus"
CASE_S, CASE_MIB, ADDRESS_MIB = 10, 400, 12_000
ROUND = 200


class Slow(BaseException):
    """One case took too long."""


def fuzz_one(name: str, seconds: float, seed: int) -> dict[str, Any]:
    """In this process; answers counts, the slowest case, the memory taken, and findings."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded

    from runtime.errors import PhasestackError
    from tests.fuzz.mutations import mutated
    from tests.fuzz.targets import TARGETS

    target = TARGETS[name]
    seeds = target.seeds() + [path.read_bytes() for path in sorted((CORPUS / name).glob("*"))]
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_MIB << 20, ADDRESS_MIB << 20))
    told: dict[str, Any] = {"cases": 0, "refused": 0, "slowest_s": 0.0, "largest_mib": 0.0, "findings": []}

    def too_slow(number: int, frame: Any) -> None:
        raise Slow

    signal.signal(signal.SIGALRM, too_slow)
    folder = Path(tempfile.mkdtemp(prefix="phasestack-fuzz-"))
    current = folder.with_name(folder.name + ".case")
    known: set[str] = set()

    def one(data: bytes) -> None:
        if time.monotonic() > end:
            return
        current.write_bytes(data)  # what is there when a signal ends us is the finding
        for path in folder.iterdir():
            path.unlink()
        before, start = _peak_mib(), time.monotonic()
        problem = ""
        signal.alarm(CASE_S)
        try:
            target.read(data, folder)
        except PhasestackError as error:
            told["refused"] += 1
            if "\n" in str(error) or len(str(error)) > 2000:
                problem = "a refusal of several lines"
        except Slow:
            problem = f"slow: over {CASE_S} s"
        except Exception as error:
            place = traceback.extract_tb(error.__traceback__)[-1]
            problem = f"{type(error).__name__} at {Path(place.filename).name}:{place.lineno}: {str(error)[:120]}"
        finally:
            signal.alarm(0)
        spent, grown = time.monotonic() - start, _peak_mib() - before
        told["cases"] += 1
        told["slowest_s"] = max(told["slowest_s"], spent)
        told["largest_mib"] = max(told["largest_mib"], grown if told["cases"] > 20 else 0.0)
        if spent > 2 * CASE_S:  # somebody's `except BaseException` may have swallowed the alarm
            problem = problem or f"slow: {spent:.0f} s"
        if grown > CASE_MIB and told["cases"] > 20:
            problem = problem or f"memory: {grown:.0f} MiB"
        if problem and problem.split(": ")[0] not in known:
            known.add(problem.split(": ")[0])
            told["findings"].append({"problem": problem, "file": str(keep(name, data))})

    with contextlib.suppress(PhasestackError):
        target.read(seeds[0], folder)  # imports what it needs: no case's time
    end = time.monotonic() + seconds
    round_number = seed
    while time.monotonic() < end and len(told["findings"]) < 20:
        run = given(mutated(seeds))(one)
        run = settings(
            max_examples=ROUND,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )(seeded(round_number)(run))
        run()
        round_number += 1
    with contextlib.suppress(OSError):
        current.unlink()
    return told


def keep(name: str, data: bytes) -> Path:
    """Into the corpus."""
    path = CORPUS / name / hashlib.sha256(data).hexdigest()[:12]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    return path


def _peak_mib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    """All targets, or those that are named; 1 where there are findings."""
    from tests.fuzz.targets import TARGETS

    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--target", nargs="*", choices=sorted(TARGETS), default=sorted(TARGETS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--here", action="store_true", help="in this process, one target, JSON")
    given = parser.parse_args()
    if given.here:
        print(json.dumps(fuzz_one(given.target[0], given.seconds, given.seed)))
        return 0
    failed = False
    for name in given.target:
        command = [sys.executable, "-m", "tests.fuzz", "--here", "--target", name]
        command += ["--seconds", str(given.seconds), "--seed", str(given.seed)]
        with tempfile.TemporaryDirectory() as scratch:
            environment = os.environ | {"TMPDIR": scratch, "PYTHONFAULTHANDLER": "1"}
            done = subprocess.run(command, capture_output=True, text=True, env=environment)
            if done.returncode != 0:
                failed = True
                cases = list(Path(scratch).glob("*.case")) if done.returncode < 0 else []  # else it is this program
                kept = [str(keep(name, case.read_bytes())) for case in cases]
                print(f"{name}: ended by {done.returncode} {' '.join(kept)}\n{done.stderr[-1500:]}", flush=True)
                continue
        told = json.loads(done.stdout.splitlines()[-1])
        failed |= bool(told["findings"])
        print(
            f"{name:12} {told['cases']:7} cases, {told['refused']:7} refused, slowest {told['slowest_s']:.2f} s, "
            f"most memory {told['largest_mib']:.0f} MiB, {len(told['findings'])} findings",
            flush=True,
        )
        for finding in told["findings"]:
            print(f"    {finding['problem']} ({finding['file']})", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
