"""Find the running daemon's socket, send a request as one JSON line and read the answer."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from runtime.errors import TransientError

# Same as `ServiceSettings().socket`, but available without loading the settings.
DEFAULT_SOCKET = "/run/phasestack/status.sock"
UNIT = "phasestack"
REQUEST_MAX_BYTES = 65536  # maximum length of a request, which limits how much memory a client can use up
REQUEST_S = 5.0  # time limit for receiving a request and for sending the answer
# Seconds for which the answer to each request is cached.
LOOKED_UP_AGAIN_S = {"status": 0.2, "pictures": 0.3, "log": 0.5, "about": 2.0}
LOOKED_UP_WITHIN_S = 3.0  # time limit for answers not given by the loop; after that, the page reports a hang
LOADED_WITHIN_S = 60.0  # after this time, a command is answered even if its scene or model is still loading
ANSWERED_WITHIN_S = LOADED_WITHIN_S + 10.0  # how long a client waits for the answer to a command
HUNG_AFTER_S = 5.0  # the loop counts as hung if it completes no turn for this long


def user_socket() -> Path | None:
    """Return the socket used by a daemon started in a user's session, or None outside a session."""
    runtime_dir = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(runtime_dir) / "phasestack" / "status.sock" if runtime_dir else None


def candidates(configured: str) -> tuple[Path, ...]:
    """Return the configured socket and, inside a user's session, also the session's socket."""
    own = user_socket()
    return (Path(configured),) if own is None else (Path(configured), own)


def trial_folder() -> Path:
    """Return where each `phasestack try` has a folder `phasestack-*` with its socket."""
    session = os.environ.get("XDG_RUNTIME_DIR", "")
    return Path(session) if session and Path(session).is_dir() else Path(tempfile.gettempdir())


def sockets(config: Path | None) -> tuple[Path, ...]:
    """Return the sockets to try for a configuration file, or the default ones and those of each
    `phasestack try` of this user, newest first. Raises InputError.
    """
    if config is None:  # do not load the settings, because that would slow clients down
        trials = []
        for path in trial_folder().glob("phasestack-*/status.sock"):
            with contextlib.suppress(OSError):
                if (stat := path.stat()).st_uid == os.getuid():
                    trials.append((stat.st_mtime, path))
        return *candidates(DEFAULT_SOCKET), *(path for _, path in sorted(trials, reverse=True))
    from runtime.config import load_settings

    return candidates(load_settings(config).service.socket)


class NotRunning(TransientError):
    """Raised when no daemon answers. The message says what failed at each socket and may give a remedy."""

    hangs = False  # True if a daemon accepted the connection but did not answer


def ask(paths: Iterable[Path], request: dict[str, Any], *, timeout_s: float = 10.0) -> dict[str, Any]:
    """Send a JSON request to the first socket where a daemon answers, and return the answer. `timeout_s`
    limits each socket operation. Raises NotRunning if no daemon answers on any of the sockets.
    """
    problems, hangs = [], False
    for path in paths:
        try:
            return _exchanged(path, request, timeout_s)
        except (OSError, ValueError) as error:
            problems.append(f"{path}: {_advice(error)}")
            hangs |= isinstance(error, TimeoutError)
    silent = NotRunning("; ".join(problems) or "no socket is configured; set service.socket")
    silent.hangs = hangs
    raise silent


def _exchanged(path: Path, request: dict[str, Any], timeout_s: float) -> dict[str, Any]:
    """Send a JSON line and return the decoded answer. Raises OSError, or ValueError if it is not a JSON object."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as channel:
        channel.settimeout(timeout_s)
        channel.connect(str(path))
        with contextlib.suppress(
            BrokenPipeError, ConnectionResetError
        ):  # the daemon has refused the request, and the answer says why
            channel.sendall(json.dumps(request).encode() + b"\n")
        with channel.makefile("rb") as answers:
            line = answers.readline()
    if not line:
        raise ConnectionResetError("the daemon closed the connection without an answer")
    answer = json.loads(line)
    if not isinstance(answer, dict):
        raise ValueError("the answer is not a JSON object")
    return answer


def _advice(error: Exception) -> str:
    match error:
        case FileNotFoundError():
            return "no daemon is listening"
        case PermissionError():
            return "permission denied; add this user to the group phasestack"
        case ConnectionRefusedError():
            return "the daemon has died"
        case TimeoutError():
            return "the daemon did not answer in time"
    return str(error) or type(error).__name__


def unit_properties(*names: str) -> dict[str, str]:
    """Return some of the systemd unit's properties, or an empty dictionary if it is not installed."""
    command = ["systemctl", "show", UNIT, f"--property=LoadState,{','.join(names)}"]
    try:
        shown = subprocess.run(command, capture_output=True, text=True, timeout=5.0).stdout
    except (OSError, subprocess.TimeoutExpired):
        return {}
    unit = dict(line.partition("=")[::2] for line in shown.splitlines())
    return unit if unit.get("LoadState") == "loaded" else {}


def unit_advice() -> str:
    """Describe the systemd unit's state, its last error and a remedy. Returns "" if it is not installed."""
    unit = unit_properties("ActiveState", "Result", "ExecMainStatus", "StatusText")
    if not unit:
        return ""
    why = f"{unit['Result']}, exit status {unit['ExecMainStatus']}: {unit['StatusText'] or 'no message'}"
    match unit["ActiveState"], unit["Result"]:
        case "failed", "start-limit-hit":
            return f"{UNIT} failed too often; run: sudo systemctl reset-failed {UNIT}; sudo systemctl start {UNIT}"
        case "failed", _:
            return f"{UNIT} has failed ({why}); fix the error, then run: sudo systemctl restart {UNIT}"
        case "inactive", _:
            return f"{UNIT} is stopped; run: sudo systemctl start {UNIT}"
        case "activating" | "deactivating", _:
            return f"{UNIT} is restarting; see the log: journalctl -u {UNIT} -n 20"
    return (
        f"{UNIT} is {unit['ActiveState']}; if its configuration sets service.socket, pass that configuration "
        "with --config"
    )


class DaemonClient:
    """Thread-safe client for the operator's page. Cached answers are shared by all browsers."""

    def __init__(self, sockets: tuple[Path, ...]) -> None:
        """Create a client that tries these sockets in order."""
        self._sockets = sockets
        self._locks = {name: threading.Lock() for name in LOOKED_UP_AGAIN_S}
        self._answers: dict[str, tuple[float, dict[str, Any]]] = {}

    def look_up(self, name: str) -> dict[str, Any]:
        """Return the maybe cached answer to `status`, `pictures`, `log` or `about`; its `ok` may be False."""
        with self._locks[name]:
            asked_s, answer = self._answers.get(name, (float("-inf"), {}))
            if time.monotonic() - asked_s < LOOKED_UP_AGAIN_S[name]:
                return answer
            answer = self._asked({"command": name}, timeout_s=LOOKED_UP_WITHIN_S)
            self._answers[name] = time.monotonic(), answer
        return answer

    def tell(self, command: str, value: Any) -> dict[str, Any]:
        """Send a command and return the answer. If no daemon answers, the returned `ok` is False."""
        return self._asked({"command": command, "value": value}, timeout_s=ANSWERED_WITHIN_S)

    def _asked(self, request: dict[str, Any], *, timeout_s: float) -> dict[str, Any]:
        try:
            return ask(self._sockets, request, timeout_s=timeout_s)
        except NotRunning as error:
            return {"ok": False, "running": False, "hangs": error.hangs, "error": str(error)}
