"""Entry point of the `phasestack` command, which installs an early handler for Ctrl-C.

While the commands are being imported, Ctrl-C exits the process silently with code 130; no file is open yet. An
exception would print a traceback, or be lost where Python ignores it. Then `commands.guard` handles interrupts.
"""

# These modules are already loaded; importing `signal` would delay the handler by milliseconds.
import _signal  # type: ignore[import-not-found]
import os


def _leave(number: int, frame: object) -> None:
    os._exit(130)


if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:  # leave an ignored or handled signal alone
    _signal.signal(_signal.SIGINT, _leave)


# Matrices are small here. OpenBLAS keeps a buffer for each thread, and ends the process if there is no room for it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main() -> None:
    """Run the command that the arguments name, then exit the process. Never returns."""
    from runtime.commands.guard import run_guarded

    run_guarded(interrupts_leave=_signal.getsignal(_signal.SIGINT) is _leave)


if __name__ == "__main__":
    main()
