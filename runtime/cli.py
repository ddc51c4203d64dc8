"""Entry point of the script `phasestack`: imported first, so that Ctrl-C exits silently with 130.

Nothing is open or written while commands are imported, so an interrupt needs no unwinding; as an exception it would
end in a traceback, or be lost where Python drops it. The guard takes over once it stands (`commands.guard`).
"""

# The interpreter has these two already: `signal` itself would take milliseconds before the handler is there.
import _signal  # type: ignore[import-not-found]
import os


def _leave(number: int, frame: object) -> None:
    os._exit(130)


if _signal.getsignal(_signal.SIGINT) is _signal.default_int_handler:  # one that is ignored or handled stays so
    _signal.signal(_signal.SIGINT, _leave)


def main() -> None:
    """Run the command that the arguments name; never returns."""
    from runtime.commands.guard import run_guarded

    run_guarded(interrupts_leave=_signal.getsignal(_signal.SIGINT) is _leave)


if __name__ == "__main__":
    main()
