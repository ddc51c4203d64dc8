"""Print the udev rules for all known sensors. Run `python systemd/make_udev_rules.py`."""

from __future__ import annotations

from runtime.sensor.usb_devices import KNOWN_DEVICES

HEADER = """\
# Known depth cameras: the group plugdev and the user at the seat may open them, and they are never suspended.
# Made by systemd/make_udev_rules.py from runtime/sensor/usb_devices.py.
ACTION=="remove", GOTO="phasestack_end"
SUBSYSTEM!="usb", GOTO="phasestack_end"
"""
FOOTER = 'LABEL="phasestack_end"\n'


def rules() -> str:
    """Return the text of the rules file."""
    lines = []
    for device in KNOWN_DEVICES:
        lines.append(f"# {device.name}")
        lines.append(
            f'ATTR{{idVendor}}=="{device.vendor_id:04x}", ATTR{{idProduct}}=="{device.product_id:04x}", '
            'MODE="0660", GROUP="plugdev", TAG+="uaccess", TEST=="power/control", ATTR{power/control}="on"'
        )
    return HEADER + "\n".join(lines) + "\n" + FOOTER


if __name__ == "__main__":
    print(rules(), end="")
