"""Entry point of the script `phasestack`, imported first so that Ctrl-C exits silently with 130.

While commands are imported, no file is open, so an interrupt can simply exit the process. An exception would print a
traceback, or be lost where Python ignores it. Later, `commands.guard` takes over.
"""

# These modules are already loaded; importing `signal` would delay the handler by milliseconds.
import _signal  # type: ignore[import-not-found]
import os


def _leave(number: int, frame: object) -> None:
    os._exit(130)


if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:  # leave an ignored or handled signal alone
    _signal.signal(_signal.SIGINT, _leave)


def main() -> None:
    """Run the command named by the arguments; never returns."""
    from runtime.commands.guard import run_guarded

    run_guarded(interrupts_leave=_signal.getsignal(_signal.SIGINT) is _leave)


if __name__ == "__main__":
    main()
