"""Tables in text files, as spreadsheets write them in different languages."""

from __future__ import annotations

import csv
import io
import re

DECIMAL_COMMA = re.compile(r"\s*[-+]?\d*,\d+(?:[eE][-+]?\d+)?\s*")


def comma_separated(text: str) -> str:
    """Convert a table to cells separated by commas and numbers with decimal points.

    Where the decimal separator is a comma, Excel separates cells by semicolons or tabs. A first line such as `sep=;`
    names the separator. Lines that begin with # are unchanged.
    """
    lines = text.removeprefix("\ufeff").splitlines(keepends=True)
    header = next((line for line in lines if line.strip() and line[0] != "#"), "")
    separator = next((mark for mark in ";\t" if mark in header), ",")
    if named := re.fullmatch(r'"?sep=(.)"?\s*', header):
        separator = named[1]
        lines.remove(header)
    if separator == ",":
        return "".join(lines)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for line in lines:
        if line[0] == "#":
            out.write(line)
            continue
        cells = next(csv.reader([line], delimiter=separator), [])
        writer.writerow([cell.replace(",", ".") if DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells])
    return out.getvalue()
