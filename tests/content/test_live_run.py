"""A minute of a live stream through the whole daemon, with a stall in it: the newest picture is at the light."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("av")
from tests.content.live_camera import BITS, HEIGHT, WIDTH, number_in, numbered_picture
from tests.content.live_run import live_run


@pytest.mark.parametrize("number", [0, 1, 4095, 5461, (1 << BITS) - 1])
def test_a_pictures_number_can_be_read_and_none_from_another_picture(number: int) -> None:
    for side in (0, 1):
        assert number_in(numbered_picture(number, side=side)) == number
    assert number_in(np.full((HEIGHT, WIDTH, 3), 128, np.uint8)) is None


@pytest.mark.slow
def test_a_live_stream_that_stalls_and_hangs_up_is_shown_at_its_newest() -> None:
    told = live_run(seconds=60)
    assert told.failures() == []
    assert told.pictures > 20 and told.connections >= 2
