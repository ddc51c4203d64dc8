"""Output files of a run (docs/contracts.md). A failure to write them does not stop the run."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

from runtime.errors import InputError
from runtime.evaluation.contact_sheet import Moment, contact_sheet, headline
from runtime.evaluation.refresh_quality import Pictures
from runtime.records import U8
from runtime.support.artifacts import OutputFolder, to_json, write_json, write_png, write_text
from runtime.support.background import MEASURING_NICENESS, set_niceness
from runtime.support.threads import fresh_threads, parallel_map

log = logging.getLogger("phasestack.output")

Work = Callable[[], object]
WAITING = 4096  # jobs queued for the disk: a minute of lines
WAITING_PICTURES = 4  # queued jobs with a refresh's pictures, which take 25 MB each at 1080p


class RunOutput:
    """Writer of a run's files to a folder, where they appear together after a clean exit.

    A background thread writes them, so that no refresh waits for the disk. If the disk fails during the run (full,
    gone, permission lost), the files are abandoned and the run continues. `problem` gives the reason, and one line is
    logged.
    """

    def __init__(self, target: Path, *, every_one: bool = True) -> None:
        """Create a writer of a run's files to the folder `target`.

        every_one: True to wait for a slow disk, False to drop lines and pictures instead.
        """
        self._folder = OutputFolder(target)
        self._target, self._every_one = target, every_one
        self._lines: TextIO | None = None
        # A job, and a cleanup that always runs.
        self._work: queue.Queue[tuple[Work, Work] | None] = queue.Queue(WAITING)
        self._pictures = threading.BoundedSemaphore(WAITING_PICTURES)
        self._writer = threading.Thread(target=self._write, name="output", daemon=True)
        self.problem = ""  # why the files were abandoned
        self.left_out = 0  # lines and pictures dropped because the disk was too slow

    def __enter__(self) -> RunOutput:
        """Create the folder. Raises InputError if it cannot be written."""
        self._folder.__enter__()
        try:
            self._lines = (self._folder.staging / "frames.jsonl").open("w", encoding="utf-8")
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
        if self.problem:
            kind = kind or InputError  # makes the folder discard its incomplete files
        self._attempt(lambda: self._folder.__exit__(kind, error, trace))

    def refresh(self, line: Mapping[str, Any]) -> None:
        """Write one line of frames.jsonl. The account's arrays must not be changed afterwards."""
        self._later(lambda: self._line(line))

    def light(self, frame: int, *, layers: U8) -> None:
        """Write the layers of `light/<frame>/`.

        layers: (N, h, w, 3 or 4), as the panels show them; they must not be changed afterwards.
        """

        def write() -> None:
            for n, layer in enumerate(layers):
                write_png(self._light(frame) / f"layer-{n}.png", layer)

        self._pictures_later(write)

    def light_targets(
        self, frame: int, *, info: Mapping[str, Any], drawn: Pictures | None, true: Pictures | None
    ) -> None:
        """Write the other files of `light/<frame>/`: light.json with `info`, and retina pictures.

        drawn: targets of the eyes solved for; true: targets of the true eyes. Neither may be changed afterwards.
        """

        def write() -> None:
            for name, pictures in (("drawn", drawn), ("true", true)):
                for eye, picture in zip(("left", "right"), pictures or (), strict=False):
                    write_png(self._light(frame) / f"{name}-{eye}.png", picture)
            write_json(self._light(frame) / "light.json", info)

        self._pictures_later(write)

    def _light(self, frame: int) -> Path:
        return self._folder.staging / "light" / str(frame)

    def run_is_over(self) -> None:
        """Wait for disk writes from now on, and speed them up, because they can no longer delay a refresh."""
        self._every_one = True
        set_niceness(0, self._writer)
        fresh_threads()  # the solver's and the measurements' have a low priority

    def finish(
        self, summary: dict[str, Any], layers: U8 | None, moment: Moment | None = None, *, unseen: str = ""
    ) -> None:
        """Write the last frame, the summary, and the pictures and pages of the newest measured refresh.

        unseen: viewer page to write if no refresh was measured.
        """

        def write() -> None:
            folder = self._folder.staging
            write_json(folder / "summary.json", summary)
            if layers is None:
                return
            parallel_map(lambda n: write_png(folder / f"layer-{n}.png", layers[n]), range(len(layers)))
            shown, title, lines, page = layers, headline(None), [in_one_line(summary)], unseen
            if moment is not None:
                shown, title, lines = moment.layers, headline(moment.light_db), [*moment.lines, *lines]
                moment.eye_views.write(folder)
                asked_for = replace(moment.eye_views, wanted=moment.asked_for, eyes_m=moment.solved_for_m)
                page = asked_for.viewer(moment.solution, [title, *lines], relief=moment.relief)
            views = None if moment is None else moment.eye_views
            write_png(folder / "contact-sheet.png", contact_sheet(shown, views, headline=title, lines=lines))
            write_text(folder / "viewer.html", page)

        self._work.put((write, lambda: None))

    def _pictures_later(self, work: Work) -> None:
        """Queue a job with pictures, or drop it at the limit on their memory."""
        if self.problem:
            return
        if not self._pictures.acquire(blocking=self._every_one):
            self.left_out += 1
            return
        if not self._later(work, then=self._pictures.release):
            self._pictures.release()

    def _later(self, work: Work, *, then: Work = lambda: None) -> bool:
        """Queue a job. Return False if it was dropped. then: called after the job in any case."""
        if self.problem:
            return False
        try:
            self._work.put((work, then), block=self._every_one)
        except queue.Full:
            self.left_out += 1
            return False
        return True

    def _write(self) -> None:
        """Run queued jobs in order, on the writer's thread, until one is None."""
        set_niceness(MEASURING_NICENESS)
        while (queued := self._work.get()) is not None:
            work, then = queued
            if not self.problem:
                self._attempt(work)
            then()

    def _attempt(self, work: Work) -> None:
        try:
            work()
        except (OSError, InputError) as error:
            self._abandon(str(error), trace=False)
        except Exception as error:  # not even a bug here may end the run
            self._abandon(f"{type(error).__name__}: {error}", trace=True)

    def _abandon(self, why: str, *, trace: bool) -> None:
        if self.problem:
            return
        self.problem = why
        log.warning("output: abandoned without writing to %s: %s", self._target, why, exc_info=trace)
        self._folder.discard()  # now, because these files may be filling the disk

    def _line(self, line: Mapping[str, Any]) -> None:
        assert self._lines is not None
        self._lines.write(to_json(line) + "\n")


def in_one_line(summary: dict[str, Any]) -> str:
    """Return a line about a run for its contact sheet, with the one figure for its motion."""
    line = (
        f"The run presented {summary['presented']} of {summary['frames']} refreshes with the model {summary['model']}"
    )
    if summary.get("live_db") is not None:
        line += (
            f"; while the head moved, the live PSNR at the true eyes was {summary['live_db']:.1f} dB, including delays"
        )
    return line
