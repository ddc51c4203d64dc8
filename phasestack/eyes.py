"""The eyes of a picture, from Python."""

from __future__ import annotations

from numpy.typing import ArrayLike

from phasestack.pictures import as_codes, as_picture
from runtime.eyes import pupils
from runtime.eyes.pupils import Pupils


def find_eyes(picture: ArrayLike) -> Pupils | None:
    """The foremost viewer's pupils in an (h, w, 3|4) picture, uint8 or float in 0..1; None where nobody is.

    `eyes_px` is (2, 2): the viewer's left eye first, which is on the right of an unmirrored picture; continuous pixels,
    centres at half-integers. `sigma_px` says how sure they are. Raises ValueError for what is no picture.
    """
    return pupils.find_eyes(as_codes(as_picture("picture", picture)))
