"""`phasestack calibrate panels`: where the panels really are, and how grey they are. Nothing heavy at the top."""

from __future__ import annotations

import typer

app = typer.Typer(no_args_is_help=True, help="Register the panels with each other and measure their grey curves.")
