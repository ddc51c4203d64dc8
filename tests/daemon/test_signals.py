"""Signals become flags."""

from __future__ import annotations

import os
import signal
from typing import Any

import pytest

from runtime.daemon.signals import Signals


def send(number: Any) -> None:
    os.kill(os.getpid(), number)


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_being_asked_to_stop_is_remembered_by_name(name: str) -> None:
    with Signals() as signals:
        assert signals.stop == ""
        send(getattr(signal, name))
        assert signals.stop == name


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


def test_the_handlers_before_are_back_afterwards() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with Signals():
        assert signal.getsignal(signal.SIGTERM) != before
    assert signal.getsignal(signal.SIGTERM) == before
