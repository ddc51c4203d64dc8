"""Write a run's output files (docs/contracts.md). A failed write does not stop the run."""

from __future__ import annotations

import logging
import queue
import shutil
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from runtime.errors import InputError
from runtime.evaluation.contact_sheet import Moment, contact_sheet, headline
from runtime.evaluation.displayed import eye_names
from runtime.evaluation.refresh_quality import Pictures
from runtime.records import U8
from runtime.support.artifacts import OutputFolder, to_json, write_json, write_png, write_text
from runtime.support.threads import parallel_map

log = logging.getLogger("phasestack.output")

Work = Callable[[], object]
WAITING = 4096  # maximum number of queued jobs, enough for a minute of lines
RESERVED_BYTES = 64 << 10  # disk space kept for summary.json
WAITING_PICTURES = 4  # maximum number of queued jobs that hold a refresh's pictures, which take 25 MB per job at 1080p


class RunOutput:
    """Writer that puts a run's files in a folder, where they all appear together after a clean exit.

    A background thread writes the files, so that refreshes do not wait for the disk. If the disk fails during the run
    (full, gone, permission lost), writing stops and the run continues. The reason is logged once and kept in `problem`.
    Complete lines of frames.jsonl and complete pictures are kept, and space is reserved for summary.json.
    """

    def __init__(self, target: Path, *, every_one: bool = True) -> None:
        """Create a writer, to be entered before use, that waits for a slow disk if `every_one`, or else drops files."""
        self._folder = OutputFolder(target)
        self._target, self._every_one = target, every_one
        self._lines: TextIO | None = None
        # Each item is a job and a cleanup that always runs after it. None ends the thread.
        self._work: queue.Queue[tuple[Work, Work] | None] = queue.Queue(WAITING)
        self._pictures = threading.BoundedSemaphore(WAITING_PICTURES)
        self._writer = threading.Thread(target=self._write, name="output", daemon=True)
        self.problem = ""  # why writing stopped; empty while the disk works
        self.left_out = 0  # lines and pictures dropped because the disk was too slow

    def __enter__(self) -> RunOutput:
        """Create the folder and start the writing thread. Raises InputError if the folder is not writable."""
        self._folder.__enter__()
        try:
            self._reserve.write_bytes(bytes(RESERVED_BYTES))
            self._lines = self._lines_path.open("w", encoding="utf-8", buffering=1)  # a line at a time
        except OSError as error:
            self._folder.__exit__(InputError, None, None)
            raise InputError(self._target, "", f"cannot be written: {error.strerror}") from None
        self._writer.start()
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        self._work.put(None)
        self._writer.join()
        if self._lines is not None:
            self._attempt(self._lines.close)
        if self.left_out:
            log.warning(
                "output: dropped %d lines or pictures of %s because the disk was too slow", self.left_out, self._target
            )
        self._reserve.unlink(missing_ok=True)
        if self.problem:
            self._attempt(self._drop_incomplete)
        self._attempt(lambda: self._folder.__exit__(kind, error, trace))

    @property
    def _lines_path(self) -> Path:
        return self._folder.staging / "frames.jsonl"

    @property
    def _reserve(self) -> Path:
        return self._folder.staging / ".reserve"

    def refresh(self, line: Mapping[str, Any]) -> None:
        """Queue a line for frames.jsonl. The caller must not modify the line's arrays afterwards."""
        self._later(lambda: self._line(line))

    def light(self, frame: int, *, layers: U8) -> None:
        """Queue a refresh's layers as shown, not to be modified afterwards, for the folder `light/<frame>/`."""

        def write() -> None:
            for n, layer in enumerate(layers):
                write_png(self._light(frame) / f"layer-{n}.png", layer)

        self._pictures_later(write)

    def light_targets(
        self, frame: int, *, info: Mapping[str, Any], drawn: Pictures | None, true: Pictures | None
    ) -> None:
        """Queue light.json and target pictures, not to be modified afterwards, for `light/<frame>/`."""

        def write() -> None:
            for name, pictures in (("drawn", drawn), ("true", true)):
                for eye, picture in zip(eye_names(len(pictures or ())), pictures or (), strict=True):
                    write_png(self._light(frame) / f"{name}-{eye}.png", picture)
            write_json(self._light(frame) / "light.json", info)

        self._pictures_later(write)

    def _light(self, frame: int) -> Path:
        return self._folder.staging / "light" / str(frame)

    def run_is_over(self) -> None:
        """From now on, wait for a slow disk, as no refresh can be delayed now."""
        self._every_one = True

    def finish(
        self, summary: dict[str, Any], layers: U8 | None, moment: Moment | None = None, *, unseen: str = ""
    ) -> None:
        """Queue the files at the end of a run, or only summary.json after a disk failure or without layers.
        The contact sheet and the eyes' views show `moment`. Without it, the viewer page is `unseen`.
        """

        def write() -> None:
            folder = self._folder.staging
            write_json(folder / "summary.json", summary)
            if layers is None or self.problem:
                return
            parallel_map(lambda n: write_png(folder / f"layer-{n}.png", layers[n]), range(len(layers)))
            shown, title, lines, page = layers, headline(None), [in_one_line(summary)], unseen
            if moment is not None:
                shown, title, lines = moment.layers, headline(moment.light_db), [*moment.lines, *lines]
                moment.eye_views.write(folder)
                asked_for = replace(moment.eye_views, wanted=moment.asked_for, eyes_m=moment.solved_for_m)
                page = asked_for.viewer(moment.solution, [title, *lines], relief=moment.relief)
            views, focused = (None, None) if moment is None else (moment.eye_views, moment.focused)
            sheet = contact_sheet(shown, views, headline=title, lines=lines, focused=focused)
            write_png(folder / "contact-sheet.png", sheet)
            write_text(folder / "viewer.html", page)

        self._work.put((lambda: None, lambda: self._attempt(write)))  # also after a failure

    def _pictures_later(self, work: Work) -> None:
        """Queue a job with pictures. If WAITING_PICTURES jobs are queued, wait or drop the job."""
        if self.problem:
            return
        if not self._pictures.acquire(blocking=self._every_one):
            self.left_out += 1
            return
        if not self._later(work, then=self._pictures.release):
            self._pictures.release()

    def _later(self, work: Work, *, then: Work = lambda: None) -> bool:
        """Queue a job, unless it was dropped (False). `then` cleans up even if the job failed or was skipped."""
        if self.problem:
            return False
        try:
            self._work.put((work, then), block=self._every_one)
        except queue.Full:
            self.left_out += 1
            return False
        return True

    def _write(self) -> None:
        """Run queued jobs in order on the writing thread, until a queue item is None."""
        while (queued := self._work.get()) is not None:
            work, then = queued
            if not self.problem:
                self._attempt(work)
            then()

    def _attempt(self, work: Work) -> None:
        try:
            work()
        except (OSError, InputError) as error:
            self._stop(str(error), trace=False)
        except Exception as error:  # a bug in a job must not end the run either
            self._stop(f"{type(error).__name__}: {error}", trace=True)

    def _stop(self, why: str, *, trace: bool) -> None:
        if self.problem:
            return
        why = why.replace(str(self._folder.staging), str(self._target))  # name the final file, not the staged one
        self.problem = why
        log.warning("output: stopped writing to %s: %s", self._target, why, exc_info=trace)
        self._reserve.unlink(missing_ok=True)

    def _drop_incomplete(self) -> None:
        """Remove the incomplete last line of frames.jsonl and incomplete sets of layers or targets."""
        with self._lines_path.open("r+b") as lines:
            written = lines.read()
            lines.truncate(written.rfind(b"\n") + 1)
        layers = {light: len(list(light.glob("layer-*"))) for light in (self._folder.staging / "light").glob("*")}
        for light, count in layers.items():
            if count < max(layers.values()):
                shutil.rmtree(light)
            elif not (light / "light.json").exists():
                for target in (*light.glob("drawn-*"), *light.glob("true-*")):
                    target.unlink()

    def _line(self, line: Mapping[str, Any]) -> None:
        assert self._lines is not None
        self._lines.write(to_json(line) + "\n")


def in_one_line(summary: dict[str, Any]) -> str:
    """Return a line about a run for the contact sheet, with the live quality if it was measured."""
    line = (
        f"The run presented {summary['presented']} of {summary['frames']} refreshes with the model {summary['model']}"
    )
    if summary.get("live_db") is not None:
        line += (
            f"; while the head moved, the live PSNR at the true eyes was {summary['live_db']:.1f} dB, including delays"
        )
    return line
