"""Run the display loop for `demo` and `run`, show its progress and write the results."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from runtime.browser.still import viewer_html
from runtime.config import Settings
from runtime.daemon.build import Host, Run, RunOptions, build_run
from runtime.errors import FatalError
from runtime.evaluation.run_output import RunOutput
from runtime.optics.presentation import shown_layers
from runtime.records import U8, RefreshAccount
from runtime.support import progress
from runtime.support.background import wait_for_all
from runtime.support.figures import effort_in_words, lines_of

JOBS_END_WITHIN_S = 0.5  # how long to wait for background jobs at the end of a run
EFFORTS_SHOWN = 3  # number of efforts to name; their shares of the time are largest
USUAL_M, IPD_M = 0.6, 0.063  # a typical viewer's distance and eye separation, used if no viewer was seen


def drive(settings: Settings, options: RunOptions, host: Host | None = None) -> dict[str, Any]:
    """Build a run, run the display loop to its end, write the output files and return the summary.
    `output_problem` in the summary gives the reason if the output files could not be written.
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


def print_summary(
    summary: dict[str, Any], out: Path | None, *, asked: int | None = None, verbose: bool = False
) -> None:
    """Print a run's result, of `asked` refreshes if given, with one or all figures."""
    if verbose:
        _print_figures(summary)
    for line in headline_lines(summary, asked=asked):
        print(line)
    written = out is not None and "output_problem" not in summary
    if written:
        print(f"see {out}/contact-sheet.png, or open {out}/viewer.html to look around")
    if not verbose:
        print(f"all figures: --verbose{f', or {out}/summary.json' if written else ''}")


def headline_lines(summary: dict[str, Any], *, asked: int | None = None) -> Iterator[str]:
    """Yield the most important lines: the quality, refreshes, solutions and faults."""
    live_db, light_db, view_mm = summary["live_db"], summary["light_db"], (summary["view_error_mm"] or {}).get("p50")
    if live_db is not None:
        late = "" if view_mm is None else f"; the view lags {view_mm:.1f} mm behind the head (median)"
        yield f"quality    {live_db:.1f} dB: light at the moving eyes, against what they should see (live_db){late}"
    elif light_db is not None:
        yield f"quality    {light_db:.1f} dB: light at the eyes, with a tracking error of 1 mm (light_db)"
    elif summary["inferences"]:
        yield "quality    not measured"
    else:
        yield "quality    nothing to measure: no viewer was seen, or --frames ended the run too early"
    of = f" of {asked}" if asked is not None else ""
    pace = "" if summary["configured"] else f" at {summary['fps']:.1f} a second"
    lost = f", {summary['dropped']} dropped" if summary["dropped"] else ""
    yield f"shown      {summary['presented']}{of} refreshes{pace}{lost}; {summary['inferences']} solutions"
    efforts = sorted((summary["efforts"] or {}).items(), key=lambda item: -item[1])
    total_s = sum(seconds for _, seconds in efforts)
    most = [(effort_in_words(name), seconds) for name, seconds in efforts[:EFFORTS_SHOWN]]
    most += [("others", sum(seconds for _, seconds in efforts[EFFORTS_SHOWN:]))]
    shares = [f"{what} for {100 * seconds / total_s:.0f}%" for what, seconds in most if seconds > 0]
    yield f"model      {summary['model']} on the {summary['backend']}{': ' if shares else ''}{', '.join(shares)}"
    states = [f"{name} {seconds:.1f} s" for name, seconds in summary["states"].items() if seconds >= 0.05]
    yield f"states     {', '.join(states)}"
    yield f"ended      {summary['stopped']}"


def _print_figures(summary: dict[str, Any]) -> None:
    configured = summary["configured"]
    for line in lines_of({name: value for name, value in summary.items() if name not in (*configured, "configured")}):
        print(line)
    if configured:
        print("these figures were configured for the simulated clock and not measured:")
        for line in lines_of({name: summary[name] for name in configured}):
            print(f"  {line}")


def refuse_lost_output(summary: dict[str, Any]) -> None:
    """Raise FatalError if the files for --out could not be written."""
    if problem := summary.get("output_problem"):
        raise FatalError(problem)
