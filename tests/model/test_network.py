"""Which channel of a picture network is what, checked with a network that answers with its channels' numbers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from runtime.clock import Stopwatch
from runtime.errors import InputError, ModelFailure
from runtime.model.job import Job, drawn_job
from runtime.model.network import PictureProposal
from runtime.optics.stack import PanelStack
from tests.model.scenes import eyes

STACK = PanelStack(0.4, 0.2, (-0.1, 0.0, 0.1), 400, 200)
FILE = Path("mine.onnx")


class Session:
    """A network whose answer in channel c is c/8 everywhere."""

    def __init__(self, **change: Any) -> None:
        port = [SimpleNamespace(name="eyes")]
        given = {
            "width_px": 0, "height_px": 200, "layout": "NCHW", "input_frame": "centre", "eye_order": "left-right",
            "output": "panels", "input_value": "intensity", "branch": 2, "picture_fov_deg": 0.0,
        }  # fmt: skip
        self.contract = SimpleNamespace(**(given | change), inputs=port, outputs=port)

    def check_fits(self, source: Path, feeds: dict[str, Any], answers: dict[str, Any]) -> None:
        self.shapes = feeds["eyes"], answers["eyes"]

    def run(self, feeds: dict[str, Any], shapes: dict[str, Any]) -> dict[str, Any]:
        self.fed = feeds["eyes"].copy()
        shape = shapes["eyes"]
        return {"eyes": np.broadcast_to(np.arange(shape[1])[:, None, None] / 8, shape)}


def job() -> Job:
    colours = ((10, 20, 30, 255), (40, 50, 60, 255))
    return drawn_job([np.full((200, 400, 4), colour, np.uint8) for colour in colours], eyes(0.5), STACK)


def asked(session: Any) -> tuple[dict[int, Any], Any]:
    pictures = PictureProposal(session, STACK, source=FILE)
    return pictures.panels(job(), job().targets.visible, Stopwatch()), session.fed


LEFT, RIGHT = [10, 20, 30], [40, 50, 60]


@pytest.mark.parametrize(
    ("change", "fed", "panels"),
    [
        ({}, LEFT + RIGHT, {0: [0, 510, 1020], 1: [1530, 2040, 2550], 2: [3060, 3570, 4080]}),
        ({"eye_order": "right-left"}, RIGHT + LEFT, {0: [0, 510, 1020], 1: [1530, 2040, 2550], 2: [3060, 3570, 4080]}),
        ({"input_frame": "panel", "output": "outer"}, (LEFT + RIGHT) * 3, {0: [0, 510, 1020], 2: [1530, 2040, 2550]}),
    ],
)
def test_channels_are_ordered_by_panel_eye_and_colour(change: Any, fed: list[int], panels: dict[int, Any]) -> None:
    session = Session(**change)
    found, given = asked(session)
    assert session.shapes == ((1, len(fed), 200, 400), (1, 3 * len(panels), 200, 400))
    assert given[0, :, 0, 0] * 255 == pytest.approx(fed) and given[0, :, -1, -1] * 255 == pytest.approx(fed)
    boxes = job().targets.visible.boxes
    for n, values in panels.items():
        assert found[n].shape == (boxes[n].height_px, boxes[n].width_px, 3)
        assert (found[n] == values).all()
    assert list(found) == list(panels)


def test_phases_may_be_given_and_pictures_may_be_limited_in_view() -> None:
    _, given = asked(Session(input_value="phase", branch=1))
    assert np.sin(given[0, :, 100, 200] * np.pi / 2) ** 2 * 255 == pytest.approx(LEFT + RIGHT, abs=0.01)
    _, given = asked(Session(picture_fov_deg=30.0))  # half of which is 134 mm at half a metre, and 67 mm high
    assert given[0, 0, 100, [60, 72, 330, 345]] * 255 == pytest.approx([0, 10, 10, 0])
    assert given[0, 0, [25, 38, 162, 172], 200] * 255 == pytest.approx([0, 10, 10, 0])


class Wild(Session):
    """A network that exceeds the range of its answer, or has none."""

    wrong = -2.0

    def run(self, feeds: dict[str, Any], shapes: dict[str, Any]) -> dict[str, Any]:
        answer = super().run(feeds, shapes)["eyes"].copy()
        answer[0, 0, 0], answer[0, 2] = self.wrong, 7.0
        return {"eyes": answer}


def test_answers_are_limited_and_finite() -> None:
    found, _ = asked(Wild())
    assert found[0][..., 0].min() == 0 and (found[0][..., 2] == 4080).all()
    session = Wild()
    session.wrong = np.inf
    with pytest.raises(ModelFailure, match="not finite"):
        asked(session)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"width_px": 640}, "contract.width_px: is 640, but the panels have 400; export the model for this size"),
        ({"height_px": 400}, "contract.height_px: is 400, but the panels have 200; export the model for this size"),
        ({"layout": "RNC"}, "contract.layout: RNC cannot be used with the input frame centre"),
    ],
)
def test_a_network_that_does_not_fit_is_refused(change: dict[str, Any], line: str) -> None:
    with pytest.raises(InputError, match=line):
        asked(Session(**change))
