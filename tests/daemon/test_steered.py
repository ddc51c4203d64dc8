"""Tests an operator's changes of placement and model, and a restart."""

from __future__ import annotations

import json
import os
from base64 import b64decode
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.config import Settings
from runtime.daemon.status import about
from tests.daemon.test_changes import Served
from tests.test_cli import refusal


def layers_of(served: Served) -> np.ndarray:
    served.rig.refresh_until_solved()
    return served.rig.presenter.last.frame.solved.copy()


def test_a_scene_is_moved_at_once_and_put_back(tmp_path: Path) -> None:
    with Served(tmp_path, content={"scene": "sparse"}, model={"effort": "full"}) as served:  # layers of one raster
        before = layers_of(served)
        assert served.asked("place", {"offset_m": [0.0, 0.1, 0.0], "scale": 1.5})["ok"]
        assert served.status()["placing"]["scale"] == 1.5
        moved = layers_of(served)
        assert (moved != before).mean() > 0.01
        assert served.asked("place", {"turntable_per_min": 6.0})["ok"]
        assert served.status()["placing"] == {
            "scale": 1.5, "offset_m": [0.0, 0.1, 0.0], "rotation_deg": [0.0, 0.0, 0.0], "turntable_per_min": 6.0,
            "convergence_m": 0.0, "comfort_deg": 0.0,
        }  # fmt: skip
        assert served.asked("place", None)["ok"]
        assert served.status()["placing"]["scale"] == 1.0 and not served.rig.content.info.moving


def test_a_place_that_is_none_is_refused_and_the_scene_stays(tmp_path: Path) -> None:
    refusals = [
        ({"offset": 1}, "value.offset: place accepts only scale"),
        ("left", "value: place requires an object"),
        ({"scale": "large"}, "scale:"),
        ({"scale": 1e9}, "scale:"),
        ({"offset_m": [0, 0]}, "offset_m.2:"),
    ]
    with Served(tmp_path, content={"scene": "sparse"}) as served:
        for value, told in refusals:
            answer = served.asked("place", value)
            assert not answer["ok"] and answer["error"].startswith(told)
        status = served.status()
        assert status["placing"]["offset_m"] == [0.0, 0.0, 0.0] and status["refused"] == answer["error"]


@pytest.mark.parametrize("arguments", [[], ["--reset", "--scale", "2"]])
def test_ctl_place_wants_something_to_change(arguments: list[str]) -> None:
    assert "--scale" in refusal("ctl", "place", *arguments)


def test_a_playlist_is_shown_and_gone_through(tmp_path: Path) -> None:
    shows = [{"scene": "flat", "seconds": 500}, {"scene": "grey", "seconds": 700}]
    path = tmp_path / "two.json"
    path.write_text(json.dumps({"show": shows}))
    with Served(tmp_path) as served:
        assert served.asked("scene", str(path))["ok"]
        assert served.status()["playlist"]["entries"] == shows and served.status()["playlist"]["index"] == 0
        assert "grey (2 of 2)" in served.asked("next")["content"]
        assert served.status()["playlist"]["index"] == 1 and "grey (2 of 2)" in served.status()["content"]
        path.write_text(json.dumps({"show": [{"scene": "demo", "seconds": 10**400}]}))
        answer = served.asked("scene", str(path))  # seen: a number that nothing can hold ended the daemon
        assert not answer["ok"] and "show[0].seconds: " in answer["error"]
        assert served.asked("scene", "flat")["ok"]
        assert "not a playlist" in served.asked("next")["error"]
        for command, value in (("scene", "nope"), ("model", "nope.onnx"), ("place", {"scale": -1})):
            error = served.asked(command, value)["error"]
            assert not error.startswith(("content: ", "model: ", "place: ", "scene: ")), "the command says it already"


def test_the_library_is_offered_with_the_scenes(tmp_path: Path) -> None:
    library = tmp_path / "library"
    library.mkdir()
    for name in ("b.glb", "a.ply", "film_sbs.mp4", "list.toml", "notes.txt", ".hidden.glb"):
        (library / name).touch()
    (library / "lego").mkdir()
    (library / os.fsdecode(b"\xff.glb")).touch()  # no setting can hold such a name
    settings = Settings.model_validate({"content": {"library": str(library)}})
    told = about(settings, settings.stack.stack())
    offered = [Path(name).name for name in told["scenes"] if name.startswith(str(library))]
    assert offered == ["a.ply", "b.glb", "film_sbs.mp4", "lego", "list.toml"]
    assert told["models"][:2] == ("fast", "balanced")


def test_the_page_gets_small_pictures_of_layers_and_eye_views(tmp_path: Path) -> None:
    with Served(tmp_path, content={"scene": "sparse"}) as served:
        layers_of(served)
        told = served.asked("pictures")
        jpegs = {
            name: cv2.imdecode(np.frombuffer(b64decode(text), np.uint8), 1) for name, text in told["jpegs"].items()
        }
        assert set(jpegs) == {"layer-0", "layer-1", "layer-2", "seen-left", "seen-right"}
        assert jpegs["seen-left"].std() > 20 and len({picture.shape for picture in jpegs.values()}) == 1
