"""Tests the changes that `make mutate` makes."""

from __future__ import annotations

from pathlib import Path

from tests.mutate import Coverage, files_of, mutations_of

SOURCE = '''"""Ünïcode before the places that are changed."""
LIMIT: int | 3 = 4

@dataclass(frozen=True)
class Empty: pass

def is_wide(é: int = 0) -> 2:
    log.info("no change")
    close(é)
    return not é < LIMIT and True
'''


def test_each_change_is_one_place_that_still_compiles() -> None:
    source = SOURCE.encode()
    changed = {mutation.applied(source).decode() for mutation in mutations_of(Path("a.py"), source)}
    places = (
        ("= 4", "= (8)"),
        ("= 0)", "= (1))"),
        ("close(é)", "pass"),
        ("é < LIMIT", "(é <= LIMIT)"),
        ("not é < LIMIT", "(é < LIMIT)"),
        ("not é < LIMIT and True", "(not é < LIMIT or True)"),
        ("and True", "and (False)"),
    )
    assert changed == {SOURCE.replace(old, new) for old, new in places}
    for text in changed:
        compile(text, "a.py", "exec")


def test_a_change_meets_the_tests_that_run_it() -> None:
    source, path = SOURCE.encode(), Path("a.py")
    lines = {2: {""}, 8: {"", "a::log"}, 9: {"a::close"}}  # `return` is run by none
    coverage = Coverage({"a::log": 1.0, "a::close": 1.0, "b::other": 1.0}, {path: lines})
    changes = {mutation.text: coverage.tests_of(mutation, source) for mutation in mutations_of(path, source)}
    assert changes[b"(8)"] == {"a::log", "a::close"} and changes[b"pass"] == {"a::close"}
    assert changes[b"(False)"] == set()


def test_kernels_are_changed_by_their_operators_outside_comments() -> None:
    source = b"if (a < b && c) d = e + f;  // g - h"
    changed = [mutation.applied(source) for mutation in mutations_of(Path("a.cpp"), source)]
    assert changed == [source.replace(b"<", b"<="), source.replace(b"&&", b"||"), source.replace(b"+", b"-", 1)]


def test_a_room_is_a_package_a_part_is_a_file() -> None:
    assert {path.name for path in files_of("kernels")} >= {"solver.cpp", "sampling.hpp"}
    assert files_of("content/playlist") == [Path("runtime/content/playlist.py")]
    assert Path("calib/similarity.py") in files_of("calib")
