"""Tests picture sizes read from the header before decoding."""

from __future__ import annotations

import cv2
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from runtime.support.picture_header import PNG, is_cut_off, opened

COLOURS = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)


def coded(kind: str) -> bytes:
    return bytes(cv2.imencode(kind, COLOURS)[1].tobytes())


WHOLE = coded(".png")


def test_whole_pictures_and_those_with_something_behind_them_are_not_cut_off() -> None:
    assert not is_cut_off(WHOLE)
    assert not is_cut_off(WHOLE + b"something else")
    assert not is_cut_off(coded(".jpg")[:100])  # other formats are not judged


@given(st.integers(len(PNG), len(WHOLE) - 1))
def test_a_png_is_cut_off_wherever_it_ends_too_early(length: int) -> None:
    assert is_cut_off(WHOLE[:length])


@given(st.integers(len(WHOLE), (1 << 32) - 1))
def test_a_part_that_promises_more_than_there_is_cuts_it_off(promised: int) -> None:
    """Seen: 2,817 bytes that promised 1.9 GB took them."""
    place = WHOLE.index(b"IDAT") - 4
    assert is_cut_off(WHOLE[:place] + promised.to_bytes(4, "big") + WHOLE[place + 4 :])


def test_pillow_has_its_limit_again_when_the_last_of_several_users_leaves() -> None:
    limit = Image.MAX_IMAGE_PIXELS
    first, second = opened(WHOLE), opened(WHOLE)
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert Image.MAX_IMAGE_PIXELS is None  # the second is still reading
    second.__exit__(None, None, None)
    assert limit is not None and limit == Image.MAX_IMAGE_PIXELS
