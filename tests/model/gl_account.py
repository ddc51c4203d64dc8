"""Counts draws, reads, writes and bus transfers of OpenGL."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import moderngl
import pytest

from runtime.model.gl.programs import Image, Passes

CODES, NUMBERS = "codes", "numbers"  # of 8 and of 16 bits
KINDS = {"f1": CODES, "nu2": NUMBERS, "i2": NUMBERS, "f4": "tables"}
BYTES = {"f1": 1, "nu2": 2, "i2": 2, "f4": 4}


@dataclass
class Account:
    """One pass or transfer after the other."""

    passes: list[str] = field(default_factory=list)
    crossed: list[str] = field(default_factory=list)  # "codes up", to the GPU, "numbers down", ...
    bytes: int = 0  # that passes read, each image once, and write


def bytes_of(image: Image) -> int:
    return image.width_px * image.height_px * image.texture.components * BYTES[image.texture.dtype]


@contextmanager
def counted() -> Iterator[Account]:
    """Count in all contexts while the block runs."""
    account = Account()
    draw, write, read_into = Passes.draw, moderngl.Texture.write, moderngl.Framebuffer.read_into

    def drawn(self: Passes, name: str, outputs: Any, inputs: Any, *rest: Any, **more: Any) -> None:
        draw(self, name, outputs, inputs, *rest, **more)
        account.passes.append(name)
        looked = {image.texture.glo: bytes_of(image) for image in inputs.values()}
        account.bytes += sum(looked.values()) + sum(bytes_of(image) for image in outputs)

    def written(self: Any, *given: Any, **more: Any) -> None:
        write(self, *given, **more)
        account.crossed.append(f"{KINDS[self.dtype]} up")

    def read(self: Any, *given: Any, **more: Any) -> None:
        read_into(self, *given, **more)
        account.crossed.append(f"{KINDS[more.get('dtype', 'f1')]} down")

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(Passes, "draw", drawn)
        patched.setattr(moderngl.Texture, "write", written)
        patched.setattr(moderngl.Framebuffer, "read_into", read)
        yield account
