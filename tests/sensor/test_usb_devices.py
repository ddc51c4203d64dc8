"""The doctor sees which depth cameras are plugged in and says what stands in the way."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.sensor.usb_devices import UDEV_RULE, find_devices


def plug_in(folder: Path, usb_id: str, *, speed: str, number: int) -> None:
    """Adds a device to a list as the kernel documents it (ABI/testing/sysfs-bus-usb)."""
    device = folder / "devices" / f"1-{number}"
    device.mkdir(parents=True)
    vendor, product = usb_id.split(":")
    told = {"idVendor": vendor, "idProduct": product, "busnum": "1", "devnum": str(number), "speed": speed}
    for name, value in told.items():
        (device / name).write_text(f"{value}\n")


@pytest.mark.parametrize(
    ("usb_id", "speed", "has_node", "problem"),
    [
        ("045e:02d8", "480", True, "needs USB 3"),
        ("1d27:0600", "480", False, UDEV_RULE),
        ("1d27:0600", "480", True, ""),
        ("045e:02d8", "5000", True, ""),
    ],
    ids=["a Kinect v2 on USB 2", "no permission", "an Xtion", "a Kinect v2 on USB 3"],
)
def test_what_stands_in_the_way_is_told_with_its_remedy(
    tmp_path: Path, usb_id: str, speed: str, has_node: bool, problem: str
) -> None:
    plug_in(tmp_path, usb_id, speed=speed, number=5)
    plug_in(tmp_path, "1d6b:0002", speed="480", number=6)
    (tmp_path / "nodes" / "001").mkdir(parents=True)
    if has_node:
        (tmp_path / "nodes" / "001" / "005").touch()
    (found,) = find_devices(tmp_path / "devices", tmp_path / "nodes")
    assert usb_id in str(found) and speed in str(found)
    problems = found.problems()
    assert len(problems) == bool(problem) and all(problem in each for each in problems)
