"""Show pictures drawn on request by another program, such as a renderer, a game or a web page.

docs/programs.md describes the protocol. If an answer is late or missing, the last pictures stay on the display.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from pydantic import Field

from runtime.config import Section, validated
from runtime.content.base import ContentInfo, ContentSource, View
from runtime.content.camera import clip_from_stack
from runtime.content.placing import SceneFile
from runtime.content.program_server import SIDES, AskedViews, ProgramServer, acquire, release
from runtime.records import U8

NEAR_M, FAR_M = 0.05, 100.0


class ProgramOptions(Section):
    """Options in [content.options] for the scene `program`."""

    port: int = Field(0, ge=0, le=65535, description="TCP port to listen on (0 for any free port)")


def prepare(file: SceneFile) -> Callable[[Any], ContentSource]:
    """Start listening for drawing programs, and return a function that creates the source.

    Raises InputError if the options are invalid or the port cannot be opened.
    """
    options = validated(ProgramOptions, file.settings.options, source="content.options")
    source = ProgramSource(acquire(options.port), background=file.background)
    return lambda context: source


def camera_of(view: View) -> dict[str, Any]:
    """Describe a view, in the form sent to programs.

    The description contains the eye's side and position, and the view and projection matrices for OpenGL as
    column-major lists. Lengths are in metres, and depth is in [-1, 1].
    """
    pixels = view.pixels_from_stack
    forward = pixels[2, :3] / np.linalg.norm(pixels[2, :3])
    right, down = (row[:3] - (row[:3] @ forward) * forward for row in pixels[:2])
    camera = np.eye(4)
    camera[:3, :3] = [right / np.linalg.norm(right), -down / np.linalg.norm(down), -forward]
    camera[:3, 3] = -camera[:3, :3] @ view.eye_m
    clip = clip_from_stack(view, near_m=NEAR_M, far_m=FAR_M)
    clip[1] *= -1  # programs draw with +y up
    matrices = {"view": camera, "projection": clip @ np.linalg.inv(camera)}
    return {"eye": SIDES[view.side], "eye_m": view.eye_m.tolist()} | {
        k: m.T.ravel().tolist() for k, m in matrices.items()
    }


class ProgramSource(ContentSource):
    """Source that shows pictures drawn by a connected program for the requested eye positions."""

    def __init__(self, server: ProgramServer, *, background: Any) -> None:
        """Create a source that gives the server back when it is closed."""
        self._server = server
        self.info = ContentInfo("program", moving=True, background=background)
        self._expected: tuple[int, list[View]] | None = None  # number and views of the requested frame
        self._released = weakref.finalize(self, release, server)

    @property
    def program(self) -> dict[str, Any]:
        return {"address": self._server.address, "frame_ms": self._server.frame_ms}

    @property
    def problem(self) -> str:
        return self._server.problem

    def expect(self, views: Sequence[View], *, time_ns: int) -> None:
        self._expected = None
        width_px, height_px = views[0].width_px, views[0].height_px
        asked = AskedViews(time_ns, width_px, height_px, tuple(camera_of(view) for view in views))
        self._expected = self._server.ask(asked), list(views)

    def render(self, view: View, *, time_ns: int) -> U8:
        if self._expected is None or not any(_same(view, one) for one in self._expected[1]):
            self.expect([view], time_ns=time_ns)
        assert self._expected is not None
        drawn = self._server.drawn(self._expected[0])
        return np.ascontiguousarray(drawn.pictures[view.side])

    def close(self) -> None:
        self._released()


def _same(view: View, other: View) -> bool:
    matrices = view.pixels_from_stack, other.pixels_from_stack
    return view.side == other.side and np.array_equal(*matrices) and view.width_px == other.width_px
