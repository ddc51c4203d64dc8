"""What is in a black box, for its readers: the mcap library, another one, JSON schemas, and `run --replay`."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from collections import Counter
from itertools import groupby
from pathlib import Path

import cv2
import jsonschema
import numpy as np
import pytest

from runtime.clock import NS_PER_S
from tests.blackbox.conftest import Recorded, read, run_of

YEAR_S = 365.25 * 86400
FOXGLOVE = {"/log": "foxglove.Log", "/scene": "foxglove.SceneUpdate", "/tf": "foxglove.FrameTransforms"}


def states(accounts: list) -> list[str]:
    return [key for key, _ in groupby(str(account.state) for account in accounts)]


def test_the_run_had_a_stall_in_it(recorded: Recorded) -> None:
    assert states(recorded.accounts) == ["flat", "tracking", "holding", "flat", "tracking"]


def test_a_replay_of_it_gives_the_same_states_refresh_by_refresh(recorded: Recorded) -> None:
    again = run_of(recorded.path)
    assert [account.state for account in again] == [account.state for account in recorded.accounts]
    for before, after in zip(recorded.accounts, again, strict=True):
        if before.eyes_m is None:
            assert after.eyes_m is None
        else:
            np.testing.assert_allclose(after.eyes_m, before.eyes_m, atol=1e-6)


def test_every_message_is_what_its_schema_says(recorded: Recorded) -> None:
    told = read(recorded.path)
    schemas = {message.topic: message.schema for message in told}
    validators = {topic: jsonschema.validators.validator_for(schema) for topic, schema in schemas.items()}
    for topic, schema in schemas.items():
        validators[topic].check_schema(schema)
    ready = {topic: validators[topic](schema) for topic, schema in schemas.items()}
    for message in told:
        assert message.schema == schemas[message.topic]
        ready[message.topic].validate(message.value)


def test_a_schema_refuses_what_is_none_of_its_messages(recorded: Recorded) -> None:
    message = next(message for message in read(recorded.path) if message.topic == "/scene")
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate({**message.value, "entities": [{"id": 3}]}, message.schema)


def test_it_holds_every_refresh_every_sample_states_scene_pictures_and_log(recorded: Recorded) -> None:
    told = read(recorded.path)
    count = Counter(message.topic for message in told)
    assert count["/refresh"] == len(recorded.accounts)
    assert count["/eyes"] == 76  # of the recording's samples, 30 a second, those that are not missing
    assert count["/tf"] == 1 and count["/clock"] >= 3 and count["/log"] >= 4
    assert {message.schema["title"] for message in told if message.topic.startswith("/picture/")} == {
        "foxglove.CompressedImage"
    }
    for topic, name in FOXGLOVE.items():
        assert {message.schema["title"] for message in told if message.topic == topic} == {name}
    assert [m.value["state"] for m in told if m.topic == "/state"][:4] == ["flat", "tracking", "holding", "flat"]


def test_its_times_are_the_wall_clocks_and_the_monotonic_ones_stand_beside_them(recorded: Recorded) -> None:
    told = read(recorded.path)
    assert all(message.log_ns > 50 * YEAR_S * NS_PER_S for message in told)  # after 2020
    offsets = {
        message.value["wall_ns"] - message.value["monotonic_ns"] for message in told if message.topic == "/clock"
    }
    assert len(offsets) == 1
    refreshes = [message for message in told if message.topic == "/refresh"]
    assert {message.log_ns - message.value["present_ns"] for message in refreshes} == offsets


def test_a_refresh_tells_the_eyes_with_their_covariance_and_its_times(recorded: Recorded) -> None:
    refresh = [m.value for m in read(recorded.path) if m.topic == "/refresh" and m.value["state"] == "tracking"][-1]
    sigma_m = refresh["eye_sigma_mm"] / 1e3
    np.testing.assert_allclose(np.reshape(refresh["eye_covariance_m2"], (3, 3)), np.eye(3) * sigma_m**2, atol=1e-9)
    assert refresh["solution_age_ms"] is not None and refresh["capture_to_light_ms"] > 0
    assert {"sensor", "track", "present"} <= set(refresh["stage_ms"])


def test_its_pictures_can_be_decoded_and_are_not_blank(recorded: Recorded) -> None:
    newest = {m.topic: m.value for m in read(recorded.path) if m.topic.startswith("/picture/")}
    assert set(newest) == {f"/picture/{name}" for name in ("layer-0", "layer-1", "layer-2", "seen-left", "seen-right")}
    for value in newest.values():
        image = cv2.imdecode(np.frombuffer(base64.b64decode(value["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert image.shape == (108, 192, 3) and image.std() > 5


def test_a_second_reader_finds_the_same(recorded: Recorded) -> None:
    """@mcap/core and lz4js (npm) under NODE_PATH: an implementation of its own, in TypeScript."""
    modules = os.environ.get("NODE_PATH", "")
    if shutil.which("node") is None or not (Path(modules) / "@mcap" / "core").is_dir():
        pytest.skip("NODE_PATH names no folder with @mcap/core and lz4js")
    script = Path(__file__).with_name("second_reader.mjs")
    done = subprocess.run(["node", str(script), str(recorded.path)], capture_output=True, text=True, check=True)
    found, ours = json.loads(done.stdout), read(recorded.path)
    assert {topic: told["count"] for topic, told in found["topics"].items()} == Counter(m.topic for m in ours)
    assert {told["schema"] for told in found["topics"].values()} == {m.schema["title"] for m in ours}
    assert found["states"] == [m.value["state"] for m in ours if m.topic == "/state"]
    assert found["first_ns"] == str(min(m.log_ns for m in ours))
