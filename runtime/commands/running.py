"""What `demo` and `run` share: drive a loop, show progress, leave the files, tell the summary."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from runtime.config import Settings
    from runtime.daemon.build import RunOptions
    from runtime.frame.loop import Supervisor
    from runtime.records import FrameAccount


def drive(
    settings: Settings,
    options: RunOptions,
    *,
    out: Path | None,
    frames: int | None,
    total: int | None,
    progress: bool,
    measured_times: bool,
    supervisor: Supervisor | None = None,
    wait_for_panels: Any = None,
    on_start: Callable[[str], bool] = lambda _: True,
) -> dict[str, Any]:
    """Run to the end and answer the summary. `total`: turns that the progress bar counts to, where it is known.

    measured_times: frames.jsonl tells the machine's stage times, not the simulated clock's.
    """
    from runtime.daemon.build import build_loop
    from runtime.evaluation.run_output import RunOutput

    with ExitStack() as cleanup:
        output = cleanup.enter_context(RunOutput(out)) if out is not None else None
        advance = cleanup.enter_context(_progress(total)) if progress else None

        def account(frame: FrameAccount) -> None:
            if output is not None:
                output.frame(frame, frame.measured_ms if measured_times else frame.stage_ms)
            if advance is not None:
                advance(frame)

        loop = build_loop(
            settings,
            options,
            cleanup,
            supervisor=supervisor,
            on_account=account,
            wait_for_panels=wait_for_panels,
            on_start=on_start,
        )
        reason = loop.run(frames=frames)
        if loop.look is None or settings.loop.evaluate_every == 0:
            loop.measure()
        summary = loop.summary() | {"stopped": reason}
        if output is not None:
            output.finish(summary, loop.layers, loop.look)
    return summary


def _progress(total: int | None) -> Any:
    from contextlib import contextmanager

    @contextmanager
    def bar() -> Any:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

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
    table.add_row("frames", f"{presented}, {summary['inferences']} inferences")
    table.add_row("time", f"{summary['seconds']:.1f} s, {summary['fps']:.1f} frames/s with measuring")
    table.add_row("model", f"{summary['model']} on {summary['provider']}")
    if summary["psnr_db"] is not None:
        quality = f"{summary['psnr_db']:.2f} dB, SSIM {summary['ssim']:.4f} at the eyes used"
        if summary["psnr_db_true_eyes"] is not None:
            quality += f"; {summary['psnr_db_true_eyes']:.2f} dB at the true eyes"
        table.add_row("displayed", f"{quality} ({summary['quality_frames']} frames)")
    stages = {name: values for name, values in summary["stage_ms"].items() if values.get("max", 0) > 0.05}
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
