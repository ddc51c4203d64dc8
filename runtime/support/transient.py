"""What may pass by itself, told from what is wrong for good: a full disk is no bad configuration."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from runtime.errors import PhasestackError, TransientError

# The system has none left, or its hardware failed this once.
PASSING = frozenset(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ENOBUFS, errno.EINTR)
)
# The same in the words of libraries that raise exceptions of their own.
WORDS = (
    "too many open files",
    "cannot allocate memory",
    "failed to map segment",  # of a library, where memory is limited
    "failed to allocate memory",
    "bad_alloc",
    "out of memory",
    "input/output error",
    "no space left on device",
    "can't start new thread",
    "resource temporarily unavailable",
)


class RetryableError(TransientError):
    """The machine lacked something: start again. Its text is that of what went wrong."""


@contextmanager
def retry_advised() -> Iterator[None]:
    """What may pass becomes a RetryableError: exit 75, start again."""
    try:
        yield
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        raise RetryableError(f"{str(error) or type(error).__name__} (this may pass: start again)") from error


def is_retryable(error: BaseException | None) -> bool:
    """Whether anything in an exception's chain is the machine's trouble of the moment, and not its input.

    Readers turn what the system refuses into an InputError that names the file; the system's own error is still its
    context.
    """
    return any(_passes(link) for link in _chain(error))


def _passes(error: BaseException) -> bool:
    if isinstance(error, MemoryError):
        return True
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in PASSING
    if isinstance(error, PhasestackError):
        return False  # its words may be a user's
    text = str(error).lower()
    return any(word in text for word in WORDS)


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    """An exception, what it was raised from and what was being handled then."""
    seen: set[int] = set()
    waiting = [error]
    while waiting:
        link = waiting.pop()
        if link is not None and id(link) not in seen:
            seen.add(id(link))
            yield link
            waiting += [link.__cause__, link.__context__]
