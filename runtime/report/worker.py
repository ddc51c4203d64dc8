"""A process of its own for one measurement: `python -m runtime.report.worker` reads a call, writes its result.

Both are pickles between the two ends of one program on one machine, over pipes that nobody else holds.
"""

from __future__ import annotations

import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from runtime.errors import FatalError, PhasestackError

P = ParamSpec("P")
T = TypeVar("T")


def apart(function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """Call an importable function in a fresh process: its memory and threads are its own.

    Raises FatalError with what the function raises of phasestack's own errors, and where the process dies.
    """
    call = pickle.dumps((function, args, kwargs))
    done = subprocess.run([sys.executable, "-m", "runtime.report.worker"], input=call, capture_output=True, check=False)
    if done.returncode != 0:
        last = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise FatalError(f"{function.__name__}: the measuring process ended with {done.returncode}: {last}")
    result: T | FatalError = pickle.loads(done.stdout)
    if isinstance(result, FatalError):
        raise result
    return result


def main() -> None:
    """Answer one call from stdin on stdout; whatever the call prints goes to stderr."""
    answer = sys.stdout.buffer
    sys.stdout = sys.stderr
    function, args, kwargs = pickle.load(sys.stdin.buffer)
    try:
        result = function(*args, **kwargs)
    except PhasestackError as error:
        result = FatalError(str(error))
    pickle.dump(result, answer)


if __name__ == "__main__":
    main()
