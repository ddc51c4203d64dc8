"""A record as lines for people: every figure stands under the name that it has in JSON."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from runtime.errors import one_line

LINE_MAX = 2000


def lines_of(record: Mapping[str, Any]) -> Iterator[str]:
    """A line a field, or one for each object of a list. What was not measured, is off or empty is left out.

    What it holds can't break a line.
    """
    for name, value in record.items():
        is_list = isinstance(value, list | tuple) and all(isinstance(item, dict) for item in value)
        for each in value if is_list else (value,):
            if text := _text(each):
                yield one_line(f"{name:20} {text}", most=LINE_MAX)


def _text(value: Any) -> str:
    match value:
        case None | False:
            return ""
        case True:
            return "yes"
        case float():
            return f"{value:.4g}"
        case {"p50": median, "p99": most}:  # quantiles
            return f"{_text(median)} (p99 {_text(most)})" if median is not None else ""
        case dict():
            return ", ".join(f"{name} {text}" for name, item in value.items() if (text := _text(item)))
        case list() | tuple():
            return " ".join(f"({_text(item)})" if isinstance(item, list | tuple) else _text(item) for item in value)
    return str(value)
