"""Tests that every command ends with an exit code and at most one line on stderr."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import pytest

MAIN = "from runtime.cli import main; main()"
# A command that is broken in one of many ways, in place of `config`.
BROKEN = """
import sys, runtime.commands.app as commands, runtime.commands.config as module
def broken():
    {body}
commands.app.registered_commands = [c for c in commands.app.registered_commands if c.callback.__name__ != "config"]
commands.app.command("config")(broken)
from runtime.cli import main
main()
"""


def run(*arguments: str, code: str = MAIN, home: Path | None = None, **how: Any) -> subprocess.CompletedProcess[str]:
    environment = dict(os.environ)
    if home is not None:
        environment = {k: v for k, v in environment.items() if not k.startswith("XDG_")} | {"HOME": str(home)}
    how = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | how
    return subprocess.run([sys.executable, "-c", code, *arguments], text=True, timeout=120, env=environment, **how)


def broken(body: str, home: Path, **how: Any) -> subprocess.CompletedProcess[str]:
    return run("config", code=BROKEN.format(body=body), home=home, **how)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [("run --framez 3", "option: --framez (Possible"), ("calibrate solve", "option '--pairs'"), ("solv", "'solv'")],
)
def test_wrong_usage_is_one_line_and_2(arguments: str, told: str) -> None:
    answer = run(*arguments.split())
    assert answer.returncode == 2 and answer.stderr.startswith("phasestack: ") and told in answer.stderr
    assert answer.stderr.count("\n") == 1 and answer.stderr.endswith(" --help`\n")


@pytest.mark.parametrize("body", ["raise ValueError('two\\nlines\\0')", "(lambda f: f(f))(lambda f: f(f))"])
def test_an_error_that_nobody_expected_is_one_line_a_file_and_70(tmp_path: Path, body: str) -> None:
    answer = broken(body, tmp_path)
    assert answer.returncode == 70, answer.stderr
    assert answer.stderr.count("\n") == 1 and "Traceback" not in answer.stderr and len(answer.stderr) < 800
    (file,) = (tmp_path / ".local/state/phasestack").iterdir()
    assert str(file) in answer.stderr
    assert "Traceback" in file.read_text() and file.stat().st_mode & 0o777 == 0o600


def test_without_a_home_the_file_is_in_the_temporary_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = tmp_path / "file"
    home.write_text("not a folder")  # also where the tests' user may write anywhere
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    answer = broken("1 / 0", home)
    assert answer.returncode == 70 and f"{tmp_path}/phasestack-error-" in answer.stderr


def test_without_home_and_user_it_works(tmp_path: Path) -> None:
    """A container's user, whom no passwd knows, ended with 70."""
    nobody = "import os, pwd; os.environ.pop('HOME')\ndef unknown(uid): raise KeyError(uid)\npwd.getpwuid = unknown\n"
    done = run("demo", "--frames", "2", "--out", str(tmp_path / "out"), code=nobody + MAIN, home=tmp_path, cwd=tmp_path)
    assert done.returncode == 0 and (tmp_path / "out" / "layer-0.png").exists(), done.stderr
    told = f"{nobody}from runtime.support.folders import state_folder; print(state_folder())"
    assert run(code=told, home=tmp_path).stdout == f"{tempfile.gettempdir()}/phasestack-state-{os.geteuid()}\n"


def test_an_error_in_a_thread_is_told_so_too(tmp_path: Path) -> None:
    body = "import threading; t = threading.Thread(target=lambda: 1 / 0); t.start(); t.join()"
    answer = broken(body, tmp_path)
    assert answer.returncode == 0 and "ZeroDivisionError" in answer.stderr and "Traceback" not in answer.stderr


def test_without_memory_it_may_pass(tmp_path: Path) -> None:
    answer = broken("raise MemoryError", tmp_path)
    assert (answer.returncode, answer.stderr) == (75, "phasestack: out of memory; close other programs and try again\n")


@pytest.mark.parametrize(("error", "code"), [("FatalError", 2), ("PanelLost", 75)])
def test_what_may_pass_is_not_a_users_mistake(tmp_path: Path, error: str, code: int) -> None:
    answer = broken(f"from runtime import errors; raise errors.{error}('why')", tmp_path)
    assert (answer.returncode, answer.stderr) == (code, "phasestack: why\n")


def test_a_reader_that_goes_away_ends_it_silently(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", MAIN, "config"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    process.stdout.close()
    told = process.stderr.read()
    assert (process.wait(60), told) == (141, "")
    process.stderr.close()


def test_a_full_disk_behind_the_output_is_told() -> None:
    with open("/dev/full", "w") as full:  # noqa: PTH123
        answer = run("config", stdout=full)
    assert answer.returncode == 2
    assert answer.stderr == "phasestack: output: cannot be written: No space left on device\n"


def test_closed_descriptors_are_no_error_and_no_file_takes_their_place(tmp_path: Path) -> None:
    out = tmp_path / "a.mcap"
    command = f"{sys.executable} -c '{MAIN}' record --motion still --seconds 1 --out {out} >&- 2>&- <&-"
    assert subprocess.run(["sh", "-c", command], capture_output=True, timeout=60).returncode == 0
    assert out.read_bytes()[:5] == b"\x89MCAP" and out.read_bytes()[-8:] == b"\x89MCAP0\r\n"


@pytest.mark.parametrize("wait_s", [0.0, 0.07, 0.18, 0.25])
def test_an_interrupt_exits_silently_with_130_from_the_first_import_on(wait_s: float) -> None:
    process = subprocess.Popen([sys.executable, "-X", "importtime", "-c", MAIN, "doctor"], stderr=subprocess.PIPE)
    with process, process.stderr:
        while not process.stderr.readline().endswith(b"| runtime.cli\n"):
            pass
        time.sleep(wait_s)
        process.send_signal(signal.SIGINT)
        told = [line for line in process.stderr if not line.startswith(b"import time:")]
        assert (process.wait(60), told) == (130, [])


INTERRUPTED_IMPORT = """
import os, signal, sys, time, weakref

class Interrupt:
    def find_spec(self, name, path=None, target=None):
        if name == MODULE:
            held = type("Held", (), {})()
            # As in the release of a module's lock: what is raised in here goes nowhere.
            watch = weakref.ref(held, lambda _: (os.kill(os.getpid(), signal.SIGINT), time.sleep(0.05)))
            del held

MODULE = sys.argv.pop(1)
sys.meta_path.insert(0, Interrupt())
from runtime.cli import main
main()
"""


@pytest.mark.parametrize(
    "module", ["runtime.commands.guard", "typer", "runtime.commands.app", "runtime.daemon.supervise", "numpy"]
)
def test_an_interrupt_during_an_import_ends_the_command(module: str) -> None:
    """`run` once never ended: Python drops exceptions raised while it releases a module's lock."""
    replay = ["run", "--replay", "demo", "--headless", "--max-speed", "--frames", "1", "--scale", "0.1"]
    done = run(module, *replay, code=INTERRUPTED_IMPORT)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


@pytest.mark.parametrize("mib", [600, 900])
def test_too_little_memory_at_the_start_may_pass(mib: int, tmp_path: Path) -> None:
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (mib << 20, mib << 20))

    answer = run("run", "--replay", "demo", "--headless", "--frames", "2", home=tmp_path, preexec_fn=limit)
    assert answer.returncode == 75 and "memory" in answer.stderr.splitlines()[-1], answer.stderr


def test_a_crash_in_a_library_leaves_the_python_stack(tmp_path: Path) -> None:
    answer = broken("import ctypes; ctypes.string_at(0)", tmp_path)
    assert answer.returncode == -signal.SIGSEGV
    assert "Segmentation fault" in answer.stderr and "in broken" in answer.stderr
