"""A run of the daemon with a live stream that stalls and hangs up: how old pictures are at the light, and what is told.

    python -m tests.content.live_run --minutes 5 --out out/live

The real way through: MPEG-TS over TCP, the recorded sensor, `phasestack run --headless --record`. What each eye sees is
in the recording; the number in it tells which picture it is. In the middle of the run the camera stalls, after three
quarters it hangs up. Leaves `live.json` and `live.png`: what the left eye saw before, in and after the stall.
"""

from __future__ import annotations

import argparse
import base64
import json
import os
import subprocess
import sys
import time
from bisect import bisect
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil

from runtime.clock import NS_PER_MS, NS_PER_S
from runtime.daemon.client import NotRunning, ask
from tests.blackbox.conftest import read
from tests.content.live_camera import LiveCamera, live_camera, number_in
from tests.page.rig import ROOT, short_folder
from tests.waiting import eventually

CONFIGURATION = """
[stack]
width_px = {width}
height_px = {height}
[sensor]
driver = "replay"
source = "demo"
loop = true
[content]
scene = "{url}"
layout = "side-by-side"
[model]
name = "fast"
threads = 1
[loop]
rate_hz = 60.0
solver_late_s = 30.0
[service]
socket = "s.sock"
blackbox_minutes = 0
"""
LOOK_S = 0.2
BACK_NS = NS_PER_S  # of who comes back, until the solution alone is shown
NEWER = 4  # pictures, that multiplexer, parser and decoder may hold: they know a picture's end by the next one
MIB = 1 << 20
SEEN = ("before the stall", "in the stall", "after the stall", "after it hung up")


@dataclass
class LiveRun:
    """What a run came to. Ages are from the camera's handing a picture to the network to its light."""

    seconds: float
    connections: int
    pictures: int = 0  # that were seen, and had a number
    unreadable: int = 0
    backwards: int = 0  # pictures that were older than the one before
    age_ms: dict[str, dict[str, float]] = field(default_factory=dict)  # by part of the run: p50, p95
    last_sent: int = 0  # before the stall
    in_stall: list[int] = field(default_factory=list)  # numbers that were seen in it, once it had settled
    told_after_s: float | None = None  # that nothing new comes
    problems: list[str] = field(default_factory=list)  # in the status, in their order
    states_in_stall: list[str] = field(default_factory=list)
    back_after_s: float | None = None  # the first new picture's light, after the stall's end
    back_after_hang_up_s: float | None = None
    refreshes: int = 0
    missed: int = 0
    resident_mib: list[float] = field(default_factory=list)  # over the run, ten times

    def failures(self) -> list[str]:
        """Empty: passed. On a busy machine ages are long: they are compared within the run."""
        found = []
        if self.backwards:
            found.append(f"{self.backwards} pictures were older than the one before them")
        if not self.in_stall or set(self.in_stall) != {self.in_stall[0]}:
            found.append(f"in the stall the pictures {sorted(set(self.in_stall))} were seen, not one")
        elif not 0 <= self.last_sent - self.in_stall[0] <= NEWER:
            found.append(f"in the stall picture {self.in_stall[0]} stayed, not the last one, {self.last_sent}")
        if not any("no new picture for" in problem for problem in self.problems):
            found.append("nobody told that nothing new came")
        if any(state.startswith("degraded") for state in self.states_in_stall):
            found.append(f"states in the stall: {self.states_in_stall}")
        if self.back_after_s is None or self.back_after_hang_up_s is None:
            found.append("it did not come back")
        before, after = (self.age_ms.get(name, {}).get("p50") for name in (SEEN[0], SEEN[2]))
        if before is None or after is None or after > 2 * before + 200:
            found.append(f"pictures were {before} ms old before the stall, {after} after it")
        half = len(self.resident_mib) // 2
        if half and self.resident_mib[-1] > 1.05 * self.resident_mib[half]:
            found.append(f"memory grew: {self.resident_mib}")
        return found


def live_run(*, seconds: float, width: int = 480, height: int = 270, picture_file: Path | None = None) -> LiveRun:
    """Run it for so long; the stall takes a tenth of it, and ten seconds at least."""
    stall_s = max(10.0, seconds / 10)
    begin_stall_s, hang_up_s = seconds / 2 - stall_s / 2, 3 * seconds / 4
    with short_folder() as folder, live_camera() as camera:
        configured = CONFIGURATION.format(width=width, height=height, url=camera.url)
        (folder / "d.toml").write_text(configured)
        command = [sys.executable, "-m", "runtime.cli", "run", "--config", str(folder / "d.toml"), "--headless"]
        process = subprocess.Popen(
            [*command, "--record", str(folder / "run.mcap"), "--json"],
            cwd=ROOT,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        try:
            looks = _watched(process, folder / "s.sock", camera, seconds, begin_stall_s, stall_s, hang_up_s)
        finally:
            process.terminate()
            output = process.communicate(timeout=60)[0]
        summary = json.loads(output.strip().splitlines()[-1])
        return _told(looks, camera, read(folder / "run.mcap"), summary, picture_file)


@dataclass
class _Looks:
    """What was seen from outside; times are ns since 1970."""

    begin_ns: int = 0
    stalled_ns: int = 0
    on_ns: int = 0
    hung_up_ns: int = 0
    end_ns: int = 0
    last_sent: int = 0
    told_ns: int = 0
    problems: list[str] = field(default_factory=list)
    resident: list[float] = field(default_factory=list)


def _watched(
    process: Any, socket: Path, camera: LiveCamera, seconds: float, stall_s: float, for_s: float, hang_up_s: float
) -> _Looks:
    looks = _Looks()

    def status() -> dict[str, Any]:
        try:
            return ask([socket], {"command": "status"})
        except NotRunning:
            return {}

    if not eventually(lambda: status().get("inferences", 0) > 3, within_s=180.0):
        raise RuntimeError("the daemon shows nothing")
    daemon = psutil.Process(process.pid)
    begin_s = time.monotonic()
    looks.begin_ns = time.time_ns()
    while (now_s := time.monotonic() - begin_s) < seconds:
        if not looks.stalled_ns and now_s >= stall_s:
            camera.stalls.set()
            time.sleep(0.1)  # a picture that was being made is sent
            looks.stalled_ns, looks.last_sent = time.time_ns(), max(camera.sent_ns)
        if looks.stalled_ns and not looks.on_ns and now_s >= stall_s + for_s:
            camera.stalls.clear()
            looks.on_ns = time.time_ns()
        if not looks.hung_up_ns and now_s >= hang_up_s:
            camera.hang_up.set()
            looks.hung_up_ns = time.time_ns()
        problem = status().get("content_problem", "")
        plain = problem.partition(" for ")[0] if "no new picture" in problem else problem
        if plain and not any(known.startswith(plain) for known in looks.problems):
            looks.problems.append(problem)
        if "no new picture" in problem and looks.stalled_ns and not looks.told_ns:
            looks.told_ns = time.time_ns()
        if len(looks.resident) < 10 * now_s / seconds:
            looks.resident.append(round(daemon.memory_info().rss / MIB, 1))
        time.sleep(LOOK_S)
    looks.end_ns = time.time_ns()
    looks.resident.append(round(daemon.memory_info().rss / MIB, 1))
    return looks


def _told(
    looks: _Looks, camera: LiveCamera, messages: list[Any], summary: dict[str, Any], file: Path | None
) -> LiveRun:
    """The recording against what the camera sent."""
    told = LiveRun(
        round((looks.end_ns - looks.begin_ns) / NS_PER_S, 1),
        camera.connections,
        last_sent=looks.last_sent,
        problems=looks.problems,
        resident_mib=looks.resident,
        refreshes=summary["presented"],
        missed=summary["missed_blanks"],
        told_after_s=round((looks.told_ns - looks.stalled_ns) / NS_PER_S, 1) if looks.told_ns else None,
    )
    settled_ns = (looks.stalled_ns + looks.on_ns) // 2
    parts = dict(
        zip(
            SEEN,
            (
                (looks.begin_ns, looks.stalled_ns),
                (settled_ns, looks.on_ns),
                (looks.on_ns + 2 * NS_PER_S, looks.hung_up_ns),
                (looks.hung_up_ns + 4 * NS_PER_S, looks.end_ns),
            ),
            strict=True,
        )
    )
    # While who looked away comes back, the flat picture, which may be of another moment, is faded out.
    away_ns = [m.log_ns for m in messages if m.topic == "/refresh" and m.value["state"] != "tracking"]
    ages: dict[str, list[float]] = {name: [] for name in SEEN}
    shown: dict[str, np.ndarray] = {}
    newest, before = -1, -1
    for message in messages:
        if message.topic == "/state" and looks.stalled_ns <= message.log_ns < looks.on_ns:
            told.states_in_stall.append(message.value["state"])
        if message.topic != "/picture/seen-left" or not looks.begin_ns <= message.log_ns < looks.end_ns:
            continue
        coded = np.frombuffer(base64.b64decode(message.value["data"]), np.uint8)
        picture = cv2.imdecode(coded, cv2.IMREAD_COLOR)
        number = number_in(picture)
        if number is None or number not in camera.sent_ns:
            told.unreadable += 1
            continue
        told.pictures += 1
        place = bisect(away_ns, message.log_ns)
        if place == 0 or message.log_ns - away_ns[place - 1] > BACK_NS:
            told.backwards += place == before and number < newest
            newest, before = number, place
        for name, (begin_ns, end_ns) in parts.items():
            if begin_ns <= message.log_ns < end_ns:
                ages[name].append((message.log_ns - camera.sent_ns[number]) / NS_PER_MS)
                shown[name] = picture
                if name == SEEN[1]:
                    told.in_stall.append(number)
        if told.back_after_s is None and camera.sent_ns[number] >= looks.on_ns:
            told.back_after_s = round((message.log_ns - looks.on_ns) / NS_PER_S, 2)
        if told.back_after_hang_up_s is None and camera.sent_ns[number] > looks.hung_up_ns + NS_PER_S // 10:
            told.back_after_hang_up_s = round((message.log_ns - looks.hung_up_ns) / NS_PER_S, 2)
    for name, values in ages.items():
        if values and name != SEEN[1]:  # in it they only grow older
            told.age_ms[name] = {f"p{p}": round(float(np.percentile(values, p)), 1) for p in (50, 95)}
    if file is not None and shown:
        _sheet(file, shown)
    return told


def _sheet(path: Path, shown: dict[str, np.ndarray]) -> None:
    """What was seen, each with its name."""
    rows = []
    for name, picture in shown.items():
        large = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        bar = np.full((28, large.shape[1], 3), 255, np.uint8)
        text = f"{name}: picture {number_in(picture)}"
        cv2.putText(bar, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (0, 0, 0), 1, cv2.LINE_AA)
        rows.append(np.vstack([bar, large]))
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows))


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=5.0)
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--out", type=Path, default=Path("out/live"), help="folder")
    given = parser.parse_args()
    told = live_run(
        seconds=60 * given.minutes, width=given.size[0], height=given.size[1], picture_file=given.out / "live.png"
    )
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "live.json").write_text(json.dumps(asdict(told), indent=1) + "\n")
    for name, value in asdict(told).items():
        print(f"{name:22} {value if name != 'in_stall' else sorted(set(value))}")
    for failure in told.failures():
        print(f"FAILED: {failure}")
    raise SystemExit(1 if told.failures() else 0)


if __name__ == "__main__":
    main()
