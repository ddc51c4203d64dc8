"""Tables that a person brings, CSV or JSON: read row by row, and all that is wrong with a file in one refusal."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, BeforeValidator, TypeAdapter, ValidationError

from runtime.errors import InputError
from runtime.support import untrusted_input

M = TypeVar("M", bound=BaseModel)
MAX_LISTED = 3  # mistakes that a refusal spells out
MAX_MAGNITUDE = 1e9  # of a number, in whatever unit


def _no_truth_value(value: Any) -> Any:
    return str(value) if isinstance(value, bool) else value


def _bounded(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("is not finite")
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"is beyond {MAX_MAGNITUDE:g}")
    return value


Number = Annotated[float, BeforeValidator(_no_truth_value), AfterValidator(_bounded)]


@dataclass(frozen=True, slots=True)
class Table:
    """Rows as they were read."""

    path: Path
    columns: frozenset[str]
    rows: tuple[tuple[str, Mapping[str, Any]], ...]  # where each stands in its file, and its columns


def read_table(path: Path) -> Table:
    """A CSV with a header, or JSON: a list of objects, or `{"pairs": [...]}`. Raises InputError."""
    text = untrusted_input.read_text(path)
    if path.suffix.lower() == ".json":
        value = untrusted_input.parsed_json(text, source=path)
        items = value.get("pairs") if isinstance(value, dict) else value
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise InputError(path, "pairs", "must be a list of objects")
        rows = tuple((f"pair {number}", item) for number, item in enumerate(items, start=1))
        return Table(path, frozenset(name for item in items for name in item), rows)
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        header = [name.strip().lower() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        # Nothing in a cell: the value is missing.
        rows = tuple((f"line {reader.line_num}", {k: v for k, v in row.items() if k and v}) for row in reader)
    except csv.Error as error:
        raise InputError(path, f"line {reader.line_num}", f"malformed: {error}") from None
    return Table(path, frozenset(header), rows)


def validated_rows(table: Table, model: type[M]) -> list[M]:
    """The rows as `model` has them. Raises InputError with every wrong row and column, the first few spelled out."""
    wanted = [name for name, field in model.model_fields.items() if field.is_required()]
    missing = [name for name in wanted if name not in table.columns]
    if missing:
        raise InputError(table.path, missing[0], "column is missing (wanted: " + ", ".join(wanted) + ")")
    try:
        return TypeAdapter(list[model]).validate_python([row for _, row in table.rows])  # type: ignore[valid-type]
    except ValidationError as error:
        wrong = error.errors()
    listed = []
    for one in wrong[:MAX_LISTED]:
        row, column = one["loc"][:2]
        listed.append(f"{table.rows[int(row)][0]}, {column}: {_problem(one)}")
    if len(wrong) > MAX_LISTED:
        listed.append(f"and {len(wrong) - MAX_LISTED} more")
    raise InputError(table.path, "", "; ".join(listed))


def _problem(error: Any) -> str:
    if error["type"] == "missing":
        return "is missing"
    text = str(error["msg"]).removeprefix("Value error, ") if error["type"] == "value_error" else "is not a number"
    return f"{text}: {untrusted_input.shown(error['input'])}"
