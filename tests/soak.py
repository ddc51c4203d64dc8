"""A long run with faults: python tests/soak.py --frames 100000. Fails where memory, files or threads pile up.

The real loop with real content, network, panels and status socket, small; every so often the sensor is lost, a
panel is lost, the scene is frozen and thawed, and somebody asks for the status.
"""

from __future__ import annotations

import argparse
import gc
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import psutil

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from runtime.clock import MonotonicClock
from runtime.daemon.client import ask
from runtime.daemon.server import StatusServer
from runtime.errors import SensorLost
from tests.daemon.rig import TRACKING, BreakablePanels, Rig

SIZE = {"width_px": 64, "height_px": 36}
GROWTH_MAX = 0.01


@dataclass(frozen=True, slots=True)
class Usage:
    """What the process holds."""

    resident_bytes: int
    files: int
    threads: int

    @classmethod
    def now(cls) -> Usage:
        gc.collect()
        process = psutil.Process()
        return cls(process.memory_info().rss, process.num_fds(), process.num_threads())


@dataclass(frozen=True, slots=True)
class Soak:
    """What a soak came to."""

    frames: int
    presented: int
    faults: dict[str, int]
    seconds: float
    before: Usage
    after: Usage

    @property
    def growth(self) -> float:
        """Of resident memory, relative."""
        return self.after.resident_bytes / self.before.resident_bytes - 1.0

    def problems(self) -> list[str]:
        """Empty: passed."""
        found = []
        if self.growth > GROWTH_MAX:
            found.append(f"memory grew by {self.growth:.2%}")
        if self.after.files > self.before.files:
            found.append(f"{self.after.files - self.before.files} file descriptors leaked")
        if self.after.threads > self.before.threads:
            found.append(f"{self.after.threads - self.before.threads} threads leaked")
        return found


def soak(frames: int, *, warm: int, fault_every: int, report: bool = False) -> Soak:
    """Run it. `warm` turns come before the first look at memory."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Rig(stack=SIZE, loop={"rate_hz": 1000.0}, tracker={"hold_s": 1.0}) as rig,
    ):
        server = StatusServer(Path(folder) / "status.sock", group="root", clock=MonotonicClock())
        rig.loop._on_account = None  # the rig keeps every account: that alone would be a leak
        rig.loop.panels = panels = BreakablePanels(rig.loop.panels, keep=False)
        rig.turn_until(TRACKING)

        def cycle(turns: int) -> None:
            for number in range(turns):
                account = rig.loop.turn()
                server.publish(lambda account=account: {"state": str(account.state)})
                phase = number % fault_every
                if phase == fault_every // 4:
                    rig.plan.fault = SensorLost("soaked")
                elif phase == fault_every // 4 + 20:
                    rig.plan.fault = None
                elif phase == fault_every // 2:
                    panels.lost = "soaked"
                elif phase == fault_every // 2 + 5:
                    panels.lost = ""
                elif phase == 3 * fault_every // 4:
                    assert ask([server.path], {"command": "status"})["ok"]
            rig.plan.fault, panels.lost = None, ""
            rig.turn_until(TRACKING)

        cycle(warm)
        before, started = Usage.now(), time.perf_counter()
        counted = rig.loop.stats.frames, rig.loop.stats.presented
        done = 0
        while done < frames:
            part = min(max(frames // 10, fault_every), frames - done)
            cycle(part)
            done += part
            if report:
                now = Usage.now()
                print(
                    f"{done:8} frames  {now.resident_bytes / 2**20:7.1f} MiB  {now.files} files  "
                    f"{now.threads} threads  {time.perf_counter() - started:6.0f} s",
                    flush=True,
                )
        after = Usage.now()
        stats = rig.loop.stats
        server.close()
        return Soak(
            stats.frames - counted[0], stats.presented - counted[1], dict(stats.faults),
            time.perf_counter() - started, before, after,
        )  # fmt: skip


def main() -> int:
    """The command line; exit 1 where something piled up."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100_000)
    result = soak(parser.parse_args().frames, warm=2000, fault_every=500, report=True)
    print(f"{result.frames} frames, {result.presented} presented, faults {result.faults}, {result.seconds:.0f} s")
    print(f"memory {result.before.resident_bytes / 2**20:.1f} MiB, growth {result.growth:+.3%}")
    for problem in result.problems():
        print(f"FAILED: {problem}")
    return bool(result.problems())


if __name__ == "__main__":
    sys.exit(main())
