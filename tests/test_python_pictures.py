"""Tests that pictures of programs become codes, or a ValueError with advice that works."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from phasestack.pictures import as_codes, as_picture
from runtime.support.picture_file import read_image
from tests.content.picture_files import swapped_profile

CODES = np.random.default_rng(4).integers(0, 256, (20, 30, 3), np.uint8)
SMOOTH = np.broadcast_to(np.linspace(20, 230, 30).astype(np.uint8)[None, :, None], (20, 30, 3)).copy()


@pytest.mark.parametrize("mode", ["RGB", "RGBA", "CMYK", "HSV", "YCbCr", "LAB", "L", "LA", "P", "1"])
def test_an_image_of_pillow_is_what_it_shows(mode: str) -> None:
    image = Image.fromarray(SMOOTH).convert(mode)
    found = as_picture("left", image)
    shown = np.asarray(image.convert("RGB") if mode != "LAB" else SMOOTH)
    assert found.dtype == np.uint8 and np.abs(found.astype(int) - shown).max() <= (6 if mode == "LAB" else 0)


def test_an_opened_file_is_read_as_the_command_reads_it(tmp_path: Path) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    for name, mode in (("a.jpg", "CMYK"), ("a.png", "P"), ("b.jpg", "RGB")):
        profile = {"icc_profile": swapped_profile()} if mode == "RGB" else {}
        Image.fromarray(SMOOTH).convert(mode).save(tmp_path / name, exif=exif, **profile)
        with Image.open(tmp_path / name) as image:
            assert np.array_equal(as_picture("left", image), read_image(tmp_path / name))
    data = (tmp_path / "b.jpg").read_bytes()
    (tmp_path / "b.jpg").write_bytes(data[:-60])
    with Image.open(tmp_path / "b.jpg") as image, pytest.raises(ValueError, match="left: cannot be decoded"):
        as_picture("left", image)


def test_a_tensor_is_taken_with_its_gradient_and_in_any_precision() -> None:
    torch = pytest.importorskip("torch")
    floats = torch.tensor(CODES / 255, dtype=torch.float32)
    for tensor in (floats.clone().requires_grad_(), floats.half(), torch.tensor(CODES)):
        assert np.array_equal(as_codes(as_picture("left", tensor)), CODES)
    assert np.abs(as_codes(as_picture("left", floats.bfloat16())).astype(int) - CODES).max() <= 1


def test_a_tensor_without_values_is_refused() -> None:
    torch = pytest.importorskip("torch")
    for tensor in (torch.zeros(CODES.shape, device="meta"), torch.zeros(CODES.shape).to_sparse()):
        with pytest.raises(ValueError, match="left: must be an array of numbers, not Tensor"):
            as_picture("left", tensor)


def test_masked_closed_and_structured_pictures_are_refused_by_name() -> None:
    closed = Image.fromarray(CODES)
    closed.close()
    structured = CODES.view([("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for given, said in (
        (closed, "left: cannot be decoded: Operation on closed image"),
        (np.ma.masked_greater(CODES, 200), r"left: some values are masked; pass left\.filled"),
        (CODES.astype(object), "left: must be an array of numbers, not array of object"),
        (structured, "left: must be an array of numbers, not array of .*red"),
    ):
        with pytest.raises(ValueError, match=said):
            as_picture("left", given)
    assert np.array_equal(as_picture("left", np.ma.masked_array(CODES)), CODES), "nothing is masked"


def test_what_rounding_makes_of_white_and_black_is_white_and_black() -> None:
    picture = np.where(CODES > 127, np.float32(1.0000003), np.float32(-1e-6))
    assert set(np.unique(as_picture("left", picture))) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("given", "advice"),
    [
        (CODES.astype(np.uint16), "np.asarray(left, np.uint8)"),
        (CODES.astype(np.int64), "np.asarray(left, np.uint8)"),
        (CODES.tolist(), "np.asarray(left, np.uint8)"),
        (CODES.astype(np.uint16) * 257, "left / 65535"),
        (CODES.astype(np.float32), "np.clip(left / 255, 0, 1)"),
        (CODES * 1.1 - 10, "np.clip(left / 255, 0, 1)"),
        (CODES / 255 * 1.2 - 0.1, "np.clip(left, 0, 1)"),
        (CODES / 127.5 - 1, "(left + 1) / 2"),
        (CODES * 257.0, "np.clip(left / 65535, 0, 1)"),
        (CODES > 127, "left * np.uint8(255)"),
        (CODES[..., 0], "np.dstack([left] * 3)"),
        (CODES[..., :1], "np.dstack([left] * 3)"),
        (np.moveaxis(CODES, 2, 0), "np.moveaxis(left, 0, -1)"),
        (CODES[None], "left[0]"),
    ],
)
def test_the_advice_of_a_refusal_makes_a_picture(given: Any, advice: str) -> None:
    with pytest.raises(ValueError) as refused:
        as_picture("left", given)
    assert str(refused.value).startswith("left: ") and advice in str(refused.value)
    as_picture("left", eval(advice, {"np": np, "left": given}))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("a.png", r"must be a picture, not a file name; read it with PIL.Image.open\('a.png'\)"),
        (Path("a.png"), r"PIL.Image.open\('a.png'\)"),
        ([[1, 2], [3]], "must be an array of numbers, not list"),
        (np.full((20, 30, 3), "a"), "must be an array of numbers, not array of <U1"),
        (None, "must be an array of numbers, not NoneType"),
        (
            np.full((20, 30, 3), np.nan),
            "values must be from 0 to 1, but range from nan to nan; some values are not finite",
        ),
        (np.zeros((4, 4, 3), np.uint8), "with h and w at least 16"),
        (CODES.astype(np.int32) - 9, "divide by the value of white"),
    ],
)
def test_what_is_no_picture_is_refused_by_its_argument(given: Any, told: str) -> None:
    with pytest.raises(ValueError, match=f"^left: {told}" if not told.startswith(("PIL", "with", "divide")) else told):
        as_picture("left", given)
