"""Trial loading of untrusted files in a process with limited memory and time.

The display goes on meanwhile, and only what came through is loaded into it.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from runtime.config import Settings
from runtime.content.registry import prepare_content
from runtime.daemon.solver_parts import ready_predictor
from runtime.errors import FatalError, InputError, PhasestackError, Stopped
from runtime.model.predictor import SHIPPED
from runtime.support.untrusted_input import LIMITS

MEMORY_MAX = 4 << 30  # of data; what a scene at every limit takes
MODEL_S = 30.0  # to load a model and solve with it twice, at 1920x1080 on a slow PC
AGAIN_S = 0.05  # between two looks


def try_out(settings: Settings, *, content: bool, model: bool, wanted: Callable[[], bool]) -> None:
    """Make ready what the settings name, where it is a file, and throw it away.

    wanted: asked now and then. Raises InputError and FatalError, in the words of whoever refused it, and Stopped.
    """
    scene, name = settings.content.scene, settings.model.name
    parts = {"content": (scene, LIMITS.load_s)} if content and Path(scene).is_file() else {}
    parts |= {"model": (name, MODEL_S)} if model and name not in SHIPPED and Path(name).is_file() else {}
    for part, (file, seconds) in parts.items():
        command = [sys.executable, "-P", "-m", "runtime.daemon.trial", part, str(MEMORY_MAX)]
        environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment
        ) as child:
            try:
                told = _outcome(child, settings.model_dump_json().encode(), seconds, wanted)
            except TimeoutError:
                raise InputError(file, "", f"is not ready after {seconds:g} s") from None
            finally:
                child.kill()
        if child.returncode == 2:
            raise FatalError(told)
        if child.returncode:
            why = f"takes more than {MEMORY_MAX >> 20} MiB, or ends the process that reads it ({child.returncode})"
            raise InputError(file, "", why)


def _outcome(child: subprocess.Popen[bytes], given: bytes, seconds: float, wanted: Callable[[], bool]) -> str:
    """What it says, once it has ended."""
    assert child.stdin is not None and child.stdout is not None
    with suppress(BrokenPipeError):
        child.stdin.write(given)
        child.stdin.close()
    for _ in range(round(seconds / AGAIN_S)):
        try:
            child.wait(AGAIN_S)
            return child.stdout.read().decode(errors="replace").strip()
        except subprocess.TimeoutExpired:
            if not wanted():
                raise Stopped("a newer change came") from None
    raise TimeoutError


def main(part: str, memory: int) -> int:
    """Entry point of the child process."""
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    settings = Settings.model_validate_json(sys.stdin.read())
    try:
        if part == "content":
            prepare_content(settings.content, settings.stack.stack())
        else:
            ready_predictor(settings, settings.stack.stack())
    except PhasestackError as error:
        print(error)
        return 2
    return 0


if __name__ == "__main__":
    code = main(sys.argv[1], int(sys.argv[2]))
    sys.stdout.flush()
    os._exit(code)
