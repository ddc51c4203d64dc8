"""Tests that signals become flags."""

from __future__ import annotations

import math
import os
import signal
from typing import Any

import pytest

from runtime.daemon.signals import Signals
from runtime.support.background import patience_s


def send(number: Any) -> None:
    os.kill(os.getpid(), number)


def test_a_burst_of_hangups_is_one_reload() -> None:
    with Signals() as signals:
        send(signal.SIGHUP)
        send(signal.SIGHUP)
        assert signals.take_reload()
        assert not signals.take_reload()
        assert not signals.stop


def test_a_second_interrupt_interrupts() -> None:
    with Signals() as signals:
        send(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            send(signal.SIGINT)
        assert signals.stop == "SIGINT"


def test_once_told_to_stop_all_waits_together_end_within_two_seconds() -> None:
    with Signals():
        assert patience_s(math.inf) == math.inf
        send(signal.SIGTERM)
        first_s = patience_s(10.0)
        send(signal.SIGTERM)  # no new two seconds
        assert 0.0 < patience_s(10.0) <= first_s < 2.0
    assert patience_s(10.0) == 10.0
