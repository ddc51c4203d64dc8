"""Pairs of a measured sensor point and the known stack point: reading, checking, and keeping them safe."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from calib.tables import Number, read_table, validated_rows
from runtime.errors import InputError
from runtime.records import F64
from runtime.support import untrusted_input
from runtime.support.artifacts import write_text

MAX_PAIRS = 1_000_000


class PairRow(BaseModel):
    """One pair as a row of the file, metres; `capture` adds what a person wants to know of it."""

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
        """The pair of a point (3,) in `sensor` and one in `stack`."""
        places = dict(zip(COLUMNS, np.concatenate([sensor_m, stack_m]).tolist(), strict=True))
        return cls(**places, viewpoint=viewpoint, sensor_serial=serial, spread_mm=spread_mm)


COLUMNS = tuple(name for name, field in PairRow.model_fields.items() if field.is_required())


@dataclass(frozen=True, slots=True)
class Pairs:
    """K pairs with a name each, for messages."""

    sensor_m: F64  # (K, 3)
    stack_m: F64  # (K, 3)
    names: tuple[str, ...]
    source: str
    sensor_serial: str = ""  # of the device that measured all of them; empty: not known

    def __len__(self) -> int:
        return len(self.names)

    def only(self, keep: Iterable[int]) -> Pairs:
        """Some of them, by index."""
        index = np.array(list(keep), dtype=int)
        names = tuple(self.names[i] for i in index.tolist())
        return replace(self, sensor_m=self.sensor_m[index], stack_m=self.stack_m[index], names=names)


def read_pairs(path: Path) -> Pairs:
    """Pairs from CSV (a header with `COLUMNS`, others ignored) or JSON (a list of objects, or `{"pairs": [...]}`).

    Raises InputError, naming the file and every row and column that is wrong.
    """
    table = read_table(path)
    if len(table.rows) > MAX_PAIRS:
        raise InputError(path, "", f"holds {len(table.rows)} pairs, more than {MAX_PAIRS}")
    rows = validated_rows(table, PairRow)
    serials = {row.sensor_serial for row in rows} - {""}
    if len(serials) > 1:
        raise InputError(path, "sensor_serial", f"pairs of different sensors: {', '.join(sorted(serials))}")
    names = tuple(
        f"{label} ({row.viewpoint})" if row.viewpoint else label
        for (label, _), row in zip(table.rows, rows, strict=True)
    )
    sensor_m, stack_m = points_of(rows)
    return Pairs(sensor_m, stack_m, names, str(path), "".join(serials))


def points_of(rows: Iterable[PairRow]) -> tuple[F64, F64]:
    """(K, 3) in `sensor` and (K, 3) in `stack`."""
    table = np.array([[getattr(row, name) for name in COLUMNS] for row in rows], dtype=np.float64).reshape(-1, 6)
    return table[:, :3].copy(), table[:, 3:].copy()


class PairsFile:
    """The CSV that capture fills: every accepted pair is on disk, whole, before the next one is measured."""

    def __init__(self, path: Path) -> None:
        """Resume an existing file or begin one. Raises InputError where it exists and holds no pairs."""
        self.path = path
        self.rows: list[PairRow] = []
        if untrusted_input.is_there(path):
            self.rows = validated_rows(read_table(path), PairRow)

    @property
    def viewpoints(self) -> frozenset[str]:
        """Names of the viewpoints that are already there."""
        return frozenset(row.viewpoint for row in self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def undo(self) -> str:
        """Take the newest pair out again; returns its viewpoint, empty where there is none."""
        if not self.rows:
            return ""
        name = self.rows.pop().viewpoint
        self._write()
        return name

    def accept(self, *pairs: PairRow) -> None:
        """Add pairs of one sensor; those of the same viewpoints are replaced. On disk when this returns.

        Raises InputError for pairs of another sensor than those that are there.
        """
        serial, taken = pairs[0].sensor_serial, {pair.viewpoint for pair in pairs} - {""}
        others = {row.sensor_serial for row in self.rows} - {"", serial}
        if others and serial:
            problem = f"its pairs are of sensor {min(others)}, this one is of {serial}"
            raise InputError(self.path, "sensor_serial", problem)
        self.rows = [row for row in self.rows if row.viewpoint not in taken] + list(pairs)
        self._write()

    def _write(self) -> None:
        text = io.StringIO()
        writer = csv.DictWriter(text, list(PairRow.model_fields), lineterminator="\n")
        writer.writeheader()
        for row in self.rows:
            cells = row.model_dump().items()
            writer.writerow({name: f"{value:.9g}" if isinstance(value, float) else value for name, value in cells})
        write_text(self.path, text.getvalue())
