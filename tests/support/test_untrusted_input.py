"""Tests the module through which all untrusted paths, files, JSON and numbers are read."""

from __future__ import annotations

import json
import os
import socket
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.errors import InputError
from runtime.support import untrusted_input
from runtime.support.untrusted_input import parsed_json, whole_from_text
from tests.calls import refusal

HANG_S = 20  # on a busy machine; a hang takes minutes, or never ends


@pytest.mark.parametrize("kind", ["fifo", "folder", "socket", "zero", "full", "null", "gone", "loop"])
def test_only_regular_files_are_read_and_opening_never_waits(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "a"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as bound:
            bound.bind(str(path))
    elif kind == "loop":
        path.symlink_to(path)
    elif kind != "gone":
        path = Path("/dev") / kind
    start = time.monotonic()
    line = refusal(untrusted_input.read_bytes, path, most_bytes=1000)
    assert time.monotonic() - start < HANG_S
    told = {"fifo": "is a FIFO", "folder": "is a folder", "gone": "No such file", "loop": "symbolic links"}
    assert str(path) in line and told.get(kind, "") in line


def test_a_file_is_read_up_to_its_limit_and_refused_beyond(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"x" * 1000)
    assert untrusted_input.read_bytes(tmp_path / "a", most_bytes=1000) == b"x" * 1000
    assert "1000 bytes, but the maximum is 999 bytes" in refusal(
        untrusted_input.read_bytes, tmp_path / "a", most_bytes=999
    )


def test_whether_something_is_there_is_asked_of_names_that_can_be(tmp_path: Path) -> None:
    assert untrusted_input.is_there(tmp_path, folder=True) and untrusted_input.is_there(tmp_path)
    assert not untrusted_input.is_there(tmp_path / "gone") and not untrusted_input.is_there(
        tmp_path / "gone", folder=True
    )
    for name in ("x" * 5000, "a\0b", "/".join(["d" * 200] * 40), "y" * 300):
        with pytest.raises(InputError):
            untrusted_input.is_there(tmp_path / name)


@pytest.mark.parametrize("path", ["a\0b", "x" * 5000, "y" * 300, "é" * 200, "/".join(["z" * 200] * 30)])
def test_what_can_be_no_path_is_refused_by_who_gave_it(path: str) -> None:
    line = refusal(untrusted_input.checked_path, path, source="a.toml", field="content.file")
    assert line.startswith("a.toml: content.file: ")


def test_text_is_utf_8_with_or_without_a_mark(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbfx")
    assert untrusted_input.read_text(tmp_path / "a") == "x"
    (tmp_path / "a").write_bytes(b"ab\xffc")
    assert "is not valid UTF-8 at byte 2" in refusal(untrusted_input.read_text, tmp_path / "a")


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(json_values)
def test_json_comes_back_as_it_is(value: Any) -> None:
    assert parsed_json(json.dumps(value), source="a") == value


@pytest.mark.parametrize("opening", ["[", '{"a":', '[{"b":', "[[],"])
@pytest.mark.parametrize("times", [3000, 100_000, 1_000_000])
def test_json_that_nests_deep_is_refused_in_no_time(opening: str, times: int) -> None:
    start = time.monotonic()
    assert "nested more than 64" in refusal(parsed_json, opening * times, source="a")
    assert time.monotonic() - start < HANG_S


@pytest.mark.parametrize(("opening", "closing"), [("[", "]"), ('{"a":[0,', "]}")])
def test_json_may_nest_so_deep_and_no_deeper(opening: str, closing: str) -> None:
    deepest = 64 // len(closing)
    parsed_json(opening * deepest + "0" + closing * deepest, source="a")
    line = refusal(parsed_json, opening * (deepest + 1) + "0" + closing * (deepest + 1), source="a")
    assert "nested more than 64" in line


@pytest.mark.parametrize(
    "text",
    ["NaN", "[Infinity]", '{"a": -Infinity}', '{"a": 1, "b": 2, "a": 1}', "", "{", "9" * 5000 + "x", b"\xff", "\ud800"],
)
def test_what_is_no_json_is_refused(text: str | bytes) -> None:
    refusal(parsed_json, text, source="a")


@pytest.mark.parametrize("text", ["²", "٣", "", "-", "1_0", "0x1", "1.0", "9" * 5000, "-1", " ", "½"])
def test_digits_are_ascii_ones_and_not_too_many(text: str) -> None:
    assert len(refusal(whole_from_text, text, source="a", field="n")) < 200
