"""Base class of everything read from a table, and validation with errors that name the field."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from runtime.errors import InputError, one_line
from runtime.support.plausible import check_text, nearest


class Section(BaseModel):
    """A frozen table: unknown keys refused, numbers finite, texts valid as names and paths."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _check_text(cls, value: Any) -> Any:
        return check_text(value) if isinstance(value, str) else value


M = TypeVar("M", bound=BaseModel)


def validated(model: type[M], table: dict[str, Any], *, source: str | Path, folder: Path | None = None) -> M:
    """Return the table as a validated record. Raises InputError that names every wrong field.

    folder: base of relative paths (`runtime.config.paths`); without it they stay as they are.
    """
    try:
        return model.model_validate(table, context=folder)
    except ValidationError as error:
        (name, problem), *others = dict(_wrong_field(model, each) for each in error.errors()).items()
        rest = [f"{field}: {one_line(text)}" if field else one_line(text) for field, text in others]
        raise InputError(source, name, "; ".join([one_line(problem), *rest])) from None


def _wrong_field(model: type[BaseModel], error: Any) -> tuple[str, str]:
    """Return the full name of the field that one of pydantic's errors is about, and the problem."""
    name = ".".join(str(part) for part in error["loc"])
    message = error["msg"].removeprefix("Value error, ")
    if error["type"] == "extra_forbidden":
        return name, "is no setting" + nearest(str(error["loc"][-1]), _keys(model, error["loc"][:-1]))
    field, colon, rest = message.partition(": ")
    if colon and error["type"] == "value_error" and field.partition(".")[0] in _keys(model, error["loc"]):
        return ".".join(filter(None, (name, field))), rest  # a rule about several fields
    return name, message


def _keys(model: type[BaseModel], path: tuple[int | str, ...]) -> list[str]:
    """Return the keys allowed in the model's table at a path."""
    table: Any = model
    for part in path:
        if isinstance(part, str) and part in getattr(table, "model_fields", ()):
            annotation = table.model_fields[part].annotation
            candidates = (annotation, *getattr(annotation, "__args__", ()))
            table = next((kind for kind in candidates if hasattr(kind, "model_fields")), annotation)
    return list(getattr(table, "model_fields", ()))
