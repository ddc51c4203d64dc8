"""A black box of a run with a stall in it, and readers of it."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from runtime.blackbox.recorder import Plan, Recorder
from runtime.clock import NS_PER_S
from runtime.config import Settings
from runtime.daemon.build import RunOptions, build_run
from runtime.records import RefreshAccount
from runtime.sensor.recording import Recording, recording_to
from runtime.sensor.replay import demo_recording_path

SMALL: dict[str, Any] = {"stack": {"width_px": 192, "height_px": 108}, "model": {"name": "fast", "threads": 1}}


@dataclass(frozen=True)
class Told:
    """A message as a reader has it."""

    topic: str
    schema: dict[str, Any]
    log_ns: int
    value: dict[str, Any]


def read(path: Path) -> list[Told]:
    """Every message of a file, by the mcap library."""
    from mcap.reader import make_reader

    with path.open("rb") as file:
        return [
            Told(channel.topic, json.loads(schema.data), message.log_time, json.loads(message.data))
            for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages()
            if schema is not None
        ]


def run_of(source: Path, *, recorder: Recorder | None = None) -> list[RefreshAccount]:
    """Every refresh of a recording on the simulated clock."""
    settings = Settings.model_validate({**SMALL, "sensor": {"driver": "replay", "source": str(source)}})
    accounts: list[RefreshAccount] = []
    with ExitStack() as cleanup:
        if recorder is not None:
            cleanup.callback(recorder.close)
        run = build_run(settings, RunOptions(max_speed=True), cleanup, on_account=accounts.append, recorder=recorder)
        run.presenter.run()
    return accounts


@pytest.fixture(scope="session", autouse=True)
def logged() -> Iterator[None]:
    """The daemon logs what is told for information too."""
    logger = logging.getLogger("phasestack")
    before = logger.level
    logger.setLevel(logging.INFO)
    yield
    logger.setLevel(before)


@pytest.fixture(scope="session")
def stalled(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Four seconds of the demo recording, of which one and a half are missing."""
    path = tmp_path_factory.mktemp("stalled") / "stalled.mcap"
    demo = Recording(demo_recording_path())
    with recording_to(path, demo.header) as writer:
        for sample in demo.samples():
            second = (sample.capture_ns - demo.first.capture_ns) / NS_PER_S
            if second < 4.0 and not 1.0 < second < 2.5:
                writer.write(sample)
    yield path


@dataclass(frozen=True)
class Recorded:
    """A run and its black box."""

    path: Path
    accounts: list[RefreshAccount]


@pytest.fixture(scope="session")
def recorded(stalled: Path, tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """`run --replay stalled.mcap --max-speed --record box.mcap`."""
    path = tmp_path_factory.mktemp("recorded") / "deep" / "box.mcap"
    return Recorded(path, run_of(stalled, recorder=Recorder(Plan(record=path))))
