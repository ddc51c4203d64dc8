"""Log lines for people, journald and machines; repeated ones do not flood."""

from __future__ import annotations

import io
import json
import logging
from pathlib import Path
from typing import Any

import pytest

from runtime.clock import NS_PER_S, SimulatedClock
from runtime.config import ServiceSettings
from runtime.support.logs import BURST, ROOTS, configure

log = logging.getLogger("phasestack.test")


@pytest.fixture(autouse=True)
def restored() -> Any:
    loggers = [logging.getLogger(name) for name in ROOTS]
    before = [(logger.handlers[:], logger.level, logger.propagate) for logger in loggers]
    yield
    for logger, (handlers, level, propagate) in zip(loggers, before, strict=True):
        logger.handlers[:], logger.level, logger.propagate = handlers, level, propagate


def logged(settings: Any = None, clock: Any = None, environment: Any = None) -> Any:
    stream = io.StringIO()
    configure(
        settings or ServiceSettings(), stream=stream, clock=clock or SimulatedClock(), environment=environment or {}
    )
    return stream


def test_people_read_time_level_and_message() -> None:
    stream = logged()
    log.warning("sensor lost: %s", "openni2")
    assert stream.getvalue().split(" ", 1)[1] == "warning sensor lost: openni2\n"


def test_journald_gets_a_priority_and_no_time() -> None:
    stream = logged(environment={"JOURNAL_STREAM": "8:1"})
    log.error("first")
    assert stream.getvalue() == "<3>first\n"


@pytest.mark.parametrize("environment", [{}, {"JOURNAL_STREAM": "8:1"}])
def test_no_name_in_a_message_forges_a_line(environment: Any) -> None:
    stream = logged(environment=environment)
    log.error("unknown scene %s", "x\n<6>12:00:00 info all is well\x1b[2J\0")
    assert stream.getvalue().count("\n") == 1 and "\x1b" not in stream.getvalue() and "\0" not in stream.getvalue()


def test_a_traceback_is_in_a_file_that_the_line_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path))
    stream = logged()
    try:
        raise ValueError("boom")
    except ValueError:
        log.exception("failed")
    assert stream.getvalue().count("\n") == 1 and "Traceback" not in stream.getvalue()
    (file,) = tmp_path.iterdir()
    assert str(file) in stream.getvalue() and "Traceback" in file.read_text() and file.stat().st_mode & 0o777 == 0o600


def test_machines_get_one_object_a_line() -> None:
    stream = logged(ServiceSettings(log_format="json"))
    log.info("state %s", "flat")
    line = json.loads(stream.getvalue())
    assert (line["level"], line["logger"], line["message"]) == ("info", log.name, "state flat")


def test_a_traceback_stays_inside_its_json_line() -> None:
    stream = logged(ServiceSettings(log_format="json"))
    try:
        raise ValueError("boom")
    except ValueError:
        log.exception("failed")
    assert stream.getvalue().count("\n") == 1
    assert "ValueError: boom" in json.loads(stream.getvalue())["exception"]


def test_a_module_that_logs_under_its_own_name_is_heard() -> None:
    stream = logged()
    logging.getLogger("runtime.sensor.worker").warning("sensor: hung")
    assert "sensor: hung" in stream.getvalue()


def test_what_is_below_the_level_is_not_logged() -> None:
    stream = logged(ServiceSettings(log_level="warning"))
    log.info("chatter")
    assert stream.getvalue() == ""


def test_a_message_that_repeats_is_cut_off_and_counted_and_others_still_pass() -> None:
    clock = SimulatedClock()
    stream = logged(clock=clock)
    for number in range(100):
        log.warning("model failed, %d", number)
    log.warning("something else")
    lines = stream.getvalue().splitlines()
    assert len(lines) == BURST + 1
    clock.advance_ns(60 * NS_PER_S)
    log.warning("model failed, %d", 100)
    assert f"({100 - BURST} more like this were not shown)" in stream.getvalue().splitlines()[-1]


def test_configuring_twice_does_not_log_twice() -> None:
    logged()
    stream = logged()
    log.info("once")
    assert stream.getvalue().count("once") == 1
