"""An operator's hour, faster: 20 scenes, models, reloads, lost parts, hung solvers, a busy processor.

    python -m tests.soak --rounds 200

Fails where status, page or black box say anything else than what is so, where a refresh is lost, and where memory,
files or threads grow.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from runtime.blackbox.recorder import Recorder
from runtime.clock import NS_PER_S
from runtime.content.presets import preset_names
from runtime.content.scenes import SCENES as BUILT_IN
from runtime.daemon.client import LOOKED_UP_AGAIN_S, Daemon, ask
from runtime.errors import SensorLost
from tests.daemon.rig import TRACKING
from tests.daemon.test_changes import Served
from tests.waiting import eventually

SETTINGS: dict[str, dict[str, Any]] = {
    "stack": {"width_px": 64, "height_px": 36},
    "loop": {"rate_hz": 200.0},
    "tracker": {"hold_s": 0.5},
}
SCENES, MODELS = (*BUILT_IN, *preset_names())[:20], ("balanced", "fast")
KEPT_MIN = 0.05  # by the black box, so that it is full before memory is looked at
COUNTED = ("state", "reason", "scene", "model", "paused", "frames", "presented", "dropped", "faults")


@dataclass(frozen=True, slots=True)
class Usage:
    """What the process holds."""

    resident_mib: float
    files: int
    threads: int

    @classmethod
    def now(cls) -> Usage:
        gc.collect()
        process = psutil.Process()
        return cls(process.memory_info().rss / 2**20, process.num_fds(), process.num_threads())


class Soak:
    """A run with its socket, page and black box; `round` does all that an operator and the world do to it."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.recorder = Recorder(folder / "boxes", minutes=KEPT_MIN)
        self.served = Served(folder, recorder=self.recorder, late_s=60.0, abandon_s=600.0, **SETTINGS)
        self.page = Daemon((self.served.server.path,))
        self.without_a_panel = 0

    def __enter__(self) -> Soak:
        self.served.__enter__()
        self.served.run.observer._on_account = None  # the rig keeps every account: that alone would be a leak
        return self

    def __exit__(self, *exception: object) -> None:
        self.recorder.close()
        self.served.__exit__(*exception)

    def round(self, number: int) -> None:
        served, rig = self.served, self.served.rig
        scene, model = SCENES[number % len(SCENES)], MODELS[number % len(MODELS)]
        assert served.asked("scene", scene)["ok"] and served.asked("model", model)["ok"]
        refused = served.asked("scene", "nobody's")
        assert served.asked("reload")["ok"] and not refused["ok"]
        rig.refresh_until_solved()
        self._told_is_so(TRACKING)
        assert served.asked("pause")["paused"] and not served.asked("resume")["paused"]
        rig.plan.fault = SensorLost("soaked")
        rig.refresh_until("degraded: sensor")
        self._told_is_so("degraded: sensor")
        rig.plan.fault = None
        rig.refresh_until(TRACKING)
        panels = rig.break_panels(keep=False)
        panels.lost = "soaked"
        self.without_a_panel += len(rig.refreshes(5))
        self._told_is_so("degraded: panel", refresh=False)
        rig.presenter.panels = panels._panels
        self._hang_the_solver()
        with busy_processor():
            rig.refreshes(200)
            self._told_is_so(None)
        rig.refresh_until(TRACKING)
        self._told_is_so(TRACKING)

    def _hang_the_solver(self) -> None:
        """It is left behind and made anew; what it held is released once it returns."""
        rig, solver = self.served.rig, self.served.rig.presenter.solver
        predictor, gate, begun = rig.break_predictor(), threading.Event(), threading.Event()
        predictor.answer = lambda job: (begun.set(), gate.wait(60.0), predictor.well(job))[-1]
        rig.refresh_until(begun.is_set)
        restarts, patience = solver.restarts, (solver._late_ns, solver._abandon_ns)
        solver._late_ns = solver._abandon_ns = 1
        rig.refreshes(1)
        solver._late_ns, solver._abandon_ns = patience
        rig.refresh_until_solved()
        gate.set()
        assert solver.restarts == restarts + 1
        assert eventually(lambda: not any(hung.thread.is_alive() for hung in solver._hung))

    def _told_is_so(self, state: str | None, *, refresh: bool = True) -> None:
        """Status, page and pictures against the run; no refresh goes on meanwhile."""
        run = self.served.run
        presenter, stats = run.presenter, run.presenter.stats
        if refresh:
            presenter.refresh()
        status = self.served.status()
        now = presenter.run_cell.state
        assert state in (None, status["state"]) and status["state"] == presenter.machine.name
        assert (status["frames"], status["dropped"]) == (stats.frames, stats.dropped)
        assert status["dropped"] == self.without_a_panel and status["presented"] == stats.frames - stats.dropped
        assert status["scene"] == now.settings.content.scene and status["model"] == now.predictor.name
        time.sleep(LOOKED_UP_AGAIN_S["status"])
        page = self.page.look_up("status")
        assert {name: page[name] for name in COUNTED} == {name: status[name] for name in COUNTED}
        shown = ask([self.served.server.path], {"command": "pictures"})
        assert shown["frame"] == presenter.last.account.frame and len(shown["jpegs"]) >= presenter.stack.count

    def check_black_box(self) -> None:
        """What it kept: every refresh of its time, up to the last, and the states that they were in."""
        from mcap.reader import make_reader

        rig, full_s = self.served.rig, 60 * KEPT_MIN
        # A look at a busy run's pictures can outlast what the box keeps, and no refresh goes on meanwhile: fill it.
        began_ns = rig.presenter.clock.now_ns()
        rig.refresh_until(lambda: rig.presenter.clock.now_ns() - began_ns > full_s * NS_PER_S)
        answer = self.served.asked("blackbox")
        last = rig.presenter.last.account.frame
        with Path(answer["file"]).open("rb") as file:
            told = [json.loads(message.data) for _, _, message in make_reader(file).iter_messages(["/refresh"])]
        frames = [refresh["frame"] for refresh in told]
        assert frames == list(range(frames[0], frames[-1] + 1)) and frames[-1] <= last
        kept_s = (told[-1]["present_ns"] - told[0]["present_ns"]) / NS_PER_S
        assert 0.9 * full_s < kept_s <= full_s + 0.1
        assert {refresh["state"] for refresh in told} <= {"tracking", "holding", "flat", "degraded"}


@contextmanager
def busy_processor() -> Iterator[None]:
    """Every core has something else to do."""
    spinning = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in spinning:
            process.kill()
            process.wait()


def soak(rounds: int, *, warm: int, growth_max: float) -> None:
    """Raises AssertionError where something piles up, is lost or told wrongly. warm: rounds before memory counts."""
    with tempfile.TemporaryDirectory(prefix="ps-") as folder, Soak(Path(folder)) as run:
        for number in range(warm):
            run.round(number)
        before, began_s = Usage.now(), time.perf_counter()
        print(f"warm: {before}")
        for number in range(warm, warm + rounds):
            run.round(number)
            kept_mib, seconds = run.recorder.describe()["kept_mib"], time.perf_counter() - began_s
            print(f"{number + 1 - warm:5} rounds {seconds:6.0f} s, {kept_mib} MiB kept, {Usage.now()}", flush=True)
        run.check_black_box()
        # What a change left to be released in the background may be on its way; a leak stays.
        eventually(lambda: (now := Usage.now()).threads <= before.threads and now.files <= before.files)
        after = Usage.now()
    assert after.resident_mib <= before.resident_mib * (1.0 + growth_max), (before, after)
    assert after.files <= before.files and after.threads <= before.threads, (before, after)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=200)
    soak(parser.parse_args().rounds, warm=len(SCENES), growth_max=0.01)
