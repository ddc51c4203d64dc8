"""Tests that pairs are read, or refused with row and column, and that captured pairs are saved at once."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from calib.pairs import COLUMNS, PairRow, PairsFile, read_pairs
from runtime.errors import InputError

HEADER = ",".join(COLUMNS)


def file(folder: Path, text: str, name: str = "pairs.csv") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def captured(viewpoint: str, x: float = 0.1, serial: str = "A1") -> PairRow:
    places = dict(zip(COLUMNS, (x, 0.2, 0.3, 0.4, 0.5, 0.6), strict=True))
    return PairRow(**places, viewpoint=viewpoint, spread_mm="1.5", sensor_serial=serial)


@pytest.mark.parametrize("wrapped", [False, True])
def test_json_gives_the_same_as_csv(tmp_path: Path, wrapped: bool) -> None:
    rows = [dict(zip(COLUMNS, values, strict=True)) for values in ([1, 2, 3, 4, 5, 6], [2, 3, 4, 5, 6, 7])]
    from_json = read_pairs(file(tmp_path, json.dumps({"pairs": rows} if wrapped else rows), "p.json"))
    from_csv = read_pairs(file(tmp_path, HEADER + "\n1,2,3,4,5,6\n2,3,4,5,6,7\n"))
    np.testing.assert_array_equal(from_json.sensor_m, from_csv.sensor_m)
    np.testing.assert_array_equal(from_json.stack_m, from_csv.stack_m)


@pytest.mark.parametrize(("name", "text", "wanted"), [
    *(("p.csv", text, "sensor_x: the column is missing") for text in ("", "a,b\n1,2\n")),
    ("p.csv", HEADER + "\n1,2,3,4,5\n", "line 2, stack_z: is missing"),
    ("p.csv", HEADER + "\n1,2,3,4,5,6\n1,nan,3,4,5,6\n", "line 3, sensor_y: is not finite"),
    ("p.csv", HEADER + "\n1,2,3,4,5,1e999\n", "line 2, stack_z: is not finite"),
    ("p.csv", HEADER + "\n1,2,3,4,5,1e200\n", r"line 2, stack_z: exceeds 1e\+09: '?1e200"),
    ("p.csv", HEADER + "\n1,2,three,4,5,6\n", "line 2, sensor_z: is not a number: '?three"),
    ("p.json", "{", "malformed"),
    ("p.json", "3", "must be a list"),
    ("p.json", "[1]", "must be a list of objects"),
    ("p.json", '[{"sensor_x": 1}]', "sensor_y: the column is missing"),
    ("p.csv", HEADER + "\n,2,x,4,5,6\n1,2,3,4,5,nan\n1,2,3,4,5,inf\n", "line 2, sensor_x: is missing; line 2, "
     "sensor_z: is not a number: x; line 3, stack_z: is not finite: nan; and 1 more"),
    ("p.json", json.dumps([dict.fromkeys(COLUMNS, True)]), "pair 1, sensor_x: is not a number"),
])  # fmt: skip
def test_a_wrong_file_is_refused_with_its_place(tmp_path: Path, name: str, text: str, wanted: str) -> None:
    path = file(tmp_path, text, name)
    with pytest.raises(InputError, match=wanted) as caught:
        read_pairs(path)
    assert str(path) in str(caught.value)


def test_pairs_of_two_sensors_are_not_mixed(tmp_path: Path) -> None:
    text = HEADER + ",sensor_serial\n1,2,3,4,5,6,A\n1,2,3,4,5,6,B\n"
    with pytest.raises(InputError, match=r"different sensors \(A, B\)"):
        read_pairs(file(tmp_path, text))


def test_it_resumes_and_replaces_a_viewpoint_that_is_taken_again(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    PairsFile(path).accept(captured("v0", x=1.0))
    resumed = PairsFile(path)
    assert resumed.viewpoints == {"v0"}
    resumed.accept(captured("v1", x=2.0))
    resumed.accept(captured("v0", x=3.0))
    assert sorted(read_pairs(path).sensor_m[:, 0]) == [2.0, 3.0]


def test_a_file_of_another_sensor_is_not_gone_on_with(tmp_path: Path) -> None:
    path = tmp_path / "pairs.csv"
    PairsFile(path).accept(captured("v0"))
    with pytest.raises(InputError, match="sensor A1, but this pair is from sensor B2"):
        PairsFile(path).accept(captured("v1", serial="B2"))
    assert len(read_pairs(path)) == 1


def test_pairs_from_a_german_spreadsheet_are_read(tmp_path: Path) -> None:
    text = ";".join(COLUMNS) + "\n0,1;0,2;-0,3;4;5,5;6\n"
    found = read_pairs(file(tmp_path, text))
    assert found.sensor_m.tolist() == [[0.1, 0.2, -0.3]] and found.stack_m.tolist() == [[4.0, 5.5, 6.0]]
    with pytest.raises(InputError, match="line 2, sensor_y: is not a number"):
        read_pairs(file(tmp_path, text.replace("0,2", "0,2,5")))
    with pytest.raises(InputError, match="line 2: has more values than there are columns; with decimal commas"):
        read_pairs(file(tmp_path, text.replace(";", ",")))
    assert len(read_pairs(file(tmp_path, text.replace("\n", ";;\n")))) == 1  # empty columns at the right
