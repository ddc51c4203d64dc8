"""Threads that outlive whoever calls on them."""

from __future__ import annotations

import pytest

from runtime.sensor.persistent_thread import PersistentThread, borrowed, give_back


def test_what_a_call_raises_belongs_to_who_asked_and_the_thread_goes_on() -> None:
    thread = PersistentThread("lasting")

    def broken() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        thread(broken)
    assert thread(lambda: 3) == 3


def test_a_thread_that_was_given_back_is_used_again_and_one_that_hangs_is_not() -> None:
    thread = borrowed("lasting")
    give_back(thread)
    assert borrowed("lasting") is thread
    other = borrowed("lasting")
    assert other is not thread
    give_back(thread)
    give_back(other)
