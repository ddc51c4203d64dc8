"""What `demo` and `run` share: drive a loop, show progress, leave the files, print the summary."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.table import Table

from runtime.config import Settings
from runtime.daemon.build import Host, RunOptions, build_run
from runtime.evaluation.run_output import RunOutput
from runtime.optics.alignment import shown_layers
from runtime.records import RefreshAccount
from runtime.support import progress
from runtime.support.background import wait_for_all

JOBS_END_WITHIN_S = 3.0  # what is still loading at the end


def drive(
    settings: Settings, options: RunOptions, host: Host | None = None, *, expected: int | None = None
) -> dict[str, Any]:
    """Run to the end and answer the summary. expected: refreshes that the progress counts to, where it is known."""
    done = 0

    def advance(account: RefreshAccount) -> None:
        nonlocal done
        done += 1
        progress.tell(f"{account.state}: refresh", done, options.frames or expected)

    with ExitStack() as cleanup:
        cleanup.callback(progress.tell, "", 0)
        output = None
        if options.out is not None:
            output = cleanup.enter_context(RunOutput(options.out, every_one=options.max_speed))
        on_account = advance if options.max_speed else None
        run = build_run(settings, options, cleanup, host, output=output, on_account=on_account)
        begin_s = perf_counter()
        reason = run.presenter.run(frames=options.frames)
        machine_s = perf_counter() - begin_s
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
    return summary | {"machine_s": round(machine_s, 3)}


def print_summary(summary: dict[str, Any], out: Path | None) -> None:
    """One screen for a person."""
    console = Console()
    table = Table(title="phasestack", show_header=False, title_justify="left")
    presented = f"{summary['presented']} of {summary['frames']} presented, {summary['dropped']} dropped"
    table.add_row("refreshes", f"{presented}; {summary['inferences']} solutions")
    how = ", as configured" if summary["configured"] else ""
    rates = f"{summary['seconds']:.1f} s"
    if summary["fps"] is not None:
        rates += f", {summary['fps']:.1f} refreshes/s, {summary['solutions_per_s']:.1f} solutions/s"
    if how:
        rates += f" on the simulated clock; it took {summary['machine_s']:.1f} s"
    table.add_row(f"time{how}", rates)
    table.add_row("scene", summary["scene"])
    table.add_row("model", f"{summary['model']} on {summary['provider']}, {summary['backend']}")
    if summary["light_db"] is not None:
        table.add_row("light", f"{summary['light_db']:.2f} dB of a pupil at the eyes used: the figure to quote")
    if summary["psnr_db"] is not None:
        quality = f"{summary['psnr_db']:.2f} dB, SSIM {summary['ssim']:.4f} at the eyes used"
        table.add_row("one ray a pixel", f"{quality} ({summary['quality_frames']} refreshes); more in summary.json")
    if summary["photon_ms"] is not None:
        table.add_row(f"capture to light{how}", f"{summary['photon_ms']['p50']:.1f} ms (p50)")
    stages = {name: values for name, values in summary["stage_ms"].items() if values and values["max"] > 0.05}
    table.add_row(
        f"stages, ms{how}", ", ".join(f"{name} {values['p50']:.1f}" for name, values in stages.items()) + " (p50)"
    )
    table.add_row("states, s", ", ".join(f"{state} {seconds:.1f}" for state, seconds in summary["states"].items()))
    for item in summary["plan"]:
        table.add_row("left out", f"{item['what']}: {item['why']}")
    if out is not None:
        table.add_row("files", f"{out}/contact-sheet.png and more")
    console.print(table)
