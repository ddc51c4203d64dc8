"""Read and validate tables in TOML and JSON files, with errors that name the field."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator

from runtime.errors import InputError, one_line
from runtime.support import untrusted_input
from runtime.support.plausible import check_text, nearest

TABLE_BYTES_MAX = 4 << 20
KEY_PARTS_MAX = 16  # maximum number of parts in a dotted key; tomllib's time and memory grow with its square
STRINGS_AND_COMMENTS = re.compile(
    r'''"""(?:[^\\]|\\.)*?"""|\'{3}.*?\'{3}|"(?:[^"\\\n]|\\.)*"|'[^'\n]*'|#[^\n]*''', re.DOTALL
)
KEY_SEPARATORS = re.compile(r"[\n=,{}\[\]]")
M = TypeVar("M", bound=BaseModel)
EXPECTED = "Input should be "  # beginning of many of pydantic's messages
PLAIN = {  # pydantic's messages that name types of Python, in the words of a configuration
    "bool_parsing": EXPECTED + "true or false",
    "bool_type": EXPECTED + "true or false",
    "dict_type": EXPECTED + "a table",
    "float_parsing": EXPECTED + "a valid number",
    "int_parsing": EXPECTED + "a whole number",
    "list_type": EXPECTED + "a list in brackets",
    "model_type": EXPECTED + "a table",
    "string_type": EXPECTED + "text in quotes",
    "too_long": "must have at most {max_length} items",
    "too_short": "must have at least {min_length} items",
    "tuple_type": EXPECTED + "a list in brackets",
}
UNION_MEMBER = re.compile(r"literal\[.*\]|constrained-\w+")  # a type's name in the path to a field of several types


class Section(BaseModel):
    """Base class for the records that tables are validated against. Records are frozen. Unknown keys,
    non-finite numbers, true and false in place of numbers, and strings that are not valid names or paths are rejected.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _check_text(cls, value: Any) -> Any:
        return check_text(value) if isinstance(value, str) else value

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_truth(cls, value: Any, info: ValidationInfo) -> Any:
        annotation = cls.model_fields[str(info.field_name)].annotation
        kinds = get_args(annotation)[1:] if get_origin(annotation) is dict else (annotation,)
        return _spelt(value) if _takes_numbers(kinds) else value


def _takes_numbers(kinds: tuple[Any, ...]) -> bool:
    """Return True if the types, or those they are made of, include numbers but neither booleans nor any text."""
    parts = [*kinds]
    for part in parts:  # the list grows
        parts += get_args(part)
    return (int in parts or float in parts) and not any(kind in parts for kind in (bool, str, Any))


def _spelt(value: Any) -> Any:
    """Spell out all booleans, because pydantic would convert them to 1 and 0 but refuses these words as numbers."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return [_spelt(item) for item in value]
    return {key: _spelt(item) for key, item in value.items()} if isinstance(value, dict) else value


def read_table(path: Path) -> dict[str, Any]:
    """Read the table in a TOML or JSON file. Raises InputError, for a malformed file with the line."""
    text = untrusted_input.read_text(path, most_bytes=TABLE_BYTES_MAX)
    table = untrusted_input.parsed_json(text, source=path) if path.suffix.lower() == ".json" else _toml(text, path)
    if not isinstance(table, dict):
        raise InputError(path, "", "must contain a table at the top level")
    return table


def _toml(text: str, path: Path) -> Any:
    keys = KEY_SEPARATORS.split(STRINGS_AND_COMMENTS.sub("_", text))
    if max(key.count(".") for key in keys) >= KEY_PARTS_MAX:
        raise InputError(path, "", f"malformed: a key has more than {KEY_PARTS_MAX} parts")
    try:
        return tomllib.loads(text)
    except ValueError as error:
        raise InputError(path, "", f"malformed: {error}") from None
    except RecursionError:
        raise InputError(path, "", "malformed: nested too deeply") from None


def validated(model: type[M], table: dict[str, Any], *, source: str | Path, folder: Path | None = None) -> M:
    """Validate a table as a record, with paths relative to a folder (`runtime.config.paths`), if any.
    Raises InputError, which names every field that is invalid, missing or unknown.
    """
    try:
        return model.model_validate(table, context=folder)
    except ValidationError as error:
        problems: dict[str, str] = {}
        errors = error.errors()
        inner = {each["loc"][:-1] for each in errors}
        # Pydantic counts only the valid items, so a list with an invalid item is also reported as too short.
        errors = [each for each in errors if each["type"] != "too_short" or each["loc"] not in inner]
        for field, problem in (_wrong_field(model, each) for each in errors):
            before = problems.get(field)  # a field of several types has an error for each of them
            problems[field] = problem if before is None else f"{before} or {problem.removeprefix(EXPECTED)}"
        (name, problem), *others = problems.items()
        rest = [f"{field}: {one_line(text)}" if field else one_line(text) for field, text in others]
        raise InputError(source, name, "; ".join([one_line(problem), *rest])) from None


def _wrong_field(model: type[BaseModel], error: Any) -> tuple[str, str]:
    """Return the full name of the field that a pydantic error concerns, and the problem."""
    name = ".".join(str(part) for part in error["loc"] if not UNION_MEMBER.fullmatch(str(part)))
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] in PLAIN:
        return name, PLAIN[error["type"]].format_map(error.get("ctx", {}))
    if error["type"] == "string_pattern_mismatch":
        described = _record(model, error["loc"][:-1]).model_fields[error["loc"][-1]].description
        return name, f"{error['input']!r} is not valid; expected: {described}"
    if error["type"] == "extra_forbidden":
        return name, "is not a setting" + nearest(str(error["loc"][-1]), _keys(model, error["loc"][:-1]))
    field, colon, rest = message.partition(": ")
    if colon and error["type"] == "value_error" and field.partition(".")[0] in _keys(model, error["loc"]):
        return ".".join(filter(None, (name, field))), rest  # error raised by a rule about several fields
    return name, message


def _keys(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys allowed in the table at a path of keys within a record."""
    return list(getattr(_record(model, path), "model_fields", ()))


def _record(model: type[BaseModel], path: tuple[int | str, ...]) -> Any:
    """Return the type that the table at a path of keys within a record is validated against."""
    table: Any = model
    for part in path:
        if isinstance(part, str) and part in getattr(table, "model_fields", ()):
            annotation = table.model_fields[part].annotation
            candidates = (annotation, *getattr(annotation, "__args__", ()))
            table = next((kind for kind in candidates if hasattr(kind, "model_fields")), annotation)
    return table
