"""Plays one case by the production path (`drive`, as `run --replay --headless --max-speed`) and records it."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import moderngl
import numpy as np

from runtime.clock import Clock
from runtime.config import OutputSettings, Settings
from runtime.daemon.build import Host, Run, RunOptions
from runtime.daemon.drive import drive
from runtime.frame.presenter import Presenter
from runtime.frame.refresh import Refresh
from runtime.optics.presentation import scale_and_shift, shown_layers
from runtime.optics.stack import PanelStack
from runtime.panels.registry import panel_settings
from runtime.records import U8, SensorFrame
from tests.golden.cases import Case
from tests.panels.drawn import DrawnPanels

DIGITS = 7  # stored digits: a tenth of a micrometre, a tenth of the least tolerance

SUMMARY = (
    "frames", "presented", "dropped", "stale_inputs", "inferences", "seconds", "fps", "solutions_per_s", "stage_ms",
    "interval_ms", "photon_ms", "psnr_db", "ssim", "carried_db", "carried_db_true_eyes", "psnr_db_true_eyes",
    "quality_frames", "model", "states", "stopped",
)  # fmt: skip


@dataclass(slots=True)
class Played:
    """Record of one run; `told` is stored as text, `panels` as pictures."""

    summary: dict[str, Any]
    refreshes: list[dict[str, Any]]
    panels: dict[int, U8] = field(default_factory=dict)  # refresh -> (N, h, w, 3), as the presentation shader drew it
    light: dict[int, U8] = field(default_factory=dict)  # the same, as the run's files have it (`shown_layers`)


class Collector:
    """Looks at every refresh as the black box does: another observer of the presenter."""

    def __init__(self, case: Case) -> None:
        self._case = case
        self._solution = 0
        self.refreshes: list[dict[str, Any]] = []
        self.panels: dict[int, U8] = {}
        self.light: dict[int, U8] = {}

    def watches(self, presenter: Presenter, **_: Any) -> None:
        self._presenter = presenter

    def sampled(self, sample: SensorFrame) -> None:
        return

    def refreshed(self, refresh: Refresh) -> None:
        account, frame, solution = refresh.account, refresh.frame, refresh.solution
        told: dict[str, Any] = {
            "reason": self._presenter.machine.reason,
            "flatness": frame.flatness,
            "solved_version": frame.solved_version,
            "flat_version": frame.flat_version,
            "alignment": [scale_and_shift(matrix) for matrix in frame.solved_from_shown],
        }
        if solution is not None and solution.number != self._solution:
            self._solution = solution.number
            codes = solution.layers[..., :3].astype(np.float64)
            told["solution_sigma_mm"] = None if solution.eye_sigma_m is None else solution.eye_sigma_m * 1e3
            told["solution_for_ns"] = solution.solved_for_ns
            told["layer_mean"] = codes.mean(axis=(1, 2)).round(3)
            told["layer_std"] = codes.std(axis=(1, 2)).round(3)
        self.refreshes.append(told)
        if account.frame in self._case.pictures:
            assert isinstance(self._presenter.panels, DrawnPanels)
            self.panels[account.frame] = np.stack(self._presenter.panels.read_back())[..., :3]
            self.light[account.frame] = shown_layers(frame)[..., :3].copy()


class Operator(Host):
    """Supervisor of the run: executes the case's actions at their times."""

    def __init__(self, case: Case, runs: list[Run]) -> None:
        self._actions, self._refresh, self._runs = case.actions, 0, runs

    def watches(self, run: Run) -> None:
        self._runs.append(run)

    def carry_out_commands(self, presenter: Presenter) -> None:
        if action := self._actions.get(self._refresh):
            action(presenter)
        self._refresh += 1


def play(case: Case, out: Path) -> Played:
    """Run it; `out` is the folder of the run's own files."""
    settings = Settings.model_validate(case.settings())
    collector = Collector(case)
    runs: list[Run] = []
    operator = Operator(case, runs)
    operator.recorder = collector
    with patch("runtime.daemon.build.open_panels", drawn_panels):
        summary = drive(settings, RunOptions(max_speed=True, measure=True, out=out), operator)
    lines = [json.loads(line) for line in (out / "frames.jsonl").read_text(encoding="utf-8").splitlines()]
    refreshes = [line | told for line, told in zip(lines, collector.refreshes, strict=True)]
    for line in refreshes:
        if len(line["people"]) < 2:  # the other fields describe the only person
            del line["people"]
        if line["effort"] is None:
            del line["effort"]
        if line["inference"] != "ran":  # as they were when their solution was first shown
            del line["solved_for_m"], line["stage_ms"]
    told = {name: summary.get(name) for name in SUMMARY}
    told["plan"] = [item["what"] for item in summary["plan"]]
    told["samples"] = runs[0].observer.measured
    return Played(rounded(told), rounded(refreshes), collector.panels, collector.light)


def drawn_panels(output: OutputSettings, stack: PanelStack, clock: Clock, context: moderngl.Context) -> DrawnPanels:
    """In place of `open_panels`: what offscreen panels hold is looked at here."""
    size_px = stack.width_px, stack.height_px
    return DrawnPanels(context, clock=clock, size_px=size_px, panels=panel_settings(output, stack.count))


def rounded(value: Any) -> Any:
    """Plain JSON values, numbers to DIGITS decimals."""
    if isinstance(value, dict):
        return {str(key): rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(item) for item in value]
    if isinstance(value, np.ndarray):
        return rounded(value.tolist())
    if isinstance(value, float | np.floating):
        return round(float(value), DIGITS) + 0.0
    return value
