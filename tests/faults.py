"""Measures what each fault of a solver or a sensor costs while a viewer walks in front of a display.

    python -m tests.faults                       # a table, ten tries of each fault
    python -m tests.faults --only SIGSEGV --tries 100

Fails where a fault costs more than one refresh, or where memory or files grow.
"""

from __future__ import annotations

import argparse
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil

from runtime.clock import NS_PER_MS
from runtime.config import Settings
from runtime.daemon.build import Run, RunOptions, build_run
from runtime.frame.messages import Answer, ChangeSettings, Done
from runtime.records import RefreshAccount
from runtime.support.untrusted_input import LIMITS, MIB

LOAD_S = 10.0  # instead of minutes, so that a scene that hangs while it loads is tried often
MEMORY_BYTES = 600 * MIB  # of the solver, so that exceeding it does not burden this machine
WITHIN_S = 90.0
BEFORE_S, AFTER_S = 1.0, 1.0  # shown before each fault and after the recovery
SETTLED_S = 10.0  # before memory is read


@dataclass(frozen=True)
class Fault:
    """A fault and how it is brought about."""

    what: str
    role: str  # the process that has it
    bring: Callable[[Display], None]


@dataclass
class Costs:
    """What the tries of one fault have cost."""

    missed: list[int] = field(default_factory=list)  # refreshes
    gap_ms: list[float] = field(default_factory=list)  # longest time without a new solution or, of a sensor, sample
    reasons: list[str] = field(default_factory=list)  # last reason in the state, without its time
    shown: set[str] = field(default_factory=set)


class Display:
    """A run on the real clock, with a scene and a sensor that do what a file says."""

    def __init__(self, run: Run, folder: Path, accounts: list[RefreshAccount]) -> None:
        self.run, self.accounts = run, accounts
        self._scene_file, self._sensor_file = folder / "scene", folder / "sensor"
        self._settings = run.presenter.settings
        self._answers: list[Answer] = []

    def signal(self, role: str, number: int) -> None:
        (pid,) = [process["pid"] for process in self.run.processes() if process["role"] == role]
        os.kill(pid, number)

    def scene_does(self, deed: str) -> None:
        self._scene_file.write_text(deed)

    def sensor_does(self, deed: str) -> None:
        self._sensor_file.write_text(deed)

    def load(self, deed: str) -> None:
        """Ask for a scene that does the deed while it is loaded."""
        self.scene_does(deed)
        content = self._settings.content.model_copy(update={"options": {"file": str(self._scene_file), "making": True}})
        change = ChangeSettings(self._settings.model_copy(update={"content": content}))
        self.run.presenter.solver.send(change, self._answers.append)

    def refresh_until(self, wanted: Callable[[], Any]) -> None:
        ends_s = time.monotonic() + WITHIN_S
        while not wanted():
            self.run.presenter.refresh()
            assert time.monotonic() < ends_s, self.run.presenter.machine.reason

    def refresh_for(self, seconds: float) -> None:
        """Refresh for this long, once at least."""
        ends_s = time.monotonic() + seconds
        self.run.presenter.refresh()
        self.refresh_until(lambda: time.monotonic() > ends_s)

    def is_well(self) -> bool:
        last = self.accounts[-1]
        return not self.run.presenter.missing and last.inference == "ran" and last.eyes_label == "predicted"

    def try_out(self, fault: Fault, costs: Costs) -> None:
        presenter = self.run.presenter
        self.refresh_until(self.is_well)
        self.refresh_for(BEFORE_S)
        first, faults, asked = len(self.accounts), sum(presenter.stats.faults.values()), len(self._answers)
        loads = fault.what.startswith("load")
        fault.bring(self)
        self.refresh_until(
            lambda: (
                any(isinstance(answer, Done) for answer in self._answers[asked:])
                if loads
                else sum(presenter.stats.faults.values()) > faults
            )
        )
        reason = presenter.machine.reason
        while not self.is_well():
            reason = presenter.machine.reason if presenter.missing else reason
            self.refresh_for(0.0)
        costs.reasons.append(reason.partition(" (for ")[0])
        self.refresh_for(AFTER_S)
        self._count(self.accounts[first - 1 :], fault, costs)
        del self.accounts[:-1]

    def _count(self, accounts: list[RefreshAccount], fault: Fault, costs: Costs) -> None:
        period_ms = self.run.presenter.pacer.period_ns / NS_PER_MS
        intervals_ms = np.diff([account.present_ns for account in accounts]) / NS_PER_MS
        dropped = sum(not account.presented for account in accounts)
        costs.missed.append(dropped + int(np.maximum(np.rint(intervals_ms / period_ms) - 1, 0).sum()))
        news = [account.solution if fault.role == "solver" else account.capture_ns for account in accounts]
        times_ns = [a.present_ns for n, a in enumerate(accounts) if n == 0 or news[n] != news[n - 1]]
        costs.gap_ms.append(float(np.diff(times_ns).max() / NS_PER_MS))
        # With a solver's fault, the last solution must go on following the head. With a sensor's, eyes are held.
        moved = len({account.eyes_m.tobytes() for account in accounts if account.eyes_m is not None}) > 10
        solved = all(account.solution is not None for account in accounts)
        costs.shown.add(("last solution" if solved else "flat at times") + (", follows the head" if moved else ""))


def _all_faults() -> Iterator[Fault]:
    for role in ("solver", "sensor"):
        for number in (signal.SIGSEGV, signal.SIGKILL, signal.SIGSTOP):
            yield Fault(number.name, role, lambda display, r=role, n=number: display.signal(r, n))  # type: ignore[misc]
    for what, deed in (
        ("loop in Python", "loop"), ("sleep in C", "sleep"), ("sys.exit", "exit"), ("memory", "grow"),
        ("context", "lose"),
    ):  # fmt: skip
        yield Fault(what, "solver", lambda display, d=deed: display.scene_does(d))  # type: ignore[misc]
    yield Fault("load hangs", "solver", lambda display: display.load("sleep"))
    yield Fault("load crashes", "solver", lambda display: display.load("crash"))
    for what, deed in (("loop in Python", "loop"), ("sleep in C", "sleep")):
        yield Fault(what, "sensor", lambda display, d=deed: display.sensor_does(d))  # type: ignore[misc]


FAULTS = tuple(_all_faults())


@contextmanager
def walking(folder: Path, *, size_px: tuple[int, int]) -> Iterator[Display]:
    """A display in front of which a viewer walks."""
    settings = Settings.model_validate({
        "stack": dict(zip(("width_px", "height_px"), size_px, strict=True)),
        "sensor": {
            "driver": "tests.sensor.harmful:Harmful", "timeout_s": 0.5,
            "options": {"file": str(folder / "sensor"), "walking": True},
        },
        "content": {"scene": "tests.daemon.scenes:Harmful", "options": {"file": str(folder / "scene")}},
        "model": {"name": "fast", "backend": "cpu"},
        "output": {"kind": "offscreen"},
    })  # fmt: skip
    accounts: list[RefreshAccount] = []
    with ExitStack() as cleanup:
        cleanup.enter_context(patch.dict(os.environ, STATE_DIRECTORY=str(folder)))
        cleanup.enter_context(patch("runtime.daemon.build.SOLVER_MEMORY_BYTES", MEMORY_BYTES))
        cleanup.enter_context(patch.object(LIMITS, "load_s", LOAD_S))
        run = build_run(settings, RunOptions(), cleanup, on_account=accounts.append)
        display = Display(run, folder, accounts)
        display.refresh_for(5.0)
        yield display


def _used() -> tuple[float, int]:
    """Memory of this process and those that it has started, in MiB (PSS), and this process's open files."""
    me = psutil.Process()
    pss = sum(process.memory_full_info().pss for process in (me, *me.children(recursive=True)))
    return pss / MIB, me.num_fds()


def tried(faults: Sequence[Fault], *, size_px: tuple[int, int], tries: int = 1) -> Iterator[tuple[Fault, Costs]]:
    """Yield what each fault costs. Raises AssertionError if memory or files grow."""
    with tempfile.TemporaryDirectory(prefix="ps-") as folder, walking(Path(folder), size_px=size_px) as display:
        # The first recovery grows caches of this process, for instance the allocator's: it is not a leak.
        display.try_out(faults[0], Costs())
        display.refresh_for(SETTLED_S)
        before = _used()
        for fault in faults:
            costs = Costs()
            for _ in range(tries):
                display.try_out(fault, costs)
            yield fault, costs
        display.refresh_for(SETTLED_S)
        after = _used()
    print(f"memory {before[0]:.0f} -> {after[0]:.0f} MiB, files {before[1]} -> {after[1]}")
    assert after[1] <= before[1] + 4 and after[0] <= before[0] + 64


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tries", type=int, default=10)
    parser.add_argument("--only", default="", help="part of a fault's name")
    parser.add_argument("--size", type=int, nargs=2, default=(1920, 1080), metavar=("WIDTH", "HEIGHT"))
    given = parser.parse_args()
    chosen = [fault for fault in FAULTS if given.only in f"{fault.role}: {fault.what}"]
    print("| fault | tries | refreshes missed, median and worst | longest without news, s | shown | state |")
    print("|---|---|---|---|---|---|", flush=True)
    failed = []
    for fault, costs in tried(chosen, size_px=tuple(given.size), tries=given.tries):
        name, shown = f"{fault.role}: {fault.what}", "; ".join(sorted(costs.shown))
        missed = f"{np.median(costs.missed):.0f}, {max(costs.missed)}"
        gaps = f"{np.median(costs.gap_ms) / 1e3:.2f}, {max(costs.gap_ms) / 1e3:.2f}"
        print(f"| {name} | {given.tries} | {missed} | {gaps} | {shown} | {costs.reasons[0]} |", flush=True)
        failed += [name] if max(costs.missed) > 1 else []
    if failed:
        raise SystemExit(f"more than one refresh was missed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
