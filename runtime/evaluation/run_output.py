"""The files of a run (docs/contracts.md). A failure to write them does not stop the run."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TextIO

from runtime.browser.still import viewer_html
from runtime.errors import InputError
from runtime.evaluation.contact_sheet import Moment, contact_sheet, headline
from runtime.evaluation.refresh_quality import Pictures
from runtime.records import U8
from runtime.support.artifacts import OutputFolder, to_json, write_json, write_png, write_text

log = logging.getLogger("phasestack.output")

WAITING = 64  # pieces of work that may wait for the disk


class RunOutput:
    """Writes a run's files into a folder; they appear together when it is left without an error.

    A thread of its own writes, so that no refresh waits for a disk. Where the disk fails on the way (full, gone, not
    ours any more), the files are abandoned: `problem` holds the reason, one line is logged, and the run goes on.
    """

    def __init__(self, target: Path, *, every_one: bool = True) -> None:
        """every_one: wait for a slow disk; otherwise leave out what it cannot take in time."""
        self._folder = OutputFolder(target)
        self._target, self._every_one = target, every_one
        self._lines: TextIO | None = None
        self._work: queue.Queue[Callable[[], None] | None] = queue.Queue(WAITING)
        self._writer = threading.Thread(target=self._write, name="output", daemon=True)
        self.problem = ""  # why the files were abandoned
        self.left_out = 0  # lines and lights that the disk was too slow for

    def __enter__(self) -> RunOutput:
        """Raises InputError where the folder can't be written."""
        self._folder.__enter__()
        try:
            self._lines = (self._folder.staging / "frames.jsonl").open("w", encoding="utf-8")
        except OSError as error:
            self._folder.__exit__(InputError, None, None)
            raise InputError(self._target, "", f"cannot be written ({error.strerror})") from None
        self._writer.start()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        self._work.put(None)
        self._writer.join()
        self._attempt(self._close_lines)
        if self.left_out:
            log.warning("output: the disk was too slow for %d lines or pictures of %s", self.left_out, self._target)
        if self.problem:
            kind = kind or InputError  # nothing half-written is left
        self._attempt(lambda: self._folder.__exit__(kind, error, trace))

    def refresh(self, line: Mapping[str, Any]) -> None:
        """One line of frames.jsonl. Arrays in it must not be written to afterwards."""
        self._later(lambda: self._line(line))

    def light(self, frame: int, *, layers: U8) -> None:
        """Write the layers of `light/<frame>/`.

        layers: (N, h, w, 3 or 4), as the panels show them; they must not be written to afterwards.
        """

        def write() -> None:
            for n, layer in enumerate(layers):
                write_png(self._light(frame) / f"layer-{n}.png", layer)

        self._later(write)

    def light_targets(
        self, frame: int, *, info: Mapping[str, Any], drawn: Pictures | None, true: Pictures | None
    ) -> None:
        """Write the rest of `light/<frame>/`: light.json as `info`, and retina pictures.

        drawn: what the eyes solved for should see; true: what the true eyes should see. Neither may be written to
        afterwards.
        """

        def write() -> None:
            for name, pictures in (("drawn", drawn), ("true", true)):
                for eye, picture in zip(("left", "right"), pictures or (), strict=False):
                    write_png(self._light(frame) / f"{name}-{eye}.png", picture)
            write_json(self._light(frame) / "light.json", info)

        self._later(write)

    def _light(self, frame: int) -> Path:
        return self._folder.staging / "light" / str(frame)

    def finish(
        self, summary: dict[str, Any], layers: U8 | None, moment: Moment | None = None, *, unseen: str = ""
    ) -> None:
        """Write the last frame, the summary, and the stills, sheet and viewer of the newest measured refresh.

        unseen: the viewer's page where no two eyes saw anything.
        """

        def write() -> None:
            folder = self._folder.staging
            write_json(folder / "summary.json", summary)
            if layers is None:
                return
            for n, layer in enumerate(layers):
                write_png(folder / f"layer-{n}.png", layer)
            shown, title, lines, page = layers, headline(None), [in_one_line(summary)], unseen
            if moment is not None:
                shown, title, lines = moment.layers, headline(moment.light_db), [*moment.lines, *lines]
                moment.eye_views.write(folder)
                look = moment.eye_views
                how: Any = {"eyes_m": moment.solved_for_m, "fov_deg": look.fov_deg, "title": title, "lines": lines}
                page = viewer_html(moment.solution, moment.asked_for, look.stack, **how)
            views = None if moment is None else moment.eye_views
            write_png(folder / "contact-sheet.png", contact_sheet(shown, views, headline=title, lines=lines))
            write_text(folder / "viewer.html", page)

        self._work.put(write)

    def _later(self, work: Callable[[], None]) -> None:
        if self.problem:
            return
        if self._every_one:
            self._work.put(work)
            return
        try:
            self._work.put_nowait(work)
        except queue.Full:
            self.left_out += 1

    def _write(self) -> None:
        """The writer's thread: work in its order, until None."""
        while (work := self._work.get()) is not None:
            if not self.problem:
                self._attempt(work)

    def _attempt(self, work: Callable[[], None]) -> None:
        try:
            work()
        except (OSError, InputError) as error:
            self._abandon(str(error), trace=False)
        except Exception as error:  # a mistake of ours in what is only for looking at must not end the run either
            self._abandon(f"{type(error).__name__}: {error}", trace=True)

    def _abandon(self, why: str, *, trace: bool) -> None:
        if self.problem:
            return
        self.problem = why
        log.warning("output: abandoned, nothing new is left in %s: %s", self._target, why, exc_info=trace)
        self._folder.discard()  # now: it may be what fills the disk

    def _line(self, line: Mapping[str, Any]) -> None:
        assert self._lines is not None
        self._lines.write(to_json(line) + "\n")

    def _close_lines(self) -> None:
        if self._lines is not None:
            self._lines.close()


def in_one_line(summary: dict[str, Any]) -> str:
    """A run's summary in one line, for its contact sheet."""
    line = f"The run: {summary['presented']} of {summary['frames']} refreshes presented, model {summary['model']}"
    if summary.get("live_db") is not None:
        line += f"; live {summary['live_db']:.1f} dB at the true eyes, over {summary['live_frames']} refreshes"
    if (error := summary.get("view_error_mm")) is not None:
        line += f"; view error {error['p50']:.1f} mm, 95th percentile {error['p95']:.1f}"
    if summary.get("light_db") is not None:
        line += f"; light {summary['light_db']:.1f} dB, mean of {summary['quality_frames']} refreshes"
    return line
