"""Tests with a system call tracer that a run writes only to --out and opens no connection."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CALLS = (
    "socket,connect,bind,sendto,sendmsg,open,openat,creat,mkdir,mkdirat,rename,renameat,renameat2,symlink,link,linkat"
)
LINE = re.compile(r"^\d+\s+(\w+)\((.*)\)\s+= (-?\d+)")
QUOTED = re.compile(r'"((?:[^"\\]|\\.)*)"')
WRITES = re.compile(r"O_WRONLY|O_RDWR|O_CREAT|O_TRUNC|O_APPEND")
NAME_SERVICE = "/var/run/nscd/socket"  # the C library asks it for users and groups


def run_traced(folder: Path, *arguments: str) -> tuple[list[str], list[str]]:
    """Run a command with a fresh home; returns the files it wrote outside `out`, and its outside connections."""
    home, scratch, trace = folder / "home", folder / "tmp", folder / "trace"
    for path in (home, scratch):
        path.mkdir()
    environment = {
        "PATH": os.environ["PATH"],
        "HOME": str(home),
        "TMPDIR": str(scratch),
        "PYTHONPATH": str(ROOT),
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    command = [sys.executable, "-m", "runtime.cli", *arguments]
    traced = ["strace", "-f", "-qq", "-s", "4096", "-e", f"trace={CALLS}", "-o", str(trace), *command]
    done = subprocess.run(traced, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    written, sockets = [], []
    for line in trace.read_text(errors="replace").splitlines():
        match = LINE.match(line)
        if match is None or int(match[3]) < 0:
            continue
        call, given = match[1], match[2]
        if call in ("socket", "connect", "bind", "sendto", "sendmsg"):
            local = "AF_UNIX" in given or "AF_LOCAL" in given
            connected = call == "sendmsg" and "msg_name=NULL" in given  # by a connect in this trace, or a socketpair
            if (call == "socket" and not local) or (call != "socket" and NAME_SERVICE not in given and not connected):
                sockets.append(line)
        elif call not in ("open", "openat") or WRITES.search(given):
            name = next(iter(reversed(QUOTED.findall(given))), "")
            if not name.startswith((f"{folder}/out", "/dev/", "/proc/")):
                written.append(line)
    left = [str(path) for place in (home, scratch) for path in place.rglob("*")]
    return written + left, sockets


@pytest.mark.skipif(shutil.which("strace") is None, reason="needs strace")
@pytest.mark.parametrize(
    "command",
    [
        "run --replay demo --headless --max-speed --frames 3 --scale 0.1 --out {out}",
        "record --seconds 0.5 --out {out}/a.mcap",
    ],
    ids=lambda command: " ".join(command.split()[:3]),
)
def test_a_command_writes_only_where_it_is_told_and_opens_no_connection(tmp_path: Path, command: str) -> None:
    written, sockets = run_traced(tmp_path, *command.format(out=tmp_path / "out").split())
    assert written == [] and sockets == []
