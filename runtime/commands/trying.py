"""Implementation of `phasestack try`, which runs the daemon with a web page as sensor and panels."""

from __future__ import annotations

import json
import os
import secrets
import tempfile
import threading
import time
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import typer

from runtime.browser.link import BrowserLink, PageMode
from runtime.config import Settings, changed, load_settings, with_options
from runtime.daemon.build import RunOptions
from runtime.daemon.client import DaemonClient, trial_folder
from runtime.daemon.supervise import run_daemon
from runtime.page.connections import LOOPBACK, listening, server_of
from runtime.page.server import application

SIZE_PX = {"width_px": 960, "height_px": 540}  # without [stack], because small panels get more solutions per second
SCENE = "room"  # scene shown without a configuration file
WEBCAM_FOV_DEG = 65.0  # typical of webcams; can be changed in a configuration file
SLOW_PAGE_S = 2.0  # the page's camera counts as lost if no picture arrives for this long


def settings_of(
    config: Path | None, *, scene: str | None, layout: str | None, model: str | None, webcam: bool
) -> Settings:
    """Return the settings for `phasestack try`. Raises InputError if a setting or option is invalid."""
    settings = load_settings(config)
    if "stack" not in settings.model_fields_set:
        settings = changed(settings, "stack", SIZE_PX, source="try")
    settings = with_options(settings, scene=scene or (None if config else SCENE), layout=layout, model=model)
    if settings.sensor.driver != "usb-camera" or not webcam:
        sensor: dict[str, Any] = (
            {"driver": "usb-camera", "source": "", "fov_deg": WEBCAM_FOV_DEG} if webcam else {"driver": "browser"}
        )
        sensor["timeout_s"] = SLOW_PAGE_S
        settings = changed(settings, "sensor", sensor, source="try")
    return settings


def try_display(settings: Settings, *, port: int, opens: bool, seconds: float | None, as_json: bool) -> None:
    """Serve the page on a port (0: any) and run the daemon until it is stopped or after `seconds`.
    `opens` opens the page in a browser if there is a graphical session; `as_json` prints its address as JSON. Raises
    InputError if the port is in use, or for the settings.
    """
    is_sensor = settings.sensor.driver == "browser"
    stack, fov_deg, heads = settings.stack.stack(), settings.content.fov_deg, settings.most_viewers
    link = BrowserLink(PageMode(stack, fov_deg, is_sensor=is_sensor, heads=heads))
    ends_s = float("inf") if seconds is None else time.monotonic() + seconds

    def until() -> str:
        if link.wishes:
            return f"the page changed {', '.join(link.wishes)}"
        return "reached the time limit" if time.monotonic() > ends_s else ""

    with tempfile.TemporaryDirectory(prefix="phasestack-", dir=trial_folder()) as folder:
        socket = Path(folder) / "status.sock"
        service = {"socket": str(socket), "blackbox_minutes": 0.0}
        settings = changed(settings, "service", service, source="try")
        with _served(link, socket, port) as url:
            typer.echo(json.dumps({"url": url}) if as_json else f"open this address: {url}")
            if opens and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
                webbrowser.open(url)
            while True:
                run_daemon(partial(_as_it_is, settings), RunOptions(measure=True, browser=link, until=until))
                if not link.wishes:
                    return
                settings = _as_wished(settings, link)


def _as_it_is(settings: Settings) -> Settings:
    return settings


def _as_wished(settings: Settings, link: BrowserLink) -> Settings:
    """Return the settings with the page's gap and the current scene and model, and begin again with its camera."""
    wishes, told, mode = link.wishes, link.shown.told, link.mode
    settings = with_options(settings, scene=told.get("scene"), model=told.get("model"))
    if "gap_mm" in wishes:
        middle = (len(settings.stack.x_m) - 1) / 2
        x_m = tuple((n - middle) * wishes["gap_mm"] * 1e-3 for n in range(len(settings.stack.x_m)))
        settings = changed(settings, "stack", {"x_m": x_m}, source="try")
    if "camera" in wishes:
        mode = replace(mode, is_camera=bool(wishes["camera"]), is_sensor=not wishes["camera"])
    link.begin_again(replace(mode, stack=settings.stack.stack()))
    return settings


@contextmanager
def _served(link: BrowserLink, socket: Path, port: int) -> Iterator[str]:
    """Serve the page on a thread and yield its address, including the token."""
    token, served = secrets.token_urlsafe(32), listening("try", port)
    server = server_of(application(DaemonClient((socket,)), token, link=link))
    sockets: dict[str, Any] = {"sockets": [served]}
    thread = threading.Thread(target=server.run, kwargs=sockets, name="page", daemon=True)
    thread.start()
    try:
        yield f"http://{LOOPBACK}:{served.getsockname()[1]}/?token={token}"
    finally:
        server.should_exit = True
        thread.join(timeout=5.0)
