"""From capture to light: the daemon itself on the built-in recording, in real time, with the plan on and off."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.errors import FatalError
from runtime.records import F64
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png

STAGES = ("sensor", "track", "render", "prepare", "inference", "finish", "present")
MAIN = "from runtime.cli import main; main()"


@dataclass(frozen=True, slots=True)
class Run:
    """One run of the daemon."""

    name: str
    latency_ms: F64  # of each presented frame that knew its sample, from capture to light
    summary: dict[str, Any]


def run_daemon(name: str, *, plan: bool, frames: int, scale: float) -> Run:
    """`phasestack run --replay demo --headless` in a process of its own. Raises FatalError where it fails."""
    with tempfile.TemporaryDirectory(prefix="phasestack-") as folder:
        config = Path(folder) / "config.toml"
        config.write_text(f"[plan]\nenabled = {str(plan).lower()}\n", encoding="utf-8")
        out = Path(folder) / "run"
        arguments = ["run", "--config", str(config), "--replay", "demo", "--headless", "--frames", str(frames)]
        arguments += ["--scale", str(scale), "--out", str(out)]
        done = subprocess.run([sys.executable, "-c", MAIN, *arguments], capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise FatalError(f"the daemon failed while it was measured: {(done.stderr.splitlines() or [''])[-1]}")
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        lines = (out / "frames.jsonl").read_text(encoding="utf-8").splitlines()
    turns = [json.loads(line) for line in lines]
    latency = [
        (turn["present_ns"] - turn["capture_ns"]) / 1e6
        for turn in turns
        if turn["presented"] and turn["capture_ns"] and turn["eyes_label"] != "none"
    ]
    return Run(name, np.array(latency), summary)


def plan_on_and_off(*, frames: int = 150, scale: float = 0.5) -> list[Run]:
    """Both in one go, one after the other."""
    return [
        run_daemon("plan on", plan=True, frames=frames, scale=scale),
        run_daemon("plan off", plan=False, frames=frames, scale=scale),
    ]


def latency_section(runs: Sequence[Run], *, scale: float = 0.5) -> Section:
    """Histogram of the latency, and where the time goes."""
    with drawing(9.6, 3.8) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(3, 2))
        highest = max(float(np.percentile(run.latency_ms, 99)) for run in runs if run.latency_ms.size)
        bins = np.linspace(0, highest * 1.05, 40)
        for run, colour in zip(runs, COLOURS, strict=False):
            left.hist(run.latency_ms, bins=bins.tolist(), color=colour, alpha=0.55, label=run.name)
        left.set(xlabel="from capture to light, ms", ylabel="frames", title="Latency")
        left.legend()
        for y, run in enumerate(runs):
            start = 0.0
            for index, stage in enumerate(STAGES):
                length = float(run.summary["stage_ms"].get(stage, {}).get("p50", 0.0))
                right.barh(y, length, left=start, color=COLOURS[index % len(COLOURS)], label=None if y else stage)
                start += length
        right.set_yticks(range(len(runs)), [run.name for run in runs])
        right.set(xlabel="median ms of a turn", title="Stages")
        right.legend(fontsize=7.5, ncols=2, loc="upper right")
        right.set_ylim(-0.6, len(runs) + 0.6)
    headings = ["run", "latency p50 ms", "p95 ms", "p99 ms", "frames/s", "inferences", "dropped", "PSNR dB", "left out"]
    rows = []
    for run in runs:
        s = run.summary
        marks = np.percentile(run.latency_ms, [50, 95, 99]) if run.latency_ms.size else [np.nan] * 3
        left_out = "; ".join(str(item["what"]) for item in s.get("plan", []))
        psnr = s.get("psnr_db")
        row = [run.name, *(f"{m:.0f}" for m in marks), f"{s['fps']:.1f}", str(s["inferences"]), str(s["dropped"])]
        rows.append([*row, "" if psnr is None else f"{psnr:.2f}", left_out])
    text = [
        f"The daemon on its built-in recording and scene, in real time, offscreen, panels at {scale:g} of their "
        "resolution. The latency runs from the sample's capture to the light of the frame that was made from it; "
        "the tracker predicts across it.",
    ]
    figures = [Figure("latency", png(figure), "Left: every presented frame. Right: where the median turn's time goes.")]
    return Section("From capture to light", text, figures, [Table(headings, rows)])
