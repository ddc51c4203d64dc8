"""`phasestack page`: the operator's page, outside the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import socket as sockets_

LOOPBACK, DEFAULT_PORT = "127.0.0.1", 8717


def page(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    port: Annotated[int, typer.Option(min=0, max=65535, help="port to listen on; 0: any that is free")] = DEFAULT_PORT,
    token_file: Annotated[
        Path | None, typer.Option(help="file with the token, made where there is none; default: in the state folder")
    ] = None,
) -> None:
    """Serve the operator's page: what the running daemon does, live, and its controls. Needs the extra `page`.

    The daemon is asked by its socket; where none runs the page says so, and goes on when one is back. A browser must
    give the token that is in the token file.

    Example: phasestack page --port 8717
    """
    from runtime.errors import MissingPart

    try:
        import uvicorn

        from runtime.page.connections import LimitedConnection
        from runtime.page.server import application
    except ImportError as error:
        raise MissingPart(f"page: {error.name} is not installed: pip install starlette uvicorn") from None

    from runtime.daemon.client import Daemon, sockets
    from runtime.page.token import token_of
    from runtime.support.background import BACKGROUND_NICENESS, set_niceness
    from runtime.support.folders import state_folder

    set_niceness(BACKGROUND_NICENESS)  # the display comes first; its threads are started after this
    places = sockets(config)
    path = token_file or state_folder() / "page-token"
    token = token_of(path)
    listening = _listening(port)
    daemon = Daemon(places)
    app = application(daemon, token, port=listening.getsockname()[1])
    settings = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=2,
        http=LimitedConnection,
    )
    typer.echo(f"the page is at http://{LOOPBACK}:{listening.getsockname()[1]}/ - its token is in {path}", err=True)
    uvicorn.Server(settings).run(sockets=[listening])


def _listening(port: int) -> sockets_.socket:
    """A bound socket on loopback. Raises InputError where the port is taken."""
    import socket as sockets_

    from runtime.errors import InputError

    try:
        return sockets_.create_server((LOOPBACK, port))
    except OSError as error:
        raise InputError("page", "--port", f"{port}: can't be listened on ({error.strerror})") from None
