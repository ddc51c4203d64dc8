"""Runs the daemon with four clients that change it, losses of the sensor, and solvers that are stopped or killed.

    python -m tests.soak --seconds 1200
    python -m tests.soak --seconds 3600 --windows    # on an X server with OpenGL's solver; cables are pulled,
                                                     # and contexts lost

Fails where it ends otherwise than tracking, where a request gets no answer, and where memory, files or threads grow.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil

from runtime.config import Settings
from runtime.content.scenes import SCENES
from runtime.daemon import changes, supervise
from runtime.daemon.build import RunOptions
from runtime.daemon.client import ask
from runtime.errors import SensorLost
from runtime.frame import solver_process
from runtime.panels import drawing
from runtime.sensor.replay import ReplayDriver
from tests.panels.xserver import HEIGHT_PX, WIDTH_PX, XServer

LOST_EVERY_S = 30.0
HARM_EVERY_S = 40.0  # a cable, or the panels' contexts
KILLED_EVERY_S = 12.0  # on average
REFUSED = (
    "superseded by a newer change",
    "there is no next entry",
    "nobody's",
    "the display loop did not answer",
    "restarted",
)
HOW = (signal.SIGSEGV, signal.SIGKILL, signal.SIGABRT, signal.SIGSTOP)
SETTINGS: dict[str, Any] = {
    "stack": {"width_px": 64, "height_px": 36},
    "sensor": {"driver": "replay", "source": "demo", "loop": True},
    "model": {"name": "fast", "threads": 1, "backend": "cpu"},
    "output": {"kind": "offscreen"},
}
ON_WINDOWS: dict[str, Any] = {
    "stack": {"width_px": WIDTH_PX, "height_px": HEIGHT_PX},
    "model": {"name": "fast", "threads": 1, "backend": "gl"},
    "output": {"kind": "windows", "panels": [{"connector": f"DUMMY{index}"} for index in range(3)]},
}


class Soak:
    """Actions on a running daemon from outside, and their outcome."""

    def __init__(self, folder: Path, seconds: float) -> None:
        self.socket, self._end_s = folder / "s.sock", time.monotonic() + seconds
        self._lost_s, self.lost, self.failures, self.harms = 0.0, 0, 0, 0
        self._reset = False
        self.answers: Counter[str] = Counter()
        self.usage: list[tuple[int, int, int]] = []  # MiB, files, threads
        self.last: dict[str, Any] = {}

    def delayed(self, work: Callable[..., Any], share: float, most_s: float) -> Callable[..., Any]:
        def later(*given: Any, **named: Any) -> Any:
            if random.random() < share and time.monotonic() < self._end_s - 30.0:
                time.sleep(random.uniform(0.0, most_s))
            return work(*given, **named)

        return later

    def losing(self, read: Callable[..., Any]) -> Callable[..., Any]:
        def arrived(*given: Any, **named: Any) -> Any:
            if time.monotonic() - self._lost_s > LOST_EVERY_S:
                self._lost_s, self.lost = time.monotonic(), self.lost + 1
                raise SensorLost("soaked")
            return read(*given, **named)

        return arrived

    def kill(self) -> None:
        """Stop or kill a solver now and then."""
        while time.monotonic() < self._end_s - 40.0:
            time.sleep(random.expovariate(1 / KILLED_EVERY_S))
            processes = ask([self.socket], {"command": "status"}).get("processes", [])
            pids = [process["pid"] for process in processes if process["role"] == "solver" and process["pid"]]
            for pid in pids:
                self.failures += 1
                os.kill(pid, random.choice(HOW))

    def reset(self, status: Callable[[], str]) -> Callable[[], str]:
        def lost() -> str:
            self._reset, now = False, self._reset
            return "was reset (soaked)" if now else status()

        return lost

    def harm(self, server: XServer) -> None:
        """Alternately unplug a cable for a while and lose the GL contexts."""
        while time.monotonic() < self._end_s - 60.0:
            time.sleep(HARM_EVERY_S / 2)
            index = random.randrange(3)
            server.unplug(index)
            time.sleep(random.uniform(0.1, 3.0))
            server.plug(index)
            time.sleep(HARM_EVERY_S / 2)
            self._reset, self.harms = True, self.harms + 1

    def client(self, number: int) -> None:
        """Asks for anything, again and again."""
        choose = random.Random(number)
        scenes = [*SCENES, "nobody's"]
        while time.monotonic() < self._end_s - 30.0:
            scene = {"command": "scene", "value": choose.choice(scenes)}
            model = {"command": "model", "value": choose.choice(["fast", "balanced"])}
            place = {"command": "place", "value": {"scale": choose.uniform(0.5, 2.0)}}
            plain = [{"command": name} for name in ("next", "reload", "flat", "resume", "pause", "blackbox")]
            self._ask(choose.choice([scene, scene, scene, model, place, *plain]))
            time.sleep(choose.uniform(0.0, 1.5))

    def watch(self) -> None:
        """Looks now and then; at the end puts all back, looks again, and stops the daemon."""
        process = psutil.Process()
        while (left_s := self._end_s - time.monotonic()) > 20.0:
            time.sleep(min(10.0, max(0.1, left_s - 20.0)))
            gc.collect()
            now = process.memory_info().rss >> 20, process.num_fds(), threading.active_count()
            self.usage.append(now)
            print(f"{left_s:6.0f} s left: {now[0]} MiB, {now[1]} files, {now[2]} threads", flush=True)
        for request in ({"command": "scene", "value": "demo"}, {"command": "resume"}):
            self._ask(request)
        time.sleep(10.0)
        self.last = ask([self.socket], {"command": "status"})
        os.kill(os.getpid(), signal.SIGTERM)

    def _ask(self, request: dict[str, Any]) -> None:
        answer = ask([self.socket], request, timeout_s=90.0)
        self.answers[
            "ok" if answer["ok"] else next((why for why in REFUSED if why in answer["error"]), str(answer))
        ] += 1


def soak(seconds: float, *, growth_mib: int, windows: bool = False) -> None:
    """Raises AssertionError where something piles up, is lost or gets no answer."""
    with ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="ps-")))
        run = Soak(folder, seconds)
        cleanup.enter_context(patch.dict(os.environ, STATE_DIRECTORY=str(folder)))
        slow = run.delayed(changes.Changes.carry_on, 0.05, 0.3)
        cleanup.enter_context(patch.object(changes.Changes, "carry_on", slow))
        cleanup.enter_context(patch.object(ReplayDriver, "read_arrived", run.losing(ReplayDriver.read_arrived)))
        cleanup.enter_context(patch.object(solver_process, "LATE_S", 0.3))
        service = {"socket": str(run.socket), "blackbox_minutes": 0.2}
        settings = Settings.model_validate({**SETTINGS, **(ON_WINDOWS if windows else {}), "service": service})
        beside: list[threading.Thread] = [threading.Timer(8.0, run.client, (number,)) for number in range(4)]
        beside += [threading.Thread(target=run.watch), threading.Timer(10.0, run.kill)]
        if windows:
            server = XServer(folder)
            cleanup.callback(server.stop)
            cleanup.enter_context(patch.dict(os.environ, DISPLAY=server.name))
            cleanup.enter_context(patch.object(drawing, "_reset_status", run.reset(drawing._reset_status)))
            beside.append(threading.Timer(8.0, run.harm, (server,)))
        for thread in beside:
            thread.daemon = True
            thread.start()
        print(supervise.run_daemon(lambda: settings, RunOptions()))
    print(run.last["state"], run.lost, "losses", run.failures, "solvers killed", run.harms, "cables and resets")
    print(run.last["faults"], dict(run.answers))
    assert run.last["state"] in ("tracking", "holding", "flat") and set(run.answers) <= {"ok", *REFUSED}
    assert windows or run.last["dropped"] == 0
    assert run.last["turn_age_s"] < 1.0
    # Medians: memory rises while scenes and models are loaded for the first time, and by 40 MiB with every scene.
    quarter = max(1, len(run.usage) // 4)
    early, late = (np.median(part, axis=0) for part in (run.usage[quarter : 2 * quarter], run.usage[-quarter:]))
    print("MiB, files and threads in the second and the last quarter:", early.tolist(), late.tolist())
    assert (late - early <= (growth_mib, 4, 4)).all(), run.usage


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--windows", action="store_true")
    given = parser.parse_args()
    soak(given.seconds, growth_mib=64, windows=given.windows)
