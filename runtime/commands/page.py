"""`phasestack page`: the operator's page, outside the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DEFAULT_PORT = 8717


def page(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any that is free")] = DEFAULT_PORT,
    token_file: Annotated[
        Path | None, typer.Option(help="file with the token, made where there is none; default: in the state folder")
    ] = None,
) -> None:
    """Serve the operator's page: what the running daemon does, live, and its controls.

    The daemon is asked by its socket; where none runs the page says so, and goes on when one is back. A browser must
    give the token that is in the token file.

    Example: phasestack page --port 8717
    """
    from runtime.daemon.client import Daemon, sockets
    from runtime.errors import retry_advised
    from runtime.page.connections import LOOPBACK, listening, server_of
    from runtime.page.server import application
    from runtime.page.token import token_of
    from runtime.support.background import BACKGROUND_NICENESS, set_niceness
    from runtime.support.folders import state_folder

    set_niceness(BACKGROUND_NICENESS)  # the display comes first; its threads are started after this
    places = sockets(config)
    path = token_file or state_folder() / "page-token"
    with retry_advised():  # a full disk may pass: the service is started again
        token = token_of(path)
    served = listening("page", port)
    typer.echo(f"the page is at http://{LOOPBACK}:{served.getsockname()[1]}/ - its token is in {path}", err=True)
    server_of(application(Daemon(places), token)).run(sockets=[served])
