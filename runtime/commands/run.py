"""`phasestack run`: run the daemon, or play a recording through the same pipeline."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Annotated

import typer

from runtime.support.options import ConfigOption, JsonOption, LayoutOption, ModelOption, blame_option, number


def run(
    config: ConfigOption = None,
    replay: Annotated[str | None, typer.Option(help="recording to play instead of the sensor, or `demo`")] = None,
    headless: Annotated[bool, typer.Option("--headless", help="render offscreen instead of opening windows")] = False,
    frames: Annotated[int | None, typer.Option(min=1, help="stop after this many refreshes")] = None,
    max_speed: Annotated[bool, typer.Option("--max-speed", help="play a recording on a simulated clock")] = False,
    out: Annotated[Path | None, typer.Option(help="folder for pictures, frames.jsonl and summary.json")] = None,
    scene: Annotated[str | None, typer.Option(help="scene to show: a built-in name, a file or a folder")] = None,
    layout: LayoutOption = None,
    model: ModelOption = None,
    scale: Annotated[float, number(0.05, 2.0, help="scale factor for the pixel dimensions of offscreen panels")] = 1.0,
    backend: Annotated[
        str | None,
        typer.Option(help="device for everything except the network: cpu, gl or auto (the faster of the two)"),
    ] = None,
    keep_light: Annotated[int, typer.Option(min=0, help="write every N-th refresh's layers to --out (0: none)")] = 0,
    verbose: Annotated[bool, typer.Option("--verbose", help="print all figures of the summary")] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the display until SIGTERM. SIGHUP reloads the configuration.

    Exits with 75 if the X server dies. When the service restarts, it waits for the X server to come back.

    Example: phasestack run --config /etc/phasestack/phasestack.toml

    Example: phasestack run --replay demo --headless --max-speed --frames 30 --out out/run
    """
    from runtime.config import Settings, load_settings, with_options
    from runtime.daemon.build import RunOptions
    from runtime.daemon.drive import print_summary, refuse_lost_output
    from runtime.daemon.supervise import run_daemon
    from runtime.errors import InputError

    if keep_light and out is None:
        raise InputError("run", "--keep-light", "requires --out")

    def read_settings() -> Settings:
        settings = load_settings(config)
        loop = replay == "demo" and frames is None and out is None and not max_speed
        return with_options(
            settings,
            replay=replay,
            loop=loop,
            headless=headless,
            scene=scene,
            layout=layout,
            model=model,
            backend=backend,
        )

    options = RunOptions(
        max_speed=max_speed, measure=out is not None, scale=scale, keep_light=keep_light, frames=frames, out=out
    )
    with blame_option("run", scene=scene, model=model):
        summary = run_daemon(read_settings, options)
    if as_json:
        typer.echo(json.dumps(summary))
    elif "frames" in summary and "NOTIFY_SOCKET" not in os.environ:
        print_summary(summary, out, asked=frames, verbose=verbose)
    refuse_lost_output(summary)
