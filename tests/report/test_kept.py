"""A long measurement that is stopped keeps its parts; the next one goes on from there."""

from __future__ import annotations

import stat
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from runtime.report.kept import KeptParts


@dataclass(frozen=True)
class Found:
    value: float
    picture: np.ndarray


class Work:
    """Three parts, of which one can be interrupted."""

    def __init__(self) -> None:
        self.made: list[str] = []
        self.stop_at = ""

    def __call__(self, kept: KeptParts) -> list[float]:
        return [kept.part(name, lambda name=name: self.make(name)).value for name in ("a 1", "b/2", "c")]

    def make(self, name: str) -> Found:
        if name == self.stop_at:
            raise KeyboardInterrupt
        self.made.append(name)
        return Found(float(len(self.made)), np.zeros((2, 2)))


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def parts(*, facts: object = 1, fresh: bool = False) -> KeptParts:
    return KeptParts("test", sources=[], facts=facts, fresh=fresh)


def test_a_stopped_one_goes_on_where_it_was() -> None:
    work = Work()
    work.stop_at = "c"
    with pytest.raises(KeyboardInterrupt):
        work(parts())
    work.stop_at = ""
    again = parts()
    assert work(again) == [1.0, 2.0, 3.0]
    assert work.made == ["a 1", "b/2", "c"] and again.earlier == ["a 1", "b/2"]


@pytest.mark.parametrize(("facts", "fresh"), [(2, False), (1, True)])
def test_another_measurement_and_a_fresh_one_begin_anew(facts: int, fresh: bool) -> None:
    work = Work()
    work(parts())
    other = parts(facts=facts, fresh=fresh)
    work(other)
    assert len(work.made) == 6 and other.earlier == []


def test_once_complete_nothing_is_left(tmp_path: Path) -> None:
    kept = parts()
    Work()(kept)
    assert list((tmp_path / "cache").rglob("*.pickle"))
    kept.forget()
    assert not list((tmp_path / "cache").rglob("*.pickle"))


def test_a_torn_part_is_made_again_and_one_that_others_may_write_is_not_read(tmp_path: Path) -> None:
    work = Work()
    work(parts())
    (folder,) = {path.parent for path in (tmp_path / "cache").rglob("*.pickle")}
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    (torn,) = folder.glob("c-*.pickle")
    torn.write_bytes(b"\x80\x04torn")
    work(parts())
    assert work.made.count("c") == 2 and work.made.count("a 1") == 1
    folder.chmod(0o777)
    work(parts())
    assert work.made.count("a 1") == 2


def test_names_that_are_alike_in_a_files_name_are_different_parts_and_what_cannot_be_kept_is_made() -> None:
    assert [parts().part(name, lambda name=name: name) for name in ("fast ½", "fast ¾", "fast/½")] == [
        "fast ½", "fast ¾", "fast/½",
    ]  # fmt: skip
    assert parts().part("fast ¾", lambda: "anew") == "fast ¾"
    assert parts().part("odd", lambda: lambda: 1)() == 1
    assert parts().part("odd", lambda: lambda: 2)() == 2
