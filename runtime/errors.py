"""Exception classes, and functions that clean up messages and classify errors.

After a transient error, the daemon keeps the last good frame, degrades and retries. After a fatal error, the program
exits with code 2.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

PART_CHARACTERS_MAX = 300  # limit for each part of a message, so that an untrusted name cannot fill the screen
PROBLEM_CHARACTERS_MAX = 1500  # limit for a description of all the problems in a file
_USER_OF_ADDRESS = re.compile(r"""(:/{1,2})[^/\s'"]*@""")  # a URL that was converted to a path has only one slash
# System errors caused by a lack of resources, a hardware failure that may be temporary, or an interrupted call.
PASSING = frozenset(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ENOBUFS, errno.EINTR)
)


def without_secrets(text: str) -> str:
    """Return the text with any user names and passwords before an `@` in URLs removed.

    >>> without_secrets("rtsp://user:a@b@host/door"), without_secrets("/etc/rtsp:/user:a@host/door")
    ('rtsp://host/door', '/etc/rtsp:/host/door')
    """
    return _USER_OF_ADDRESS.sub(r"\1", text) if ":/" in text else text


def one_line(text: str, *, most: int = PART_CHARACTERS_MAX) -> str:
    r"""Return the text as one printable line without secrets.

    Each unprintable character is replaced by `?`, so that untrusted text cannot forge log lines. If the text is longer
    than `most` characters, its middle is replaced by `...`.

    >>> one_line("a\nb"), one_line("x" * 9, most=7)
    ('a?b', 'xx...xx')
    """
    text = without_secrets(text)
    if len(text) > most:
        half = (most - 3) // 2
        text = f"{text[:half]}...{text[-half:]}"
    return "".join(c if c.isprintable() else "?" for c in text)


class PhasestackError(Exception):
    """Base class for all errors that phasestack raises on purpose."""


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
    """A package or library needed by the requested function is missing. The message names it."""


class TransientError(PhasestackError):
    """A failure that may be temporary. The daemon keeps the last good frame, degrades and retries."""


class SensorLost(TransientError):
    """The sensor is disconnected, hangs or delivers invalid data. It is reopened, later and later."""


class SensorTimeout(TransientError):
    """No new sample arrived in time, although the sensor may still be working."""


class EndOfRecording(TransientError):
    """The recording being replayed has no more samples."""


class ContentFailure(TransientError):
    """The content source could not draw this frame. The display keeps the last good picture."""


class ModelFailure(TransientError):
    """Inference failed or returned invalid layers. The panels keep the last good layers."""


class EyesNotServed(ModelFailure):
    """The model does not support the requested eye positions. The failure is transient because a moving
    viewer may return to a supported position. Unsupported positions given in a command's options are refused.
    """


class ContextLost(TransientError):
    """The solver's GL context is lost, so the solver must be rebuilt from the settings."""


class PanelLost(TransientError):
    """A panel's window, monitor or GL context is lost. The display loop tries to rebuild the panels."""


class Stopped(PhasestackError):
    """The daemon was asked to stop while it was starting."""


@contextmanager
def retry_advised() -> Iterator[None]:
    """Convert temporary machine failures to TransientError, whose exit code, 75, advises to start again."""
    try:
        yield
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        reason = str(error) or ("not enough memory" if isinstance(error, MemoryError) else type(error).__name__)
        raise TransientError(f"{reason} (temporary: try again)") from error


def is_retryable(error: BaseException | None) -> bool:
    """Return True if any exception in the chain is a temporary machine failure rather than bad input.
    Functions that read files convert a system error to an InputError that names the file, but the system error stays in
    the chain of causes and contexts.
    """
    while error is not None:
        if is_out_of_memory(error) or (isinstance(error, OSError) and error.errno in PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False


def is_out_of_memory(error: BaseException) -> bool:
    """Return True for a MemoryError, ENOMEM, or an import for whose shared library there is no memory."""
    if isinstance(error, ImportError):  # the dynamic linker reports no error number
        return any(reason in str(error) for reason in ("failed to map segment", "cannot allocate memory"))
    return isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
