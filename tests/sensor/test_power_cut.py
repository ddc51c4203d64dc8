"""Tests what is on the disk after a power cut, using the image of a real file system."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from runtime.blackbox.recorder import write_file
from runtime.sensor.recording import Recording
from runtime.sensor.recording_format import RecordingHeader
from runtime.support.artifacts import OutputFolder, write_text
from tests.waiting import PATIENT, eventually

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        os.getuid() != 0 or shutil.which("mkfs.ext4") is None or not Path("/dev/loop-control").exists(),
        reason="needs root, mkfs.ext4 and loop devices",
    ),
]


def done(*command: str | Path) -> str:
    return subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout.strip()


class Disk:
    """A file system on an image that is written past the page cache: a power cut leaves the image's contents."""

    def __init__(self, folder: Path) -> None:
        self._image, self.mounted, self._cut = folder / "image", folder / "disk", folder / "cut"
        self._image.write_bytes(b"")
        os.truncate(self._image, 64 << 20)
        done("mkfs.ext4", "-q", self._image)
        self._loop = done("losetup", "--direct-io=on", "--show", "--find", self._image)
        self.mounted.mkdir()
        self._cut.mkdir()
        done("mount", self._loop, self.mounted)

    def after_a_power_cut(self) -> Path:
        """The files that are there then."""
        copy = self._image.with_name("copy")
        shutil.copyfile(self._image, copy)
        done("mount", "-o", "loop", copy, self._cut)
        return self._cut

    def close(self) -> None:
        subprocess.run(["umount", self._cut], check=False, capture_output=True)
        done("umount", self.mounted)
        done("losetup", "--detach", self._loop)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Disk]:
    made = Disk(tmp_path)
    yield made
    made.close()


def test_what_is_finished_is_there(disk: Disk) -> None:
    header = RecordingHeader("demo", "")
    made = [disk.mounted / "configuration.toml", disk.mounted / "reports" / "sub" / "report.txt"]
    write_text(made[0], "a = 1\n")
    with OutputFolder(disk.mounted / "reports") as folder:
        write_text(folder.staging / "sub" / "report.txt", "good")
    box = write_file(disk.mounted / "blackbox", "asked", [], header, "{}")
    done(sys.executable, "-c", PATIENT, "record", "--motion", "lean", "--seconds", "5",
         "--out", disk.mounted / "lean.mcap")  # fmt: skip
    left = disk.after_a_power_cut()
    there = {path: (left / path.relative_to(disk.mounted)).read_bytes() for path in (*made, box)}
    assert [there[path] for path in made] == [b"a = 1\n", b"good"]
    assert there[box] == box.read_bytes()
    assert (left / "lean.mcap").read_bytes() == (disk.mounted / "lean.mcap").read_bytes()


def test_of_a_recording_in_progress_the_last_seconds_alone_are_lost(disk: Disk, tmp_path: Path) -> None:
    seconds = 20.0
    config, out = tmp_path / "a.toml", disk.mounted / "long.mcap"
    config.write_text("[sensor]\nloop = true\n")
    process = subprocess.Popen(
        [sys.executable, "-c", PATIENT, "record", "--config", str(config), "--seconds", "600", "--out", str(out)]
    )
    try:
        assert eventually(out.exists)
        time.sleep(seconds)
        samples = list(Recording(disk.after_a_power_cut() / "long.mcap").samples())
    finally:
        process.terminate()
        process.wait()
    assert (samples[-1].capture_ns - samples[0].capture_ns) / 1e9 > seconds - 5.0
