"""Format the results of commands as readable lines, with the same field names as in JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from runtime.errors import one_line

LINE_MAX = 2000  # maximum number of characters in a line


def shown(record: Mapping[str, Any], *, as_json: bool) -> str:
    """Format a command's result as JSON or as readable lines."""
    return json.dumps(record) if as_json else "\n".join(lines_of(record))


def lines_of(record: Mapping[str, Any]) -> Iterator[str]:
    """Yield a line per field of a record, or per object of a list, unless null, false or empty."""
    for name, value in record.items():
        is_list = isinstance(value, list | tuple) and all(isinstance(item, dict) for item in value)
        for each in value if is_list else (value,):
            if text := in_words(each):
                yield one_line(f"{name:20} {text}", most=LINE_MAX)


def in_words(value: Any) -> str:
    """Format a value as text. Null and false give an empty string."""
    match value:
        case None | False:
            return ""
        case True:
            return "yes"
        case float():
            return f"{value:.4g}"
        case {"p50": median, "p99": most}:  # quantiles
            return f"{in_words(median)} (p99 {in_words(most)})" if median is not None else ""
        case dict():
            return ", ".join(f"{name} {text}" for name, item in value.items() if (text := in_words(item)))
        case list() | tuple():
            form = "({})" if any(isinstance(item, list | tuple) for item in value) else "{}"
            return " ".join(form.format(in_words(item)) for item in value)
    return str(value)


def effort_in_words(name: str) -> str:
    """Describe an effort, given its name.

    >>> effort_in_words("1/1+4"), effort_in_words("1/2+1")
    ('4 steps on all pixels', '1 step on half the rows and columns')
    """
    reduction, _, steps = name.removeprefix("1/").partition("+")
    raster = {"1": "all pixels", "2": "half the rows and columns", "3": "a third of the rows and columns"}
    rows = raster.get(reduction, f"1/{reduction} of the rows and columns")
    return f"{steps} {'step' if steps == '1' else 'steps'} on {rows}"
