"""Error classes. Transient errors hold, degrade and retry; fatal ones refuse to start (exit code 2)."""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART_CHARACTERS_MAX = 300  # limit per part of a message: untrusted names must not fill the screen or forge log lines
PROBLEM_CHARACTERS_MAX = 1500  # limit for all problems of a file together
_USER_OF_ADDRESS = re.compile(r"""(:/{1,2})[^/\s'"]*@""")  # normalised paths have one slash
# System errors for a lack of resources or a temporary hardware failure.
PASSING = frozenset(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ENOBUFS, errno.EINTR)
)


def without_secrets(text: str) -> str:
    """Return the text with user names and passwords (before an `@`) removed from addresses.

    >>> without_secrets("rtsp://user:a@b@host/door"), without_secrets("/etc/rtsp:/user:a@host/door")
    ('rtsp://host/door', '/etc/rtsp:/host/door')
    """
    return _USER_OF_ADDRESS.sub(r"\1", text) if ":/" in text else text


def one_line(text: str, *, most: int = PART_CHARACTERS_MAX) -> str:
    r"""Return the text as one printable line without secrets; `...` replaces the middle of a long one.

    >>> one_line("a\nb"), one_line("x" * 9, most=7)
    ('a?b', 'xx...xx')
    """
    text = without_secrets(text)
    if len(text) > most:
        half = (most - 3) // 2
        text = f"{text[:half]}...{text[-half:]}"
    return "".join(c if c.isprintable() else "?" for c in text)


class PhasestackError(Exception):
    """Base of all errors that phasestack raises on purpose."""


class FatalError(PhasestackError):
    """A failure that retrying cannot fix; the CLI prints one line and exits with 2."""


class InputError(FatalError):
    """Wrong input from a user. The message names the file (or option) and the field.

    >>> str(InputError("panels.toml", "x_m", "must ascend"))
    'panels.toml: x_m: must ascend'
    """

    def __init__(self, source: str | Path, field: str, problem: str) -> None:
        self.source, self.field, self.problem = str(source), field, problem
        where = [one_line(part) for part in (self.source, field) if part]
        super().__init__(": ".join([*where, one_line(problem, most=PROBLEM_CHARACTERS_MAX)]))

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        return type(self), (self.source, self.field, self.problem)


class MissingPart(FatalError):
    """A required optional package is not installed; the message names it."""


class TransientError(PhasestackError):
    """A failure that may pass. The daemon holds the last good frame, degrades and retries."""


class SensorLost(TransientError):
    """The sensor is gone, hangs or delivers invalid data. It is closed, and reopened with back-off."""


class SensorTimeout(TransientError):
    """No new sample arrived in time; the sensor may still be working."""


class EndOfRecording(TransientError):
    """A replayed source has no more samples."""


class ContentFailure(TransientError):
    """The content source could not draw this frame. The last good picture stays."""


class ModelFailure(TransientError):
    """Inference failed or returned invalid layers. The last good layers stay."""


class EyesNotServed(ModelFailure):
    """The model does not support these eye positions.

    Positions of a moving viewer may become valid again; positions given as an option are refused.
    """


class ContextLost(TransientError):
    """The solver's GL context is lost, so the solver must be rebuilt from the settings."""


class PanelLost(TransientError):
    """A panel's window, monitor or GL context is lost. The loop continues and tries to rebuild it."""


class Stopped(PhasestackError):
    """The daemon was asked to stop while it was starting."""


@contextmanager
def retry_advised() -> Iterator[None]:
    """Convert errors that may be temporary to TransientError (exit code 75): another start may help."""
    try:
        yield
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        raise TransientError(f"{str(error) or type(error).__name__} (temporary: try again)") from error


def is_retryable(error: BaseException | None) -> bool:
    """Return True if an exception, or its context, is a temporary failure of the machine, not bad input.

    Readers convert a system error to an InputError that names the file; the system error remains its context.
    """
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False
