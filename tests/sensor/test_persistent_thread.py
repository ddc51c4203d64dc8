"""Threads that outlive whoever calls on them."""

from __future__ import annotations

import pytest

from runtime.sensor.persistent_thread import borrowed, give_back


def test_what_a_call_raises_belongs_to_who_asked_and_a_thread_that_was_given_back_is_used_again() -> None:
    thread = borrowed("persistent")

    def broken() -> None:
        raise OSError("no")

    with pytest.raises(OSError, match="no"):
        thread(broken)
    assert thread(lambda: 3) == 3
    other = borrowed("persistent")  # the first may hang in a call
    assert other is not thread
    give_back(thread)
    assert borrowed("persistent") is thread
    give_back(thread)
    give_back(other)
