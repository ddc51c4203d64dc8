"""Runs mutmut on a seeded sample of each module's mutants, in a copy of the tree, and tells what survived.

mutmut makes the mutants and forks a process for each, which runs only the tests that reach the mutated function. Here
it forks from a server that has collected the tests and run none: OpenCV's threads, onnxruntime's sessions and GL
contexts do not survive a fork.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.mutation import again
from tests.mutation.modules import MODULES

ROOT = Path(__file__).resolve().parents[2]
SURVIVED = 0  # pytest's exit code
NO_TESTS = 33  # mutmut's: none reaches the mutated function
# Of a property, the same for every mutant; those that say how many they want keep it.
FEW_EXAMPLES = """
import hypothesis

hypothesis.settings.register_profile("mutants", deadline=None, max_examples=25, derandomize=True)
hypothesis.settings.load_profile("mutants")
"""
REASONS = Path(__file__).parent / "survivors.toml"


@dataclass(frozen=True, slots=True)
class Score:
    """What became of a module's sampled mutants."""

    module: str
    mutants: int  # that there are
    tried: int
    survivors: dict[str, str]  # name -> its diff

    @property
    def killed(self) -> int:
        return self.tried - len(self.survivors)


def sample(names: Sequence[str], *, count: int, seed: int) -> list[str]:
    """`count` of them, the same for the same seed, in their order."""
    if len(names) <= count:
        return list(names)
    chosen = set(random.Random(seed).sample(sorted(names), count))
    return [name for name in names if name in chosen]


def prepared(module: str, tests: Sequence[str], folder: Path) -> Path:
    """A copy of the tree with mutmut's configuration; answers the mutated file's place in it."""
    for name in ("runtime", "calib", "model_export", "tests"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "out"))
    file = module.replace(".", "/") + ".py"
    with (folder / "tests" / "conftest.py").open("a", encoding="utf-8") as conftest:
        conftest.write(FEW_EXAMPLES)
    arguments = ("-q", "-x", "-m", "not slow", "-p", "no:cacheprovider")
    lines = {
        "source_paths": (file.split("/")[0],),
        "only_mutate": (file,),
        "pytest_add_cli_args_test_selection": tests,
        "pytest_add_cli_args": arguments,
        "also_copy": ("runtime", "calib", "model_export"),
        "process_isolation": ("forkserver",),
        "use_git_change_detection": ("false",),
        "timeout_multiplier": ("20",),
        "timeout_constant": ("10",),
    }
    text = "".join(f"{name}=" + "\n    ".join(values) + "\n" for name, values in lines.items())
    (folder / "setup.cfg").write_text(f"[mutmut]\n{text}", encoding="utf-8")
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    markers = "\n    ".join(settings["markers"])
    (folder / "pytest.ini").write_text(f"[pytest]\nmarkers =\n    {markers}\n", encoding="utf-8")
    return folder / "mutants" / (file + ".meta")


def mutmut(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """mutmut in that copy; no other PYTHONPATH than the caller's own additions."""
    paths = [path for path in os.environ.get("PYTHONPATH", "").split(":") if path and Path(path).resolve() != ROOT]
    environment = os.environ | {"PYTHONPATH": ":".join(paths)}
    return subprocess.run(
        [sys.executable, "-m", "mutmut", *arguments], cwd=folder, env=environment, capture_output=True, text=True
    )


def codes_of(meta: Path) -> dict[str, int | None]:
    """Exit code of each mutant of a file; None: not tried."""
    codes: dict[str, int | None] = json.loads(meta.read_text(encoding="utf-8"))["exit_code_by_key"]
    return codes


def tried(module: str, *, count: int, seed: int) -> Score:
    """Sample, run, collect. Raises RuntimeError where mutmut itself fails."""
    tests = [path for path in MODULES[module] if (ROOT / path).exists()]
    with tempfile.TemporaryDirectory(prefix="mutants-") as name:
        folder = Path(name)
        meta = prepared(module, tests, folder)
        first = mutmut(folder, "run", "--max-children", "1", "no-such-mutant")  # makes them, and collects the tests
        if not meta.exists():
            raise RuntimeError(f"{module}: mutmut made no mutants:\n{first.stdout[-2000:]}{first.stderr[-2000:]}")
        names = list(codes_of(meta))
        chosen = sample(names, count=count, seed=seed)
        ran = mutmut(folder, "run", "--max-children", "1", *chosen)
        codes = codes_of(meta)
        untried = [name for name in chosen if codes[name] is None]
        if untried:
            raise RuntimeError(f"{module}: {len(untried)} not tried:\n{ran.stdout[-3000:]}{ran.stderr[-2000:]}")
        survivors = [name for name in chosen if codes[name] in (SURVIVED, NO_TESTS)]
        return Score(module, len(names), len(chosen), {name: shown(folder, name) for name in survivors})


def shown(folder: Path, mutant: str) -> str:
    """The two lines of a mutant's diff."""
    text = mutmut(folder, "show", mutant).stdout
    changed = [line for line in text.splitlines() if line[:1] in "+-" and line[:3] not in ("+++", "---")]
    return "\n".join(changed)


def reasons() -> dict[str, str]:
    """Of survivors that are known: diff -> why nothing has to notice."""
    if not REASONS.exists():
        return {}
    table: dict[str, list[dict[str, Any]]] = tomllib.loads(REASONS.read_text(encoding="utf-8"))
    return {_flat(entry["diff"]): entry["why"] for entry in table.get("survivor", [])}


def _flat(diff: str) -> str:
    return " ".join(diff.split())


def _left(module: str, survivors: dict[str, str]) -> dict[str, str]:
    """Those that still survive; one that can't be placed by its diff alone counts as one that does."""
    known = reasons()
    return {
        name: diff
        for name, diff in survivors.items()
        if _flat(diff) in known or again.survives(module, name, diff) is not False
    }


def told(scores: Sequence[Score]) -> str:
    """The table of docs/testing.md."""
    known = reasons()
    rows = [
        "| module | mutants | tried | killed | survived, no change of behaviour | survived | of those that change it |"
    ]
    rows.append("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
    sums = [0, 0, 0, 0]
    for score in scores:
        excused = sum(_flat(diff) in known for diff in score.survivors.values())
        left = len(score.survivors) - excused
        values = [score.mutants, score.tried, score.killed, excused]
        sums = [a + b for a, b in zip(sums, values, strict=True)]
        rows.append(
            f"| {score.module} | {' | '.join(map(str, values))} | {left} | {_share(score.tried, excused, left)} |"
        )
    left = sums[1] - sums[2] - sums[3]
    rows.append(f"| together | {' | '.join(map(str, sums))} | {left} | {_share(sums[1], sums[3], left)} |")
    return "\n".join(rows)


def _share(tried: int, excused: int, left: int) -> str:
    counted = tried - excused
    return f"{100 * (counted - left) / counted:.0f} %" if counted else "none"


def main() -> int:
    """0: nine tenths of the mutants that change behaviour died; 1: fewer."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.mutation",
        description="Mutants of the modules that compute, and which of them their own tests notice.",
        epilog="Example: python -m tests.mutation --count 40 --out out/mutants.json runtime.optics.rpu",
    )
    parser.add_argument("modules", nargs="*", help=f"of {', '.join(MODULES)} (default: all)")
    parser.add_argument("--count", type=int, default=25, help="mutants a module")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--out", type=Path, default=Path("out/mutants.json"), help="what survived, with diffs")
    parser.add_argument("--again", action="store_true", help="only those of --out that survived, without mutmut")
    given = parser.parse_args()
    if unknown := [name for name in given.modules if name not in MODULES]:
        parser.error(f"{unknown[0]!r} is none of {', '.join(MODULES)}")
    before = json.loads(given.out.read_text(encoding="utf-8")) if given.out.exists() else {}
    found: dict[str, dict[str, Any]] = dict(before)
    for module in given.modules or MODULES:
        old = before.get(module)
        if given.again:
            if old:
                found[module] = old | {"survivors": _left(module, old["survivors"])}
        else:
            score = tried(module, count=given.count, seed=given.seed)
            found[module] = {"mutants": score.mutants, "tried": score.tried, "survivors": score.survivors}
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(found, indent=1), encoding="utf-8")
        if module in found:
            count, left = found[module]["tried"], len(found[module]["survivors"])
            print(f"{module}: {count - left} of {count} killed", flush=True)
    scores = [Score(name, **found[name]) for name in MODULES if name in found]
    print(told(scores))
    known = reasons()
    for score in scores:
        for name, diff in score.survivors.items():
            print(f"{name}: {known.get(_flat(diff), 'NOT EXPLAINED')}\n{diff}")
    changing = sum(s.tried - sum(_flat(d) in known for d in s.survivors.values()) for s in scores)
    return 0 if sum(s.killed for s in scores) >= 0.9 * changing else 1


if __name__ == "__main__":
    sys.exit(main())
