"""How large a picture is, by its header alone: nothing is unpacked."""

from __future__ import annotations

import io
import warnings


def picture_size(coded: bytes) -> tuple[int, int]:
    """Width and height of a coded picture, as stored (before any turning by EXIF). Raises ValueError."""
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's own warning of large pictures: the caller has limits
        most, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            with Image.open(io.BytesIO(coded)) as image:
                return image.size
        except Exception as error:  # each of Pillow's formats raises its own
            raise ValueError(f"not a picture that can be read ({type(error).__name__})") from None
        finally:
            Image.MAX_IMAGE_PIXELS = most
