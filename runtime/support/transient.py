"""What may pass by itself, told from what is wrong for good: a full disk is no bad configuration."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager

from runtime.errors import TransientError

# The system has none left, or its hardware failed this once.
PASSING = frozenset(
    (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EIO, errno.ENOSPC, errno.EDQUOT, errno.ENOBUFS, errno.EINTR)
)


@contextmanager
def retry_advised() -> Iterator[None]:
    """What may pass becomes a TransientError: exit 75, start again."""
    try:
        yield
    except Exception as error:
        if isinstance(error, TransientError) or not is_retryable(error):
            raise
        raise TransientError(f"{str(error) or type(error).__name__} (this may pass: start again)") from error


def is_retryable(error: BaseException | None) -> bool:
    """Whether anything in an exception's chain is the machine's trouble of the moment, and not its input.

    Readers turn what the system refuses into an InputError that names the file; the system's own error is still its
    context.
    """
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno in PASSING):
            return True
        error = error.__cause__ or error.__context__
    return False
