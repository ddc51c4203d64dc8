"""Run the display loop for `demo` and `run`, show its progress and write the results."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from runtime.browser.still import viewer_html
from runtime.config import Settings
from runtime.daemon.build import Host, Run, RunOptions, build_run
from runtime.errors import FatalError
from runtime.evaluation.run_output import RunOutput
from runtime.optics.alignment import shown_layers
from runtime.records import U8, RefreshAccount
from runtime.support import progress
from runtime.support.background import wait_for_all
from runtime.support.figures import lines_of

JOBS_END_WITHIN_S = 0.5  # how long to wait for background jobs at the end of a run
USUAL_M, IPD_M = 0.6, 0.063  # a typical viewer's distance and eye separation, used if no viewer was seen


def drive(settings: Settings, options: RunOptions, host: Host | None = None) -> dict[str, Any]:
    """Build a run, run the display loop to its end, write the output files and return the summary.

    If the output files could not be written, `output_problem` in the returned summary gives the reason.
    """
    done = 0

    def advance(account: RefreshAccount) -> None:
        nonlocal done
        done += 1
        progress.tell(f"{account.state}: refresh", done, options.frames)

    with ExitStack() as cleanup:
        cleanup.callback(progress.tell, "", 0)
        output = None
        if options.out is not None:
            output = cleanup.enter_context(RunOutput(options.out, every_one=options.max_speed))
        on_account = advance if options.max_speed else None
        run = build_run(settings, options, cleanup, host, output=output, on_account=on_account)
        reason = run.presenter.run(frames=options.frames)
        run.presenter.panels.close()  # go dark first, because writing the files may take several seconds
        for sample in run.presenter.samples.recorded_ahead():
            run.observer.sampled(sample)  # for the true eyes at the last display times
        if output is not None:
            output.run_is_over()
        run.observer.finish(lambda: host is not None and bool(host.stop_reason()))
        summary = run.summary() | {"stopped": reason}
        if output is not None:
            last, moment = run.presenter.last, run.observer.moment
            has_picture = last is not None and (last.frame.solved is not None or last.frame.flat is not None)
            layers = shown_layers(last.frame) if last is not None and has_picture else None
            unseen = ""
            if last is not None and layers is not None and moment is None:
                unseen = _unseen(layers, last.account, run, settings)
            output.finish(summary, layers, moment, unseen=unseen)
    if output is not None and output.problem:
        summary["output_problem"] = output.problem
    wait_for_all(JOBS_END_WITHIN_S)
    return summary


def _unseen(layers: U8, account: RefreshAccount, run: Run, settings: Settings) -> str:
    """Return the HTML of a viewer page for the last refresh, used if no refresh was measured."""
    stack, is_flat = run.presenter.stack, account.solved_for_m is None
    away_m = max(USUAL_M, stack.x_m[-1] + USUAL_M / 2)
    eyes_m = np.array([[away_m, -IPD_M / 2, 0.0], [away_m, IPD_M / 2, 0.0]])
    eyes_m = eyes_m if account.eyes_m is None else account.eyes_m
    title = (
        "This is the flat picture because no viewer was seen"
        if is_flat
        else "This is the last refresh; its quality was not measured"
    )
    fov_deg = settings.content.fov_deg
    return viewer_html(layers, (), stack, eyes_m=eyes_m, fov_deg=fov_deg, text=[title], follows=not is_flat)


def print_summary(summary: dict[str, Any], out: Path | None) -> None:
    """Print the summary in readable form, which figures to quote, and where to look at the result."""
    configured = summary["configured"]
    for line in lines_of({name: value for name, value in summary.items() if name not in (*configured, "configured")}):
        print(line)
    if configured:
        print("these figures were configured for the simulated clock and not measured:")
        for line in lines_of({name: summary[name] for name in configured}):
            print(f"  {line}")
    if summary["live_db"] is not None:
        print("for a moving head, quote live_db (the light PSNR at the true eyes against the target of each refresh)")
    if summary["light_db"] is not None:
        print(
            "for a head at rest, quote light_db (the light PSNR at the eye positions used, with a tracking error of 1 "
            "mm)"
        )
    if not summary["inferences"]:
        print("no solution was shown because no viewer was seen or because --frames ended the run too early")
    if out is not None and "output_problem" not in summary:
        print(f"see {out}/contact-sheet.png, or open {out}/viewer.html to look around")


def refuse_lost_output(summary: dict[str, Any]) -> None:
    """Raise FatalError if the files for --out could not be written."""
    if problem := summary.get("output_problem"):
        raise FatalError(problem)
