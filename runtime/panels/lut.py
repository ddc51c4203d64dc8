"""Grey curves, which map the phase wanted from a panel to the grey level to display."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from runtime.errors import InputError
from runtime.records import F32
from runtime.support import untrusted_input
from runtime.support.spreadsheet import comma_separated

ENTRIES = 256
COLUMNS = ("phase", "red", "green", "blue")


def measured_curve(path: Path) -> F32:
    """Read measured grey levels in [0, 1], (256, 3) by 8-bit phase and channel, from a CSV file. The
    columns are either phase, red, green and blue, or phase and grey, with all values in [0, 1], in at least two rows of
    increasing phase. The curve is linear between rows and constant beyond. Raises InputError, which names the fault.
    """
    text = comma_separated(untrusted_input.read_text(path))
    lines = [line for line in text.splitlines() if line.strip() and line[0] != "#"]
    header = tuple(name.strip().lower() for name in lines[0].split(",")) if lines else ()
    if header not in (COLUMNS, ("phase", "grey")):
        raise InputError(
            path, "columns", "must have either the columns phase, red, green and blue or the columns phase and grey"
        )
    if len(lines) < 3:
        raise InputError(path, "phase", "must have at least two rows")
    try:
        table = np.loadtxt(lines[1:], delimiter=",", usecols=range(len(header)))
    except ValueError as error:
        raise InputError(path, "rows", str(error)) from None
    if not np.isfinite(table).all() or table.min() < 0.0 or table.max() > 1.0:
        raise InputError(path, "values", "must be in [0, 1]")
    if (np.diff(table[:, 0]) <= 0.0).any():
        raise InputError(path, "phase", "must increase from row to row")
    phases = np.linspace(0.0, 1.0, ENTRIES)
    columns = (1, 2, 3) if header == COLUMNS else (1, 1, 1)
    greys = [np.interp(phases, table[:, 0], table[:, column]) for column in columns]
    return np.stack(greys, axis=1).astype(np.float32)


def curve(*, lut: str, gamma: float) -> F32:
    """Return a panel's grey levels in [0, 1], (256, 3) by 8-bit phase and channel: the file `lut`'s, or
    grey^gamma = phase. Raises InputError if the file cannot be read or its content is invalid.
    """
    if lut:
        return measured_curve(Path(lut))
    phase = np.linspace(0.0, 1.0, ENTRIES)
    return np.repeat((phase ** (1.0 / gamma))[:, None], 3, axis=1).astype(np.float32)
