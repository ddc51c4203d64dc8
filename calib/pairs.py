"""Pairs of a point measured in the sensor frame and its known position in the stack frame."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, TypeAdapter, ValidationError

from runtime.errors import InputError
from runtime.records import F64
from runtime.support import untrusted_input
from runtime.support.artifacts import write_text
from runtime.support.spreadsheet import comma_separated

MAX_PAIRS = 1_000_000  # maximum number of pairs in a file
MAX_LISTED = 3  # maximum number of mistakes listed in a message
MAX_MAGNITUDE = 1e9  # maximum coordinate in any unit


def _no_truth_value(value: Any) -> Any:
    return str(value) if isinstance(value, bool) else value


def _bounded(value: float) -> float:
    if not math.isfinite(value):
        raise ValueError("is not finite")
    if abs(value) > MAX_MAGNITUDE:
        raise ValueError(f"exceeds {MAX_MAGNITUDE:g}")
    return value


Number = Annotated[float, BeforeValidator(_no_truth_value), AfterValidator(_bounded)]


class PairRow(BaseModel):
    """A row in the file: a pair of points in metres, with the columns that `calibrate capture` adds."""

    model_config = ConfigDict(frozen=True, extra="ignore", coerce_numbers_to_str=True)

    sensor_x: Number
    sensor_y: Number
    sensor_z: Number
    stack_x: Number
    stack_y: Number
    stack_z: Number
    viewpoint: str = ""
    spread_mm: str = ""
    sensor_serial: str = ""

    @classmethod
    def of(cls, sensor_m: F64, stack_m: F64, viewpoint: str, *, serial: str, spread_mm: str = "") -> PairRow:
        """Create the row for a point (3,), given in both the `sensor` frame and the `stack` frame."""
        sx, sy, sz, wx, wy, wz = np.concatenate([sensor_m, stack_m]).tolist()
        return cls(
            sensor_x=sx, sensor_y=sy, sensor_z=sz, stack_x=wx, stack_y=wy, stack_z=wz,
            viewpoint=viewpoint, sensor_serial=serial, spread_mm=spread_mm,
        )  # fmt: skip


COLUMNS = tuple(name for name, field in PairRow.model_fields.items() if field.is_required())


@dataclass(frozen=True, slots=True)
class Pairs:
    """Validated pairs of points, as arrays of K rows."""

    sensor_m: F64  # (K, 3) measured points, frame `sensor`
    stack_m: F64  # (K, 3) known points, frame `stack`
    names: tuple[str, ...]  # names of the pairs, used in messages
    source: str  # the file's path
    sensor_serial: str = ""  # serial number of the sensor that measured all pairs; empty if unknown

    def __len__(self) -> int:
        return len(self.names)


def read_pairs(path: Path) -> Pairs:
    """Read pairs from a CSV file whose header contains `COLUMNS`, or from a JSON list or `{"pairs":
    [...]}`. Raises InputError.
    """
    labels, rows = _read_rows(path)
    if len(rows) > MAX_PAIRS:
        raise InputError(path, "", f"contains {len(rows)} pairs, but the maximum is {MAX_PAIRS}")
    serials = {row.sensor_serial for row in rows} - {""}
    if len(serials) > 1:
        raise InputError(
            path, "sensor_serial", f"names different sensors ({', '.join(sorted(serials))}); use pairs from one sensor"
        )
    names = tuple(
        f"{label} ({row.viewpoint})" if row.viewpoint else label for label, row in zip(labels, rows, strict=True)
    )
    sensor_m, stack_m = points_of(rows)
    return Pairs(sensor_m, stack_m, names, str(path), "".join(serials))


def _read_rows(path: Path) -> tuple[list[str], list[PairRow]]:
    """Read a file, and return each pair's label (line or number) and the pairs. Raises InputError as `read_pairs`."""
    text = untrusted_input.read_text(path)
    if path.suffix.lower() == ".json":
        value = untrusted_input.parsed_json(text, source=path)
        items = value.get("pairs") if isinstance(value, dict) else value
        if not isinstance(items, list) or not all(isinstance(item, dict) for item in items):
            raise InputError(path, "pairs", "must be a list of objects")
        labels = [f"pair {number}" for number in range(1, len(items) + 1)]
        columns = {name for item in items for name in item}
    else:
        reader = csv.DictReader(io.StringIO(comma_separated(text)), skipinitialspace=True)
        try:
            reader.fieldnames = [name.strip().lower() for name in reader.fieldnames or ()]
            columns = set(reader.fieldnames)
            # An empty cell is a missing value.
            read = [(f"line {reader.line_num}", {k: v for k, v in row.items() if v}) for row in reader]
        except csv.Error as error:
            raise InputError(path, f"line {reader.line_num}", f"malformed: {error}") from None
        for label, row in read:
            if any(row.pop(None, ())):  # values beyond the last column
                more = "has more values than there are columns; with decimal commas, separate columns by semicolons"
                raise InputError(path, label, more)
        labels, items = [label for label, _ in read], [row for _, row in read]
    missing = [name for name in COLUMNS if name not in columns]
    if missing:
        raise InputError(
            path, missing[0], "the column is missing; the file must have the columns " + ", ".join(COLUMNS)
        )
    try:
        return labels, TypeAdapter(list[PairRow]).validate_python(items)
    except ValidationError as error:
        mistakes = error.errors()
    listed = [f"{labels[int(e['loc'][0])]}, {e['loc'][1]}: {_problem(e)}" for e in mistakes[:MAX_LISTED]]
    if len(mistakes) > MAX_LISTED:
        listed.append(f"and {len(mistakes) - MAX_LISTED} more")
    raise InputError(path, "", "; ".join(listed))


def _problem(error: Any) -> str:
    if error["type"] == "missing":
        return "is missing"
    text = str(error["msg"]).removeprefix("Value error, ") if error["type"] == "value_error" else "is not a number"
    return f"{text}: {untrusted_input.shown(error['input'])}"


def points_of(rows: Iterable[PairRow]) -> tuple[F64, F64]:
    """Return the rows' points in the `sensor` frame and in the `stack` frame, each as a (K, 3) array."""
    table = np.array([[getattr(row, name) for name in COLUMNS] for row in rows], dtype=np.float64).reshape(-1, 6)
    return table[:, :3].copy(), table[:, 3:].copy()


class PairsFile:
    """CSV file of the pairs accepted so far, written at every change so that none is lost."""

    def __init__(self, path: Path) -> None:
        """Continue an existing file or start a new one. Raises InputError if an existing file is invalid."""
        self.path = path
        self.rows: list[PairRow] = []
        if untrusted_input.is_there(path):
            self.rows = _read_rows(path)[1]

    @property
    def viewpoints(self) -> frozenset[str]:
        """Names of the viewpoints that have a pair."""
        return frozenset(row.viewpoint for row in self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def accept(self, *pairs: PairRow) -> None:
        """Add one sensor's pairs, instead of those at the same viewpoints. Raises InputError for another's."""
        serial, replaced = pairs[0].sensor_serial, {pair.viewpoint for pair in pairs} - {""}
        others = {row.sensor_serial for row in self.rows} - {"", serial}
        if others and serial:
            problem = f"the file contains pairs from sensor {min(others)}, but this pair is from sensor {serial}"
            raise InputError(self.path, "sensor_serial", problem)
        self.rows = [row for row in self.rows if row.viewpoint not in replaced] + list(pairs)
        self._write()

    def _write(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(PairRow.model_fields), lineterminator="\n")
        writer.writeheader()
        for row in self.rows:
            cells = row.model_dump().items()
            writer.writerow({name: f"{value:.9g}" if isinstance(value, float) else value for name, value in cells})
        write_text(self.path, text.getvalue())
