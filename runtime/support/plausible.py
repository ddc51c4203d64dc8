"""Checks for settings: number ranges (with hints about units), valid paths, and misspelt names."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from pydantic import AfterValidator

from runtime.support.ranges import refusal

TEXT_MAX_BYTES = 4095  # maximum length of a path on Linux
PART_MAX_BYTES = 255  # maximum length of each part of a path


def within(low: float, high: float, unit: str, *, zero: bool = False) -> AfterValidator:
    """Return a validator for numbers in a range, with the messages of `refusal`.
    `zero` also accepts 0, "not set".
    """

    def check(value: float) -> float:
        problem = "" if zero and value == 0 else refusal(value, low, high, unit)
        if problem:
            raise ValueError(problem)
        return value

    return AfterValidator(check)


def check_text(value: str) -> str:
    """Return the text unchanged if it can be a name or a path. Raises ValueError otherwise."""
    if "\0" in value:
        raise ValueError("must not contain a NUL character")
    try:
        size = len(value.encode())
        longest = max(len(part.encode()) for part in value.split("/"))
    except UnicodeEncodeError:
        raise ValueError("is not valid UTF-8") from None
    if size > TEXT_MAX_BYTES or longest > PART_MAX_BYTES:
        raise ValueError(f"is too long: it has {len(value)} characters and starts with {value[:20]!r}")
    return value


def nearest(word: str, known: Iterable[str]) -> str:
    """Return a hint such as `: did you mean model?` if a known word is similar, or else "".

    >>> nearest("modle", ["model", "loop"])
    ': did you mean model?'
    """
    like = difflib.get_close_matches(word, list(known), n=1)
    return f": did you mean {like[0]}?" if like else ""
