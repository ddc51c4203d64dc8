"""Exception classes, and functions that clean and classify errors.

After a transient error, the daemon keeps the last good frame, degrades and retries. After a fatal error, the program
exits with code 2.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART_CHARACTERS_MAX = 300  # limit for each part of a message, because an untrusted name must not fill the screen
PROBLEM_CHARACTERS_MAX = 1500  # limit for the description of all problems in a file
_USER_OF_ADDRESS = re.compile(r"""(:/{1,2})[^/\s'"]*@""")  # a URL that was converted to a path has only one slash
# System errors that indicate a lack of resources, a hardware failure that may be temporary, or an interrupted call.
PASSING = frozenset(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ENOBUFS, errno.EINTR)
)


def without_secrets(text: str) -> str:
    """Return the text without the user names and passwords that precede an `@` in URLs.

    >>> without_secrets("rtsp://user:a@b@host/door"), without_secrets("/etc/rtsp:/user:a@host/door")
    ('rtsp://host/door', '/etc/rtsp:/host/door')
    """
    return _USER_OF_ADDRESS.sub(r"\1", text) if ":/" in text else text


def one_line(text: str, *, most: int = PART_CHARACTERS_MAX) -> str:
    r"""Return the text as one printable line without secrets.

    Each unprintable character becomes `?`, which keeps untrusted text from forging log lines. In a text of more than
    `most` characters, `...` replaces the middle.

    >>> one_line("a\nb"), one_line("x" * 9, most=7)
    ('a?b', 'xx...xx')
    """
    text = without_secrets(text)
    if len(text) > most:
        half = (most - 3) // 2
        text = f"{text[:half]}...{text[-half:]}"
    return "".join(c if c.isprintable() else "?" for c in text)


class PhasestackError(Exception):
    """Base class of all errors that phasestack raises on purpose."""


class FatalError(PhasestackError):
    """A failure that retrying cannot fix. The command line prints the message and exits with code 2."""


class InputError(FatalError):
    """Invalid input from a user. The message names the file or option, and the invalid field.

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
    """A package or library that the requested function needs is missing. The message names that part."""


class TransientError(PhasestackError):
    """A failure that may be temporary. The daemon keeps the last good frame, degrades and retries."""


class SensorLost(TransientError):
    """The sensor is disconnected, hangs or delivers invalid data.

    The sensor thread closes the sensor and reopens it, with a delay that doubles up to a maximum.
    """


class SensorTimeout(TransientError):
    """No new sample arrived in time, although the sensor may still be working."""


class EndOfRecording(TransientError):
    """The recording that is being replayed has no more samples."""


class ContentFailure(TransientError):
    """The content source could not draw this frame. The display keeps the last good picture."""


class ModelFailure(TransientError):
    """Inference failed or returned invalid layers. The panels keep the last good layers."""


class EyesNotServed(ModelFailure):
    """The model does not support the requested eye positions.

    A moving viewer may return to supported positions. Unsupported positions in a command's options are refused.
    """


class ContextLost(TransientError):
    """The solver's GL context is lost, so the solver must be rebuilt from the settings."""


class PanelLost(TransientError):
    """The window, monitor or GL context of a panel is lost.

    The display loop continues and tries to rebuild the panels.
    """


class Stopped(PhasestackError):
    """The daemon was asked to stop while it was starting."""


@contextmanager
def retry_advised() -> Iterator[None]:
    """Convert temporary failures of the machine to TransientError.

    The exit code of a TransientError, 75, advises the caller to start the program again.
    """
    try:
        yield
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        raise TransientError(f"{str(error) or type(error).__name__} (temporary: try again)") from error


def is_retryable(error: BaseException | None) -> bool:
    """Return True if any exception in a chain is a temporary failure of the machine, not bad input.

    Functions that read files convert a system error to an InputError that names the file. The system error stays in
    the chain of causes and contexts.
    """
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False
