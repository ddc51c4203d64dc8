"""Show a window or a part of an X11 screen, which FFmpeg captures by shared memory (x11grab)."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import av
import numpy as np
from pydantic import Field, model_validator

from runtime.config import Section, validated
from runtime.content.base import ContentSource
from runtime.content.live import Feed, LiveSource, end_group
from runtime.content.placing import SceneFile
from runtime.content.x_server import Pointer, XConnection
from runtime.errors import InputError, one_line
from runtime.records import U8

LOOKS_EVERY_S = 0.5  # how often the window's place is looked up
AGAIN_S = 0.5  # pause before the next attempt
CLICK_S = 0.02  # how often the mouse button is looked at while the user chooses a window
LOOKED_UP_WITHIN_S = 3.0  # time limit for the list of windows, and for a virtual screen's start
OURS = "phasestack"  # class and title of our own panels
BUTTON = 1 << 8  # bit of the first mouse button
INNER = 0.4  # a titled child window that fills this share of its parent is shown instead of it
WINDOW = re.compile(  # a line of `xwininfo -root -tree`
    r'^(?P<indent>\s*)(?P<id>0x[0-9a-f]+) (?P<name>".*"|\(has no name\)): \((?P<kind>.*)\)\s+(?P<w>\d+)x(?P<h>\d+)\S+'
    r"\s+(?P<x>[+-]-?\d+)(?P<y>[+-]-?\d+)\s*$"
)


class WindowOptions(Section):
    """Options for the scene `window`: one of `title`, `pick` and `command`, or only `region`."""

    title: str = Field("", description="part of the window's title or class")
    pick: bool = Field(False, description="show the window on which the user clicks next")
    region: tuple[int, int, int, int] | None = Field(
        None, description="part of the window, or of the screen: left, top, width, height"
    )
    command: tuple[str, ...] = Field((), description="program to start on a virtual screen, with its arguments")
    size_px: tuple[int, int] = Field((1920, 1080), description="size of the virtual screen")
    display: str = Field("", description="X server, by default $DISPLAY")
    rate_hz: Annotated[float, Field(ge=1, le=120)] = Field(30.0, description="largest number of pictures per second")
    pointer: bool = Field(True, description="show the mouse pointer")

    @model_validator(mode="after")
    def _one(self) -> WindowOptions:
        sources = bool(self.title) + self.pick + bool(self.command)
        if sources > 1 or (sources == 0 and self.region is None):
            raise ValueError("set one of title, pick, region and command, such as { title = 'sView' }")
        if self.region is not None and (min(self.region[:2]) < 0 or min(self.region[2:]) < 2):
            raise ValueError("region: must be left, top, width, height, with a size of at least 2 pixels")
        if not all(16 <= edge <= 16384 for edge in self.size_px):
            raise ValueError("size_px: must be from 16 to 16384 pixels")
        return self


@dataclass(frozen=True, slots=True)
class Place:
    """A part of the screen, in pixels."""

    x: int
    y: int
    width: int
    height: int
    window: int = 0  # number of the window that is there, or 0 for a part of the screen
    left: int = 0  # first column and row of the window that is shown
    top: int = 0


def prepare(file: SceneFile) -> Callable[..., ContentSource]:
    """Return a function that creates the source. Raises InputError for wrong options or no X server."""
    options = validated(WindowOptions, file.settings.options, source="content.options")
    needed = {"xwininfo": "x11-utils"} if options.title or options.pick else {"Xvfb": "xvfb"} if options.command else {}
    for program, package in needed.items():
        if shutil.which(program) is None:
            raise InputError("content", "scene", f"window requires {program}; run: sudo apt-get install {package}")
    if not options.command and not (options.display or os.environ.get("DISPLAY")):
        raise InputError("content.options", "display", "is not set, and neither is $DISPLAY")
    return partial(_source, options, file)


def _source(options: WindowOptions, file: SceneFile, context: Any = None) -> ContentSource:
    return LiveSource(WindowFeed(options), file=file)


def place_of(title: str | int, listed: str) -> Place | None:
    """Return the place of the window with a number, or of the largest one whose title or class contains a
    text, in any case, or of the drawing area in it if that is a titled child window. None if there is none but
    our panels. `listed` is what `xwininfo -root -tree` prints.
    """
    windows = [match for line in listed.splitlines() if (match := WINDOW.match(line)) and f'"{OURS}' not in line]

    def is_meant(match: re.Match[str]) -> bool:
        names = f"{match['name']} {match['kind']}".lower()
        return title.lower() in names if isinstance(title, str) else int(match["id"], 16) == title

    def area(match: re.Match[str]) -> int:
        return int(match["w"]) * int(match["h"])

    found = max(filter(is_meant, windows), key=area, default=None)
    if found is None:
        return None
    outer = found
    for match in windows[windows.index(outer) + 1 :]:  # a parent's children follow it
        if len(match["indent"]) <= len(outer["indent"]):
            break
        is_titled = match["name"].startswith('"')
        if is_titled and len(match["indent"]) > len(found["indent"]) and area(match) >= INNER * area(found):
            found = match
    x, y = (int(found[axis].replace("+-", "-").lstrip("+")) for axis in "xy")
    return Place(x, y, int(found["w"]), int(found["h"]), int(found["id"], 16))


class WindowFeed(Feed):
    """Feed that captures a window. It begins again if the window is closed, moved or resized."""

    def __init__(self, options: WindowOptions) -> None:
        name = (
            options.command[0]
            if options.command
            else options.title or ("the window" if options.pick else "the screen's region")
        )
        super().__init__(name)
        self._options = options
        self._picked = 0  # number of the window that the user chose, or 0

    def _run(self) -> None:
        while not self._ends.is_set():
            try:
                with self._screen() as (display, process):
                    while not self._ends.is_set() and (process is None or process.poll() is None):
                        place = self._place(display)
                        self._capture(display, place, process)
                    if process is not None and process.poll() is not None:
                        self.problem = f"{self.name}: ended with exit status {process.returncode}"
            except av.error.FFmpegError as error:  # of which "permission denied" is a window that is not mapped
                is_part = self._options.region is not None
                why = "is smaller than the region, or hidden" if is_part else "is hidden, or was closed or resized"
                self.problem = f"{self.name}: {why} ({error.strerror})"
            except (OSError, ValueError, subprocess.SubprocessError) as error:
                self.problem = one_line(f"{self.name}: {getattr(error, 'strerror', None) or error}")
            self._ends.wait(AGAIN_S)

    def _place(self, display: str) -> Place | None:
        """Return what to show, or None for the whole screen. Raises ValueError for an unknown window."""
        options = self._options
        if not options.title and not options.pick:
            return Place(*options.region) if options.region is not None else None
        if options.pick and not self._picked:
            self._picked = self._clicked(display)
        command = ["xwininfo", "-display", display, "-root", "-tree"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LOOKED_UP_WITHIN_S, errors="replace")
        if done.returncode:
            raise ValueError(f"the X server {display} cannot be used: {done.stderr.strip()}")
        place = place_of(self._picked or options.title, done.stdout)
        if place is None:
            self._picked = 0
            raise ValueError("no window has this title or class" if options.title else "the window cannot be shown")
        if options.region is None:
            return place
        left, top, width, height = options.region
        return Place(place.x + left, place.y + top, width, height, place.window, left, top)

    def _clicked(self, display: str) -> int:
        """Wait for a click, and return the number of the window there. Raises ValueError if there is none."""
        self.problem = "click on the window to show"
        was_down = True
        with closing(XConnection(display)) as pointer:
            while not self._ends.wait(CLICK_S):
                now = pointer.now()
                if now is None:
                    raise ValueError(f"the X server {display} has ended")
                is_down = bool(now.buttons & BUTTON)
                if is_down and not was_down and now.child:
                    return now.child
                was_down = is_down
        raise ValueError("no window was chosen")

    def _capture(self, display: str, place: Place | None, process: subprocess.Popen[bytes] | None) -> None:
        """Take pictures until the scene, the program or the window's place ends."""
        given = {"framerate": f"{self._options.rate_hz:g}", "draw_mouse": "0"}
        source = display
        if place is not None:
            given["video_size"] = f"{place.width}x{place.height}"
            if place.window:  # captured where it is, so that nothing else is shown if it is moved or closed
                given |= {"window_id": str(place.window), "grab_x": str(place.left), "grab_y": str(place.top)}
            else:
                source = f"{display}+{place.x},{place.y}"
        looked_s, last, last_pointer = time.monotonic(), np.empty((0, 0, 3), np.uint8), None
        with ExitStack() as stack:
            server = stack.enter_context(closing(XConnection(display)))
            window = place.window if place is not None else 0
            if window:
                server.keep_covered(window)
            container = stack.enter_context(av.open(source, format="x11grab", options=given))
            for frame in container.decode(video=0):
                rgb: U8 = np.asarray(frame.to_ndarray(format="rgb24"), np.uint8)
                self._seen_s = time.monotonic()
                pointer = pointer_in(server.now(), place, rgb.shape[:2]) if self._options.pointer else None
                is_program = window or process is not None
                problem = f"{self.name}: the program does not respond" if is_program and server.hangs(window) else ""
                if problem != self.problem or pointer != last_pointer or not np.array_equal(rgb, last):
                    self._take(rgb, pointer=pointer, problem=problem)
                    last, last_pointer = rgb, pointer
                if self._ends.is_set() or (process is not None and process.poll() is not None):
                    return
                if (self._options.title or self._picked) and self._seen_s - looked_s > LOOKS_EVERY_S:
                    looked_s = self._seen_s
                    if self._place(display) != place:
                        return

    @contextmanager
    def _screen(self) -> Iterator[tuple[str, subprocess.Popen[bytes] | None]]:
        """Yield the X server's name and, if the scene has a command, its process on a virtual screen."""
        if not self._options.command:
            yield self._options.display or os.environ["DISPLAY"], None
            return
        reading, writing = os.pipe()
        size = "{}x{}x24".format(*self._options.size_px)
        server = subprocess.Popen(
            ["Xvfb", "-displayfd", str(writing), "-screen", "0", size, "-nolisten", "tcp"],
            pass_fds=(writing,),
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        os.close(writing)
        process: subprocess.Popen[bytes] | None = None
        try:
            with os.fdopen(reading, "rb") as told:
                display = f":{told.readline().decode().strip()}"
            if display == ":":
                raise ValueError("the virtual screen did not start")
            environment = os.environ | {"DISPLAY": display}
            process = subprocess.Popen(
                self._options.command, env=environment, stdin=subprocess.DEVNULL, start_new_session=True
            )
            yield display, process
        finally:
            for one in (process, server):
                if one is not None:
                    end_group(one)


def pointer_in(now: Pointer | None, place: Place | None, size_px: tuple[int, ...]) -> tuple[float, float] | None:
    """Return a pointer's place as fractions of a picture's width and height, or None if it is outside."""
    if now is None:
        return None
    left, top = (0, 0) if place is None else (place.x, place.y)
    u, v = (now.x - left + 0.5) / size_px[1], (now.y - top + 0.5) / size_px[0]
    return (u, v) if 0 <= u < 1 and 0 <= v < 1 else None
