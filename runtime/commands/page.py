"""`phasestack page`: the operator's page, outside the daemon."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    import socket as sockets_

DEFAULT_PORT = 8717


def page(
    config: Annotated[Path | None, typer.Option(help="configuration of the daemon: says where its socket is")] = None,
    socket: Annotated[Path | None, typer.Option(help="the daemon's socket, whatever the configuration says")] = None,
    host: Annotated[
        str, typer.Option(help="address to listen on; anything but loopback lets others try")
    ] = "127.0.0.1",
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

        from runtime.page.server import application
    except ImportError as error:
        raise MissingPart(f"page: {error.name} is not installed: pip install starlette uvicorn") from None

    from runtime.commands.status import sockets
    from runtime.page.daemon import Daemon
    from runtime.page.token import token_of
    from runtime.support.folders import state_folder
    from runtime.support.priority import BACKGROUND_NICENESS, set_niceness

    set_niceness(BACKGROUND_NICENESS)  # the display comes first; its threads are started after this
    places = sockets(config, socket)
    path = token_file or state_folder() / "page-token"
    token = token_of(path)
    listening = _listening(host, port)
    daemon = Daemon(places)
    app = application(daemon, token, any_host=not _is_loopback(host))
    settings = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        proxy_headers=False,
        timeout_graceful_shutdown=2,
        limit_concurrency=64,
    )
    name = f"[{host}]" if ":" in host else host
    typer.echo(f"the page is at http://{name}:{listening.getsockname()[1]}/ - its token is in {path}", err=True)
    uvicorn.Server(settings).run(sockets=[listening])


def _is_loopback(host: str) -> bool:
    import ipaddress

    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _listening(host: str, port: int) -> sockets_.socket:
    """A bound socket. Raises InputError where the address is taken or none of this machine's."""
    import socket as sockets_

    from runtime.errors import InputError

    try:
        family = sockets_.getaddrinfo(host, port, type=sockets_.SOCK_STREAM)[0][0]
        return sockets_.create_server((host, port), family=family)
    except (OSError, UnicodeError) as error:
        problem = getattr(error, "strerror", None) or error
        raise InputError("page", "--host, --port", f"{host} port {port}: can't be listened on ({problem})") from None
