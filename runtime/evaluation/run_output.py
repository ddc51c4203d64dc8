"""The files of a run (design 5.2)."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TextIO

import numpy as np

from runtime.evaluation.contact_sheet import contact_sheet
from runtime.evaluation.probe import Look
from runtime.records import U8
from runtime.support.artifacts import OutputFolder, to_json, write_json, write_png


class RunOutput:
    """Writes a run's files into a folder; they appear together when it is left without an error."""

    def __init__(self, target: Path) -> None:
        self._folder = OutputFolder(target)
        self._log: TextIO | None = None

    def __enter__(self) -> RunOutput:
        self._folder.__enter__()
        self._log = (self._folder.staging / "frames.jsonl").open("w", encoding="utf-8")
        return self

    def __exit__(self, *error: Any) -> None:
        if self._log is not None:
            self._log.close()
        self._folder.__exit__(*error)

    def frame(self, account: Any, stage_ms: dict[str, float]) -> None:
        """One line of frames.jsonl."""
        assert self._log is not None
        self._log.write(
            to_json(
                {
                    "frame": account.frame,
                    "capture_ns": account.capture_ns,
                    "predicted_for_ns": account.predicted_for_ns,
                    "present_ns": account.present_ns,
                    "eyes_m": account.eyes_m,
                    "eyes_label": account.eyes_label,
                    "state": str(account.state),
                    "inference": account.inference,
                    "presented": account.presented,
                    "stage_ms": {stage: round(value, 4) for stage, value in stage_ms.items()},
                    "skew_ms": round(account.skew_ms, 4),
                }
            )
            + "\n"
        )

    def refresh(self, line: dict[str, Any]) -> None:
        self._log.write(to_json(line) + "\n")

    def light(self, frame: int, *, layers: U8, drawn: Any, info: Any) -> None:
        folder = self._folder.staging / "light" / str(frame)
        for n, layer in enumerate(layers):
            write_png(folder / f"layer-{n}.png", layer)
        if drawn:
            for name, picture in zip(("left", "right"), drawn):
                write_png(folder / f"drawn-{name}.png", picture)
        write_json(folder / "light.json", info)

    def finish(self, summary: dict[str, Any], layers: U8 | None, look: Look | None) -> None:
        """The pictures of the last frame, the contact sheet and the summary."""
        folder = self._folder.staging
        write_json(folder / "summary.json", summary)
        if layers is None:
            return
        for n, layer in enumerate(layers):
            write_png(folder / f"layer-{n}.png", layer)
        if look is not None:
            for side, eye in enumerate(("left", "right")):
                seen = (np.clip(look.seen[side].image, 0, 1) * 255 + 0.5).astype(np.uint8)
                write_png(folder / f"seen-{eye}.png", seen)
                write_png(folder / f"wanted-{eye}.png", look.wanted[side])
        write_png(folder / "contact-sheet.png", contact_sheet(layers, look, headline=headline(summary)))


def headline(summary: dict[str, Any]) -> str:
    """A run in one line."""
    parts = [f"phasestack: {summary['presented']} of {summary['frames']} frames presented"]
    parts.append(f"model {summary['model']} on {summary['provider']}")
    if summary.get("psnr_db") is not None:
        parts.append(f"displayed {summary['psnr_db']:.1f} dB, SSIM {summary['ssim']:.3f} (mean of sampled frames)")
    return "   |   ".join(parts)
