"""Pairs of a measured sensor point and the known stack point: reading, checking, and keeping them safe."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from runtime.errors import InputError
from runtime.records import F64
from runtime.support import foreign
from runtime.support.artifacts import write_text

COLUMNS = ("sensor_x", "sensor_y", "sensor_z", "stack_x", "stack_y", "stack_z")
SEPARATION = "separation_m"  # of the eyes, by the sensor's metre; may be missing
NOTES = ("viewpoint", "spread_mm", "samples", "accepted_at", "sensor_serial", SEPARATION)
MAXIMUM_PAIRS = 1_000_000
FARTHEST = 1e9  # of a coordinate, in whatever unit


@dataclass(frozen=True, slots=True)
class Pairs:
    """K pairs with a name each, for messages."""

    sensor_m: F64  # (K, 3)
    stack_m: F64  # (K, 3)
    names: tuple[str, ...]
    source: str
    sensor_serial: str = ""  # of the device that measured all of them; empty: not known
    separation_m: F64 = field(default_factory=lambda: np.empty(0))  # (K,) of the eyes; NaN where not known, or (0,)

    def __len__(self) -> int:
        return len(self.names)

    def only(self, keep: Iterable[int]) -> Pairs:
        """Some of them, by index."""
        index = np.array(list(keep), dtype=int)
        names = tuple(self.names[i] for i in index.tolist())
        separation_m = self.separation_m[index] if len(self.separation_m) else self.separation_m
        return replace(
            self, sensor_m=self.sensor_m[index], stack_m=self.stack_m[index], names=names, separation_m=separation_m
        )


@dataclass(frozen=True, slots=True)
class CapturedPair:
    """One accepted viewpoint, as a row of the CSV."""

    sensor_m: tuple[float, float, float]
    stack_m: tuple[float, float, float]
    viewpoint: str
    spread_mm: float
    samples: int
    accepted_at: str
    sensor_serial: str = ""
    separation_m: float = math.nan

    def row(self) -> dict[str, str]:
        numbers = zip(COLUMNS, (*self.sensor_m, *self.stack_m), strict=True)
        return {name: f"{value:.9g}" for name, value in numbers} | {
            "viewpoint": self.viewpoint,
            "spread_mm": f"{self.spread_mm:.3f}",
            "samples": str(self.samples),
            "accepted_at": self.accepted_at,
            "sensor_serial": self.sensor_serial,
            SEPARATION: f"{self.separation_m:.6g}" if math.isfinite(self.separation_m) else "",
        }


def read_pairs(path: Path) -> Pairs:
    """Pairs from CSV (a header with `COLUMNS`, others ignored) or JSON (a list of objects, or `{"pairs": [...]}`).

    Raises InputError, naming the file and the row and column: unreadable, columns missing, not a finite number.
    """
    text = foreign.read_text(path)
    rows = _json_rows(path, text) if path.suffix.lower() == ".json" else _csv_rows(path, text)
    if len(rows) > MAXIMUM_PAIRS:
        raise InputError(path, "", f"holds {len(rows)} pairs, more than {MAXIMUM_PAIRS}")
    values = np.empty((len(rows), 6))
    for index, (label, row) in enumerate(rows):
        for column, name in enumerate(COLUMNS):
            values[index, column] = _number(path, label, name, row.get(name))
    names = tuple(_name(label, row) for label, row in rows)
    serials = {str(row.get("sensor_serial") or "") for _, row in rows} - {""}
    if len(serials) > 1:
        raise InputError(path, "sensor_serial", f"pairs of different sensors: {', '.join(sorted(serials))}")
    told = [row.get(SEPARATION) for _, row in rows]
    apart_m = [math.nan if value in (None, "") else _number(path, label, SEPARATION, value)
               for (label, _), value in zip(rows, told, strict=True)]  # fmt: skip
    return Pairs(
        values[:, :3].copy(), values[:, 3:].copy(), names, str(path), "".join(serials), np.array(apart_m, np.float64)
    )


def _csv_rows(path: Path, text: str) -> list[tuple[str, Mapping[str, Any]]]:
    reader = csv.DictReader(io.StringIO(text), skipinitialspace=True)
    try:
        header = [name.strip() for name in reader.fieldnames or ()]
        reader.fieldnames = header
        for name in COLUMNS:
            if name not in header:
                raise InputError(path, name, "column is missing (wanted: " + ", ".join(COLUMNS) + ")")
        return [(f"line {reader.line_num}", row) for row in reader]
    except csv.Error as error:
        raise InputError(path, f"line {reader.line_num}", f"malformed: {error}") from None


def _json_rows(path: Path, text: str) -> list[tuple[str, Mapping[str, Any]]]:
    value = foreign.parsed_json(text, source=path)
    items = value.get("pairs") if isinstance(value, dict) else value
    if not isinstance(items, list):
        raise InputError(path, "pairs", "must be a list of objects")
    for number, item in enumerate(items, start=1):
        if not isinstance(item, dict):
            raise InputError(path, f"pair {number}", "must be an object with " + ", ".join(COLUMNS))
    return [(f"pair {number}", item) for number, item in enumerate(items, start=1)]


def _number(path: Path, label: str, name: str, value: Any) -> float:
    if value is None or value == "":
        raise InputError(path, f"{label}, {name}", "is missing")
    if isinstance(value, bool | list | dict):
        raise InputError(path, f"{label}, {name}", "is not a number")
    try:
        number = float(value)
    except (ValueError, OverflowError):
        raise InputError(path, f"{label}, {name}", f"is not a number: {str(value)[:40]}") from None
    if not math.isfinite(number):
        raise InputError(path, f"{label}, {name}", f"is not finite: {number}")
    if abs(number) > FARTHEST:
        raise InputError(
            path, f"{label}, {name}", f"is {number:g}: no display is farther than {FARTHEST:g} of any unit"
        )
    return number


def _name(label: str, row: Mapping[str, Any]) -> str:
    viewpoint = row.get("viewpoint")
    return f"{label} ({viewpoint})" if isinstance(viewpoint, str) and viewpoint else label


class PairsFile:
    """The CSV that capture fills: every accepted pair is on disk, whole, before the next one is measured."""

    def __init__(self, path: Path) -> None:
        """Resume an existing file or begin one. Raises InputError where it exists and is not ours."""
        self.path = path
        self._rows: list[dict[str, str]] = []
        if foreign.is_there(path):
            read_pairs(path)
            with io.StringIO(foreign.read_text(path), newline="") as file:
                for row in csv.DictReader(file, skipinitialspace=True):
                    self._rows.append({name: row.get(name) or "" for name in (*COLUMNS, *NOTES)})

    @property
    def viewpoints(self) -> frozenset[str]:
        """Names of the viewpoints that are already there."""
        return frozenset(row["viewpoint"] for row in self._rows)

    def __len__(self) -> int:
        return len(self._rows)

    def points(self) -> tuple[F64, F64]:
        """(K, 3) in `sensor` and (K, 3) in `stack` of all pairs so far."""
        table = np.array([[float(row[name]) for name in COLUMNS] for row in self._rows]).reshape(-1, 6)
        return table[:, :3], table[:, 3:]

    def undo(self) -> str:
        """Take the newest pair out again; answers its viewpoint, empty where there is none. On disk when it returns."""
        if not self._rows:
            return ""
        name = self._rows.pop()["viewpoint"]
        self._write()
        return name

    def accept(self, pair: CapturedPair) -> None:
        """Add a pair; one of the same viewpoint is replaced. On disk when this returns.

        Raises InputError for a pair of another sensor than those that are there.
        """
        others = {row["sensor_serial"] for row in self._rows} - {"", pair.sensor_serial}
        if others and pair.sensor_serial:
            raise InputError(
                self.path,
                "sensor_serial",
                f"its pairs are of sensor {min(others)}, this one is of {pair.sensor_serial}",
            )
        self._rows = [row for row in self._rows if not pair.viewpoint or row["viewpoint"] != pair.viewpoint]
        self._rows.append(pair.row())
        self._write()

    def _write(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, (*COLUMNS, *NOTES), lineterminator="\n")
        writer.writeheader()
        writer.writerows(self._rows)
        write_text(self.path, text.getvalue())
