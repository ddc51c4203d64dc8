"""Runs the page's server on a free port of loopback."""

from __future__ import annotations

import http.client
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
CONFIGURATION = """
[stack]
width_px = {width}
height_px = {height}
[sensor]
driver = "replay"
source = "demo"
loop = true
[model]
name = "fast"
threads = 1
backend = "cpu"
[loop]
rate_hz = 60.0
[service]
socket = "s.sock"
"""


class Page:
    """A running `phasestack page`."""

    def __init__(self, port: int, token: str) -> None:
        self.port, self.token = port, token
        self.bearer = {"Authorization": f"Bearer {token}"}

    @property
    def origin(self) -> str:
        return f"http://localhost:{self.port}"

    def ask(
        self, method: str, path: str, *, body: str | None = None, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """(status, headers in lower case, body); a header's name is written with underscores."""
        channel = http.client.HTTPConnection("localhost", self.port, timeout=90)
        try:
            given = {"Host": f"localhost:{self.port}"}
            given |= {name.replace("_", "-"): value for name, value in headers.items()}
            channel.request(method, path, body=body, headers=given)
            answer = channel.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            channel.close()

    def look_up(self, name: str) -> dict[str, Any]:
        return json.loads(self.ask("GET", f"/now/{name}", **self.bearer)[2])

    def tell(self, command: str, value: Any = None, **headers: str) -> tuple[int, dict[str, Any]]:
        """From a program that gives the token."""
        body = json.dumps({"command": command, "value": value})
        code, _, answer = self.ask("POST", "/do", body=body, **(self.bearer | headers))
        return code, json.loads(answer)


@contextmanager
def page_of(socket: Path, folder: Path) -> Iterator[Page]:
    """`phasestack page` for a daemon's socket, whether that is there or not."""
    token_file, config = folder / "token", folder / "page.toml"
    config.write_text(f'[service]\nsocket = "{socket}"\n')
    command = [sys.executable, "-m", "runtime.cli", "page", "--config", str(config), "--port", "0"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [*command, "--token-file", str(token_file)], cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stderr is not None
            line = process.stderr.readline()
            found = re.search(r"http://127\.0\.0\.1:(\d+)/", line)
            assert found, line
            yield Page(int(found[1]), token_file.read_text().strip())
        finally:
            process.terminate()
            process.wait(timeout=60)


@contextmanager
def short_folder() -> Iterator[Path]:
    """A socket's path is at most a hundred bytes long."""
    with tempfile.TemporaryDirectory(prefix="ps-") as name:
        yield Path(name)
