"""What `demo` and `run` share: drive a loop, show progress, leave the files, tell the summary."""

from __future__ import annotations

import sys
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runtime.blackbox.recorder import Recorder
    from runtime.config import Settings
    from runtime.daemon.build import Run, RunOptions
    from runtime.frame.presenter import Supervisor

JOBS_END_WITHIN_S = 3.0  # what is still loading at the end


def drive(
    settings: Settings,
    options: RunOptions,
    *,
    out: Path | None,
    frames: int | None,
    total: int | None,
    progress: bool,
    supervisor: Supervisor | None = None,
    wait_for_panels: Any = None,
    on_start: Callable[[str], bool] = lambda _: True,
    on_built: Callable[[Run], None] = lambda _: None,
    recorder: Recorder | None = None,
) -> dict[str, Any]:
    """Run to the end and answer the summary. `total`: refreshes that the progress bar counts to, where it is known."""
    from runtime.daemon.build import build_run
    from runtime.evaluation.run_output import RunOutput
    from runtime.optics.alignment import shown_layers
    from runtime.support.background import wait_for_all

    with ExitStack() as cleanup:
        output = cleanup.enter_context(RunOutput(out, every_one=options.max_speed)) if out is not None else None
        advance = cleanup.enter_context(_progress(total)) if progress else None
        run = build_run(
            settings,
            options,
            cleanup,
            supervisor=supervisor,
            output=output,
            on_account=advance,
            wait_for_panels=wait_for_panels,
            on_start=on_start,
            recorder=recorder,
        )
        on_built(run)
        begin_s = perf_counter()
        reason = run.presenter.run(frames=frames)
        machine_s = perf_counter() - begin_s
        for sample in run.presenter.samples.recorded_ahead():
            run.observer.sampled(sample)  # the last lights' truth: nothing else is done with it
        run.observer.finish()
        summary = run.summary() | {"stopped": reason}
        if output is not None:
            last = run.presenter.last
            has_picture = last is not None and (last.frame.solved is not None or last.frame.flat is not None)
            layers = shown_layers(last.frame) if last is not None and has_picture else None
            output.finish(summary, layers, run.observer.eye_views)
    left_behind = run.solver.left_behind + wait_for_all(JOBS_END_WITHIN_S)
    return summary | {"machine_s": round(machine_s, 3), "left_behind": left_behind}


def _progress(total: int | None) -> Any:
    from contextlib import contextmanager

    from runtime.support.progress import NowAndThen

    @contextmanager
    def bar() -> Any:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        if not sys.stderr.isatty():
            told, done = NowAndThen(sys.stderr), 0

            def tell(frame: Any) -> None:
                nonlocal done
                done += 1
                told(f"{frame.state}: refresh {done}" + (f" of {total}" if total else ""))

            yield tell
            return
        columns = (TextColumn("{task.description:12}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as shown:
            task = shown.add_task("starting", total=total)
            yield lambda frame: shown.update(task, advance=1, description=str(frame.state))

    return bar()


def print_summary(summary: dict[str, Any], out: Path | None) -> None:
    """One screen for a person."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title="phasestack", show_header=False, title_justify="left")
    presented = f"{summary['presented']} of {summary['frames']} presented, {summary['dropped']} dropped"
    table.add_row("refreshes", f"{presented}; {summary['inferences']} solutions")
    rates = f"{summary['seconds']:.1f} s"
    if summary["fps"] is not None:
        rates += f", {summary['fps']:.1f} refreshes/s, {summary['solutions_per_s']:.1f} solutions/s"
    if abs(summary["machine_s"] - summary["seconds"]) > 0.1 * summary["seconds"]:
        rates += f" (simulated; it took {summary['machine_s']:.1f} s)"
    table.add_row("time", rates)
    table.add_row("scene", summary["scene"])
    table.add_row("model", f"{summary['model']} on {summary['provider']}, {summary['backend']}")
    if summary["psnr_db"] is not None:
        quality = f"{summary['psnr_db']:.2f} dB, SSIM {summary['ssim']:.4f} at the eyes used"
        if summary["psnr_db_true_eyes"] is not None:
            quality += f"; {summary['psnr_db_true_eyes']:.2f} dB at the true eyes"
        table.add_row("displayed", f"{quality} ({summary['quality_frames']} refreshes)")
        carried = f"{summary['carried_db']:.2f} dB at the eyes used"
        if summary["carried_db_true_eyes"] is not None:
            carried += f"; {summary['carried_db_true_eyes']:.2f} dB at the true eyes"
        table.add_row("carried", f"{carried} (ghosts and fringes, without a late picture's parallax)")
    if summary["photon_ms"] is not None:
        table.add_row("capture to light", f"{summary['photon_ms']['p50']:.1f} ms (p50)")
    stages = {name: values for name, values in summary["stage_ms"].items() if values and values["max"] > 0.05}
    table.add_row("stages, ms", ", ".join(f"{name} {values['p50']:.1f}" for name, values in stages.items()) + " (p50)")
    overhead = summary["overhead_ms"]
    if overhead:
        table.add_row("overhead, ms", f"{overhead['p50']:.2f} (p50), {overhead['p99']:.2f} (p99)")
    table.add_row("states, s", ", ".join(f"{state} {seconds:.1f}" for state, seconds in summary["states"].items()))
    for item in summary["plan"]:
        table.add_row("left out", f"{item['what']}: {item['why']}")
    if out is not None:
        table.add_row("files", f"{out}/contact-sheet.png and more")
    console.print(table)
