"""Signals become flags."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from runtime.daemon.signals import Signals


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
