"""`phasestack page`: serve the operator's page from a separate process."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEFAULT_PORT = 8717


def page(
    config: Annotated[Path | None, typer.Option(help="configuration file that names the daemon's socket")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on (0 for any free port)")] = DEFAULT_PORT,
    token_file: Annotated[Path | None, typer.Option(help="file with the login token, created if missing")] = None,
) -> None:
    """Serve the operator's page, used to watch and control the running daemon.

    If no daemon is running, the page waits for one. Log in with the token in the token file.

    Example: phasestack page --port 8717
    """
    from runtime.daemon.client import DaemonClient, sockets
    from runtime.errors import retry_advised
    from runtime.page.connections import LOOPBACK, listening, server_of
    from runtime.page.server import application
    from runtime.page.token import token_of
    from runtime.support.background import BACKGROUND_NICENESS, set_niceness
    from runtime.support.folders import state_folder

    set_niceness(BACKGROUND_NICENESS)  # before any thread is started, because the display has priority
    places = sockets(config)
    path = token_file or state_folder() / "page-token"
    with retry_advised():  # for example if the disk is full
        token = token_of(path)
    served = listening("page", port)
    typer.echo(f"page: http://{LOOPBACK}:{served.getsockname()[1]}/ (log in with the token in {path})", err=True)
    server_of(application(DaemonClient(places), token)).run(sockets=[served])
