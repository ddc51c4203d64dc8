"""Tests that files are written as a whole or not at all."""

from __future__ import annotations

import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime.errors import InputError
from runtime.support import crash
from runtime.support.artifacts import OutputFolder, held_back, write_bytes


@pytest.mark.parametrize("name", [".", "..", "folder", "/", "", "x" * 300, "/".join(["d" * 200] * 40)])
def test_what_is_no_files_name_is_refused_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    place = tmp_path / "place"
    (place / "folder").mkdir(parents=True)
    monkeypatch.chdir(place)
    with pytest.raises(InputError, match="cannot be written"):
        write_bytes(Path(name), b"x")
    assert [path.name for path in tmp_path.iterdir()] == ["place"]
    assert [path.name for path in place.iterdir()] == ["folder"]


@pytest.fixture
def tiny() -> Iterator[None]:
    """Simulate a full disk: limit this process's files to 4 KiB."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)
    signal.signal(signal.SIGXFSZ, ignored)


@pytest.mark.usefixtures("tiny")
def test_what_the_disk_does_not_take_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a: cannot be written: File too large"):
        write_bytes(tmp_path / "a", bytes(5000))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("tiny")
def test_a_folder_that_cannot_be_written_is_named_as_given(tmp_path: Path) -> None:
    target = tmp_path / "new" / "out"
    with pytest.raises(InputError) as caught, OutputFolder(target) as folder:
        write_bytes(folder.staging / "small", b"x")
        write_bytes(folder.staging / "sub" / "large", bytes(5000))
    assert str(caught.value) == f"{target}/sub/large: cannot be written: File too large"
    with pytest.raises(InputError, match=r"out: cannot be written"), OutputFolder(target) as folder:
        (folder.staging / "gone" / "a").write_bytes(b"x")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("in_the_way", "told"), [("b/c/x", "b/c: is a folder"), ("b", "b: is not a folder")])
def test_an_obstacle_to_one_file_keeps_all_others_from_being_replaced(
    tmp_path: Path, in_the_way: str, told: str
) -> None:
    write_bytes(tmp_path / "a", b"old")
    write_bytes(tmp_path / in_the_way, b"x")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(InputError, match=told), OutputFolder(tmp_path) as folder:
        write_bytes(folder.staging / "a", b"new")
        write_bytes(folder.staging / "b" / "c", b"new")
    assert (tmp_path / "a").read_bytes() == b"old" and sorted(tmp_path.rglob("*")) == before


HELD = """
import os
from runtime.support.artifacts import held_back
with held_back():
    os.write(2, b"a warning\\n")
os.write(2, b"its own\\n")
"""


def test_lines_of_a_library_are_held_back() -> None:
    # In a separate process: the suite's workers have threads.
    answer = subprocess.run([sys.executable, "-c", HELD], capture_output=True, text=True, check=True)
    assert answer.stderr == "its own\n"


def test_another_threads_lines_are_not_held_back(capfd: pytest.CaptureFixture[str]) -> None:
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    with held_back():
        os.write(2, b"told at once\n")
    done.set()
    other.join()
    assert capfd.readouterr().err == "told at once\n"


def test_a_file_replaces_another_whole(tmp_path: Path) -> None:
    for data in (b"one", b"another"):
        write_bytes(tmp_path / "new" / "a", data)
        assert (tmp_path / "new" / "a").read_bytes() == data
    assert len(list((tmp_path / "new").iterdir())) == 1


HOLDS = """
import sys
from pathlib import Path
from runtime.support.artifacts import OutputFolder
with OutputFolder(Path(sys.argv[1])) as folder:
    print(folder.staging.name, flush=True)
    sys.stdin.read()
"""


def test_of_staged_files_only_a_killed_process_s_are_removed(tmp_path: Path) -> None:
    """Another user's folder, and a container's files, were once deleted with it."""

    def writer() -> subprocess.Popen[str]:
        command = [sys.executable, "-c", HOLDS, str(tmp_path)]
        return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    (tmp_path / ".phasestack-backup").mkdir()
    (tmp_path / ".phasestack-backup" / "only-copy.mcap").touch()
    with writer() as killed:
        assert killed.stdout is not None
        left = killed.stdout.readline().strip()
        killed.kill()
    with writer() as living:
        assert living.stdout is not None
        held = living.stdout.readline().strip()
        assert not (tmp_path / left).exists()
        with OutputFolder(tmp_path) as folder:
            write_bytes(folder.staging / "a", b"x")
        assert sorted(path.name for path in tmp_path.iterdir()) == [".phasestack-backup", held, "a"]
    assert (tmp_path / ".phasestack-backup" / "only-copy.mcap").exists()


@pytest.mark.usefixtures("tiny")
def test_an_error_that_the_disk_has_no_room_for_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sixty empty ones were left where twenty are kept."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    told = [crash.written(RuntimeError("x" * 5000)) for _ in range(3)]
    assert all(line.endswith("the crash report could not be written") for line in told)
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == []


@pytest.mark.parametrize("mask", [0o027, 0o077, 0o022])
def test_new_files_keep_the_umask(tmp_path: Path, mask: int) -> None:
    code = (
        f"import os; from pathlib import Path; from runtime.support.artifacts import write_text; "
        f"os.umask({mask}); write_text(Path({str(tmp_path / 'a')!r}), 'x')"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o666 & ~mask
