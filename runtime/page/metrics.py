"""Format the figures in the daemon's status as Prometheus text, using their JSON names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

PREFIX = "phasestack_"
COUNTERS = ("presented", "dropped", "stale_inputs", "inferences", "missed_blanks")
TABLES = {"efforts": "effort", "faults": "part", "rejected_samples": "reason"}  # label name, keyed by field
TEXTS = ("state", "effort", "model", "scene")


def exposition(status: Mapping[str, Any]) -> str:
    """Format a status's numbers and known texts in the Prometheus text format. Quantiles, table entries
    and texts become labels. Null values are skipped.
    """
    return "".join(f"{line}\n" for line in _lines(status))


def _lines(status: Mapping[str, Any]) -> Iterator[str]:
    for field, value in status.items():
        name = PREFIX + field
        if field in TEXTS and isinstance(value, str):
            yield f"# TYPE {name} gauge"
            yield f"{name}{_label(field, value)} 1"
        elif _is_number(value):
            yield f"# TYPE {name} {'counter' if field in COUNTERS else 'gauge'}"
            yield f"{name} {value!r}"
        elif isinstance(value, dict) and any(_is_number(item) for item in value.values()):
            yield f"# TYPE {name} gauge"
            for key, item in value.items():
                if _is_number(item):
                    yield f"{name}{_key(field, key)} {item!r}"


def _key(field: str, key: str) -> str:
    """Return the label for an entry of a status's dictionary: `p95` is quantile 0.95, and `max` quantile 1."""
    if field in TABLES:
        return _label(TABLES[field], key)
    if key[:1] == "p" and key[1:].isdigit():
        return _label("quantile", f"{int(key[1:]) / 100:g}")
    return _label("quantile", "1") if key == "max" else _label("name", key)


def _label(name: str, value: str) -> str:
    text = value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
    return f'{{{name}="{text}"}}'


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
