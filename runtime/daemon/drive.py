"""What `demo` and `run` share: drive a loop, show progress, leave the files, print the summary."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import Any

from runtime.config import Settings
from runtime.daemon.build import Host, RunOptions, build_run
from runtime.evaluation.run_output import RunOutput
from runtime.optics.alignment import shown_layers
from runtime.records import RefreshAccount
from runtime.support import progress
from runtime.support.background import wait_for_all
from runtime.support.figures import lines_of

JOBS_END_WITHIN_S = 0.5  # what is still loading at the end


def drive(settings: Settings, options: RunOptions, host: Host | None = None) -> dict[str, Any]:
    """Run to the end and answer the summary."""
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
        for sample in run.presenter.samples.recorded_ahead():
            run.observer.sampled(sample)  # the last lights' truth: nothing else is done with it
        run.observer.finish()
        summary = run.summary() | {"stopped": reason}
        if output is not None:
            last = run.presenter.last
            has_picture = last is not None and (last.frame.solved is not None or last.frame.flat is not None)
            layers = shown_layers(last.frame) if last is not None and has_picture else None
            output.finish(summary, layers, run.observer.eye_views, run.observer.moment)
    wait_for_all(JOBS_END_WITHIN_S)
    return summary


def print_summary(summary: dict[str, Any], out: Path | None) -> None:
    """For a person: what summary.json holds, what was measured first, and which figure of it to quote."""
    configured = summary["configured"]
    for line in lines_of({name: value for name, value in summary.items() if name not in (*configured, "configured")}):
        print(line)
    if configured:
        print("as configured, on the simulated clock (nothing of it was measured):")
        for line in lines_of({name: summary[name] for name in configured}):
            print(f"  {line}")
    if summary["light_db"] is not None:
        print("light_db, of pupils at the eyes used and a tracking error of 1 mm, is the figure to quote")
    if out is not None:
        print(f"see {out}/contact-sheet.png; look into it: {out}/viewer.html")
