"""Starts an X server with three virtual monitors (Xorg's dummy driver) and sends it requests."""

from __future__ import annotations

import ctypes
import os
import select
import shutil
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

WIDTH_PX, HEIGHT_PX = 320, 180
MODE = f"{WIDTH_PX}x{HEIGHT_PX}p"
TIMINGS = ("6.0", "320", "336", "368", "400", "180", "183", "188", "250")  # 60 Hz
OTHER_MODES = {
    "slow": ("5.0", *TIMINGS[1:]),  # the same picture 50 times a second
    "tall": ("3.0", "160", "176", "208", "250", "180", "183", "188", "200"),  # another one
}
CONFIG = """
Section "ServerFlags"
  Option "AutoAddDevices" "false"
  Option "AutoAddGPU" "false"
EndSection
Section "Device"
  Identifier "dummy"
  Driver "dummy"
  VideoRam 64000
EndSection
Section "Monitor"
  Identifier "monitor"
  HorizSync 5-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "screen"
  Device "dummy"
  Monitor "monitor"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Virtual 960 400
  EndSubSection
EndSection
"""
NUMBERS_EACH = 30  # of displays, to a process
NEEDED = ("Xorg", "xrandr", "xwd")


def missing() -> str:
    """Programs missing on this machine; empty: none."""
    absent = [name for name in NEEDED if shutil.which(name) is None]
    if not any(Path(folder, "dummy_drv.so").exists() for folder in ("/usr/lib/xorg/modules/drivers",)):
        absent.append("xserver-xorg-video-dummy")
    return ", ".join(absent)


def start_or_skip(folder: Path) -> XServer:
    """Server with its files in `folder`; skips the test, with the reason, if none can run."""
    if absent := missing():
        pytest.skip(f"no virtual monitors without {absent}")
    return XServer(folder)


def _unused_number() -> int:
    """A number that no other worker's server can take either: one that stopped may be started again with its own."""
    first = NUMBERS_EACH * (1 + os.getpid() % 1000)
    return next(n for n in range(first, first + NUMBERS_EACH) if not Path(f"/tmp/.X11-unix/X{n}").exists())


class XServer:
    """Monitors DUMMY0, DUMMY1, DUMMY2 from left to right, 320x180 each."""

    def __init__(self, folder: Path, display: int | None = None) -> None:
        config = folder / "xorg.conf"
        config.write_text(CONFIG)
        self.number = _unused_number() if display is None else display
        reader, writer = os.pipe()
        self._output = (folder / "xorg.out").open("wb")
        self._process = subprocess.Popen(
            ["Xorg", f":{self.number}", "-displayfd", str(writer), "-config", str(config),
             "-logfile", str(folder / "xorg.log"), "-noreset", "-nolisten", "tcp"],
            pass_fds=(writer,), stdout=self._output, stderr=self._output,
        )  # fmt: skip
        os.close(writer)
        answer = b""
        while not answer.endswith(b"\n") and select.select([reader], [], [], 20.0)[0]:
            if not (part := os.read(reader, 16)):
                break
            answer += part
        os.close(reader)
        if not answer:
            self.stop()
            raise RuntimeError((folder / "xorg.out").read_text()[-500:])
        self.name = f":{self.number}"
        self.xrandr("--newmode", MODE, *TIMINGS)
        for name, timings in OTHER_MODES.items():
            self.xrandr("--newmode", name, *timings)
        for index in range(3):
            for name in (MODE, *OTHER_MODES):
                self.xrandr("--addmode", f"DUMMY{index}", name)
            self.plug(index)

    def xrandr(self, *arguments: str) -> None:
        subprocess.run(["xrandr", "-d", self.name, *arguments], check=True, capture_output=True, timeout=60)

    def plug(self, index: int) -> None:
        """Monitor `index` at its place."""
        self.xrandr("--output", f"DUMMY{index}", "--mode", MODE, "--pos", f"{WIDTH_PX * index}x0")
        self.xrandr("--query")  # the dummy driver detects connections only on a query

    def unplug(self, index: int) -> None:
        """Disconnect monitor `index`."""
        self.xrandr("--output", f"DUMMY{index}", "--off")
        self.xrandr("--query")

    def place(self, *indices: int) -> None:
        """Monitors in this order from left to right, at once, with what was shown on the X screen left in place."""
        arguments = []
        for position, index in enumerate(indices):
            arguments += ["--output", f"DUMMY{index}", "--mode", MODE, "--pos", f"{WIDTH_PX * position}x0"]
        self.xrandr(*arguments)

    def set_mode(self, index: int, name: str) -> None:
        """One of OTHER_MODES, at the monitor's place."""
        self.xrandr("--output", f"DUMMY{index}", "--mode", name, "--pos", f"{WIDTH_PX * index}x0")

    def screenshot(self) -> npt.NDArray[np.uint8]:
        """(h, w, 3) RGB of the whole X screen."""
        command = ["xwd", "-root", "-silent", "-display", self.name]
        for _ in range(5):  # a window that closes while xwd lists it makes it fail
            done = subprocess.run(command, check=False, capture_output=True, timeout=60)
            if done.returncode == 0:
                break
        done.check_returncode()
        data = done.stdout
        header = np.frombuffer(data, ">u4", 25)
        start, stride, width, height = int(header[0] + 12 * header[19]), int(header[12]), int(header[4]), int(header[5])
        pixel_bytes = int(header[11]) // 8  # 4, or 3 where windows of several visuals are put together
        rows = np.frombuffer(data, np.uint8, stride * height, start).reshape(height, stride)
        return np.ascontiguousarray(rows[:, : pixel_bytes * width].reshape(height, width, pixel_bytes)[..., 2::-1])

    def panels(self) -> list[npt.NDArray[np.uint8]]:
        """(180, 320, 3) what each monitor shows, in one picture of all."""
        screen = self.screenshot()[:HEIGHT_PX]
        return [screen[:, WIDTH_PX * index : WIDTH_PX * (index + 1)] for index in range(3)]

    def panel(self, index: int) -> npt.NDArray[np.uint8]:
        """Screenshot of monitor `index`."""
        return self.panels()[index]

    def set_edid(self, index: int, data: bytes) -> None:
        """Give an output the EDID that a real monitor would have brought."""
        with self._connected() as (x11, display):
            randr = ctypes.CDLL("libXrandr.so.2")
            randr.XRRGetScreenResourcesCurrent.restype = ctypes.POINTER(ctypes.c_ulong)
            root = ctypes.c_ulong(x11.XDefaultRootWindow(display))
            resources = randr.XRRGetScreenResourcesCurrent(display, root)
            # XRRScreenResources: two times, count and pointer of CRTCs, count and pointer of outputs.
            output = ctypes.c_ulong(ctypes.cast(ctypes.c_void_p(resources[5]), ctypes.POINTER(ctypes.c_ulong))[index])
            edid, integer, replace = ctypes.c_ulong(x11.XInternAtom(display, b"EDID", 0)), ctypes.c_ulong(19), 0
            randr.XRRChangeOutputProperty(display, output, edid, integer, 8, replace, data, len(data))

    def ask_to_close(self, window: int) -> None:
        """Send WM_DELETE_WINDOW, as a window manager's close button does."""
        with self._connected() as (x11, display):
            protocols = x11.XInternAtom(display, b"WM_PROTOCOLS", 0)
            delete = x11.XInternAtom(display, b"WM_DELETE_WINDOW", 0)
            # XClientMessageEvent: type, serial, send_event, display, window, message_type, format, five longs.
            client_message, bits = 33, 32
            event = (ctypes.c_ulong * 24)(client_message, 0, 1, display.value, window, protocols, bits, delete)
            x11.XSendEvent(display, ctypes.c_ulong(window), 0, ctypes.c_long(0), event)

    def do_to_window(self, request: str, window: int, *arguments: Any) -> None:
        """A request of Xlib about somebody else's window, as another program would make it."""
        with self._connected() as (x11, display):
            getattr(x11, request)(display, ctypes.c_ulong(window), *arguments)

    @contextmanager
    def covered(self, index: int) -> Iterator[None]:
        """A window of another program in front of monitor `index`."""
        with self._connected() as (x11, display):
            x11.XCreateSimpleWindow.restype = ctypes.c_ulong
            root, grey = ctypes.c_ulong(x11.XDefaultRootWindow(display)), ctypes.c_ulong(0x808080)
            place = WIDTH_PX * index, 0, WIDTH_PX, HEIGHT_PX
            window = ctypes.c_ulong(x11.XCreateSimpleWindow(display, root, *place, 0, grey, grey))
            x11.XMapRaised(display, window)
            x11.XSync(display, 0)
            yield
            x11.XDestroyWindow(display, window)
            x11.XSync(display, 0)

    @contextmanager
    def _connected(self) -> Iterator[tuple[ctypes.CDLL, ctypes.c_void_p]]:
        x11 = ctypes.CDLL("libX11.so.6")
        x11.XOpenDisplay.restype = ctypes.c_void_p
        x11.XDefaultRootWindow.restype = x11.XInternAtom.restype = ctypes.c_ulong
        display = ctypes.c_void_p(x11.XOpenDisplay(self.name.encode()))
        yield x11, display
        x11.XCloseDisplay(display)

    def stop(self) -> None:
        """Kill the server, as a crash would. This process, which may be connected to it, disconnects first."""
        from runtime.panels import display

        if display.watch is not None:
            display.watch.stop()
            display.watch = None
            display.glfw.terminate()
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGKILL)
        self._process.wait(timeout=60)
        Path(f"/tmp/.X11-unix/X{self.number}").unlink(missing_ok=True)
        self._output.close()  # harmless when stopped twice
