"""What a page that is open costs the daemon: refreshes missed and processor time, with it and without, in turn.

    nice -n 10 python -m tests.page.load --minutes 20 --out page-load.json

One daemon, 60 refreshes a second without a screen, and one page; spans with a client that asks for all that an open
page asks for, as often, and spans with none, in turn, so that what slows one slows both. On a quiet machine: a figure
of one that does other things says little (the last line tells how many cores others took). It ends with 1 where the
page costs more than it may: `MORE_MISSED`, `MORE_CORES`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from runtime.daemon.client import NotRunning, ask
from runtime.report.benchmark import OthersLoad
from tests.page.rig import CONFIGURATION, ROOT, Page, page_of, short_folder
from tests.waiting import eventually

ASKED_MS = {"status": 500, "pictures": 400, "log": 1000, "about": 5000}  # as page.js has it
SETTLE_S = 3.0  # of a span, that is not counted
MORE_MISSED = 0  # refreshes, that an open page may cost
MORE_CORES = 0.02  # of the daemon's processor time
QUIET_CORES = 0.2  # that others may take where the figures are to be believed


class OpenPage:
    """Asks for what an open page asks for, while it is open."""

    def __init__(self, page: Page) -> None:
        self._page, self._open, self._ended = page, threading.Event(), threading.Event()
        self.answers = 0
        for name, every_ms in ASKED_MS.items():
            threading.Thread(target=self._ask, args=(name, every_ms / 1000), daemon=True).start()

    def show(self, wanted: bool) -> None:
        self._open.set() if wanted else self._open.clear()

    def close(self) -> None:
        self._ended.set()
        self._open.set()

    def _ask(self, name: str, every_s: float) -> None:
        while not self._ended.is_set():
            if not self._open.wait(0.2):
                continue
            begin_s = time.monotonic()
            self.answers += bool(self._page.look_up(name).get("ok"))
            time.sleep(max(0.0, every_s - (time.monotonic() - begin_s)))


def span(daemon: psutil.Process, status: Callable[[], dict[str, Any]], seconds: float) -> dict[str, float]:
    """One span's missed refreshes and the daemon's processor time."""
    time.sleep(SETTLE_S)
    before, busy, begin_s = status(), sum(daemon.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    after, took_s = status(), time.monotonic() - begin_s
    return {
        "seconds": took_s,
        "refreshes": after["presented"] - before["presented"],
        "missed": after["missed_blanks"] - before["missed_blanks"],
        "cores": (sum(daemon.cpu_times()[:2]) - busy) / took_s,
    }


def measured(*, minutes: float, span_s: float, width: int, height: int) -> dict[str, Any]:
    """Spans without and with the page open, in turn, and what they come to."""
    with short_folder() as folder, page_of(folder / "s.sock", folder) as page:
        (folder / "d.toml").write_text(CONFIGURATION.format(width=width, height=height))
        command = [sys.executable, "-m", "runtime.cli", "run", "--config", str(folder / "d.toml"), "--headless"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        process = subprocess.Popen(
            [*command, "--json"], cwd=ROOT, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

        def status() -> dict[str, Any]:
            return ask([folder / "s.sock"], {"command": "status"})

        def presents() -> bool:
            try:
                return status().get("presented", 0) > 0
            except NotRunning:
                return False

        opened = OpenPage(page)
        try:
            if not eventually(presents, within_s=120.0):
                raise SystemExit("load: the daemon does not start")
            daemon, others = psutil.Process(process.pid), OthersLoad()
            begin_s, children_s = time.monotonic(), _children_s()
            spans: dict[str, list[dict[str, float]]] = {"closed": [], "open": []}
            for number in range(max(1, round(minutes * 60 / span_s / 2))):
                for name in ("closed", "open") if number % 2 == 0 else ("open", "closed"):
                    opened.show(name == "open")
                    spans[name].append(span(daemon, status, span_s))
                    told = spans[name][-1]
                    print(f"{name:6} {told['missed']:5.0f} missed {told['cores']:.3f} cores", file=sys.stderr)
            result = {name: _together(values) for name, values in spans.items()}
            # They have not ended: `others` has them.
            children_cores = (_children_s() - children_s) / (time.monotonic() - begin_s)
            return {
                **result,
                "more_missed": result["open"]["missed"] - result["closed"]["missed"],
                "more_cores": round(result["open"]["cores"] - result["closed"]["cores"], 4),
                "page_answers": opened.answers,
                "others_cores": round(max(0.0, (others.cores() or 0.0) - children_cores), 3),
                "spans": spans,
            }
        finally:
            opened.close()
            process.terminate()
            process.wait(timeout=30)


def _children_s() -> float:
    """Processor time of the daemon and of the page."""
    return sum(sum(child.cpu_times()[:2]) for child in psutil.Process().children(recursive=True))


def _together(spans: list[dict[str, float]]) -> dict[str, float]:
    total = {name: sum(span[name] for span in spans) for name in ("seconds", "refreshes", "missed")}
    cores = sum(span["cores"] * span["seconds"] for span in spans) / total["seconds"]
    return {**total, "cores": round(cores, 4), "missed_per_minute": round(60 * total["missed"] / total["seconds"], 2)}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="altogether, half of it with the page open")
    parser.add_argument("--span-s", type=float, default=30.0, help="of one span")
    parser.add_argument("--size", type=int, nargs=2, default=(480, 270), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--out", type=Path, help="JSON file of all figures")
    given = parser.parse_args()
    result = measured(minutes=given.minutes, span_s=given.span_s, width=given.size[0], height=given.size[1])
    if given.out is not None:
        given.out.write_text(json.dumps(result, indent=1) + "\n")
    for name in ("closed", "open"):
        told = result[name]
        counted = f"{told['refreshes']:7.0f} refreshes  {told['missed']:5.0f} missed"
        print(f"page {name:6} {told['seconds']:6.0f} s  {counted}  {told['cores']:.3f} cores")
    missed_held, cores_held = result["more_missed"] <= MORE_MISSED, result["more_cores"] <= MORE_CORES
    held = {True: "held", False: "NOT HELD"}
    print(f"open less closed: {result['more_missed']:+.0f} missed, at most {MORE_MISSED:+d}: {held[missed_held]}")
    more, most = 100 * result["more_cores"], 100 * MORE_CORES
    print(f"open less closed: {more:+.2f}% of a core in the daemon, at most {most:g}%: {held[cores_held]}")
    others = result["others_cores"]
    busy = ": too many to believe what was missed" if others > QUIET_CORES else ""
    print(f"others took {others:.2f} cores meanwhile{busy}")
    raise SystemExit(0 if missed_held and cores_held else 1)


if __name__ == "__main__":
    main()
