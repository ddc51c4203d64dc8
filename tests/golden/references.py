"""Stores references: a JSON line for the summary and each refresh, and a lossless WebP for kept ones."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from runtime.records import U8
from runtime.support.artifacts import write_png
from runtime.support.picture_file import read_image
from tests.golden.cases import CASES
from tests.golden.compare import Moved, as_lines, compare_picture, compare_text
from tests.golden.play import Played, play
from tests.golden.recordings import DATA


def run(name: str) -> Played:
    """One case, now."""
    with tempfile.TemporaryDirectory() as folder:
        return play(CASES[name], Path(folder) / "run")


def moved_in(name: str, now: Played) -> list[Moved]:
    """Differences from the stored run; everything if none is stored."""
    stored = stored_text(name)
    if stored is None:
        return [Moved(None, "reference", "none", "a run")]
    found = compare_text(stored, [now.summary, *now.refreshes])
    for number, panels in now.panels.items():
        kept = stored_panels(name, number, count=len(panels))
        found += compare_picture(kept, panels, number=number, what="panels")
        if not CASES[name].mounted:
            found += compare_picture(kept, now.light[number], number=number, what="shown_layers")
    return found


def renew(name: str) -> list[str]:
    """Store a case as it is now; answers what moved by that, in lines."""
    now = run(name)
    lines = as_lines(name, moved_in(name, now))
    rows = [json.dumps(row, separators=(",", ":")) for row in (now.summary, *now.refreshes)]
    _text_path(name).write_text("\n".join(rows) + "\n", encoding="utf-8")
    for path in DATA.glob(f"{name}-[0-9]*.webp"):
        path.unlink()
    for number, panels in now.panels.items():  # a quarter smaller than as PNG
        strip = Image.fromarray(np.hstack(list(panels)))
        strip.save(_picture_path(name, number), lossless=True, quality=100, method=6)
    return lines


def check(name: str, *, pictures: Path | None = None) -> list[str]:
    """Lines that describe the differences from the stored run; empty if there are none.

    pictures: where to leave stored, present and different panels, one above the other, if a picture moved.
    """
    now = run(name)
    moved = moved_in(name, now)
    lines = as_lines(name, moved)
    if pictures is not None:
        for number in sorted(
            {m.where for m in moved if m.where in now.panels and m.name in ("panels", "shown_layers")}
        ):
            path = pictures / f"{name}-{number}.png"
            write_png(
                path, _side_by_side(stored_panels(name, number, count=len(now.panels[number])), now.panels[number])
            )
            lines.append(f"{name}: refresh {number}: stored, now and difference (x8) are in {path}")
    return lines


def stored_text(name: str) -> list[dict[str, Any]] | None:
    """The summary and the refreshes, or None."""
    path = _text_path(name)
    if not path.exists():
        return None
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def stored_panels(name: str, number: int, *, count: int) -> U8 | None:
    """(N, h, w, 3) of a kept refresh, or None if there is none of that many panels."""
    path = _picture_path(name, number)
    if not path.exists():
        return None
    strip = read_image(path)[..., :3]
    return np.stack(np.hsplit(strip, count)) if strip.shape[1] % count == 0 else None


def _side_by_side(stored: U8 | None, now: U8) -> U8:
    before = np.zeros_like(now) if stored is None or stored.shape != now.shape else stored
    off = np.clip(128 + 8 * (now.astype(np.int16) - before), 0, 255).astype(np.uint8)
    rows = np.vstack([np.hstack(list(part)) for part in (before, now, off)])
    return np.ascontiguousarray(rows.repeat(4, 0).repeat(4, 1))


def _text_path(name: str) -> Path:
    return DATA / f"{name}.jsonl"


def _picture_path(name: str, number: int) -> Path:
    return DATA / f"{name}-{number:03d}.webp"
