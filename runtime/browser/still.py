"""Make self-contained HTML pages with the layers of a solution and a script that renders views."""

from __future__ import annotations

import base64
import html
import io
import math
import re
import zlib
from collections.abc import Sequence
from functools import cache, partial
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from PIL import Image

from runtime.optics.malus import rest_code
from runtime.optics.stack import PanelStack
from runtime.records import F32, F64, U8
from runtime.support.artifacts import png_bytes, to_json
from runtime.support.threads import parallel_map

WEBP_MAX_PX = 16383
EXTRA_BYTES = 60 << 10  # limit of a page's size beyond the size of its layers as PNG files
PAGE_BYTES = 8_000_000  # maximum size of a page
LAYERS_BYTES = 6_400_000  # maximum size of lossless layers in a page; larger layers (4K) are compressed with losses
QUALITY_BYTES = 512  # size reserved for the lines that report the quality of the compression
QUALITIES = (92, 84, 76, 66, 54)  # AVIF qualities; the first quality at which the pictures fit is used
CODINGS: dict[str, dict[str, Any]] = {
    "png": {},
    "webp": {"lossless": True, "method": 2, "quality": 20},
    "avif": {"speed": 8, "subsampling": "4:4:4"},
}


def asset(name: str) -> str:
    """Return the text of a file in the assets folder."""
    return (files("runtime.browser") / "assets" / name).read_text(encoding="utf-8")


def viewer_html(
    layers: U8,
    wanted: Sequence[U8],
    stack: PanelStack,
    *,
    eyes_m: F64,
    fov_deg: float,
    text: Sequence[str],
    relief: F32 | None = None,
    follows: bool = True,
) -> str:
    """Return the HTML text of a viewer page for one solution.

    Layers are stored without losses if they fit in `LAYERS_BYTES`. Otherwise they are stored as AVIF, and the page
    states their PSNR.

    Args:
        layers: (N, h, w, 3 or 4) layers, rear to front.
        wanted: Target picture (h, w, 3) of each eye, which is compressed to fit into the rest of the page. An empty
            sequence means that the page has no target pictures.
        stack: Panels of the display.
        eyes_m: (2, 3) eyes that the layers were solved for, in frame `stack`.
        fov_deg: Horizontal field of view of the target pictures.
        text: Title of the page, followed by lines of text to show below the controls.
        relief: (h, w) relief of the content (`optics.relief`), or None if the relief is unknown.
        follows: Align the outer panels to the viewer's head until the user switches the alignment off.
    """
    title, *lines = text
    scene = {"stack": stack_table(stack), "eyes_m": eyes_m, "fov_deg": fov_deg, "title": title, "follows": follows}
    scene["lines"] = lines
    if relief is not None:
        deflated = base64.b64encode(zlib.compress(half_floats(relief), 9)).decode()
        scene["relief"] = {"size": relief.shape[::-1], "deflated": deflated}
    parts = {"TITLE": html.escape(title), "CSS": asset("look.css"), "SCRIPT": _script(), "SCENE": _embedded(scene)}
    quick = not wanted  # for a stopped run, layers take a third of the time to encode and 1.5 to 2 times the space
    png_size = 0 if quick else sum(map(len, parallel_map(png_bytes, list(layers))))
    room, coded = min(PAGE_BYTES, EXTRA_BYTES + png_size), 0.0
    stored = parallel_map(partial(_exact, quick=quick), list(layers)) if png_size < 2 * LAYERS_BYTES else []
    if not stored or sum(map(len, stored)) > LAYERS_BYTES:
        stored, coded = _stored(list(layers), LAYERS_BYTES, qualities=(98, *QUALITIES))
    parts["LAYERS"] = _embedded(stored)
    room -= len("".join((*parts.values(), asset("still.html")))) + QUALITY_BYTES
    targets, error = _stored(wanted, room) if wanted else ([], 0.0)
    named = (("Targets", error), ("Layers (exact in their PNG files)", coded))
    quality = [f"{name} are compressed to {-10 * math.log10(square):.0f} dB." for name, square in named if square]
    scene |= {"target_error": error, "lines": [*lines, *quality]}
    parts |= {"SCENE": _embedded(scene), "WANTED": _embedded(targets)}
    return re.sub(r"@([A-Z]+)@", lambda found: parts.get(found[1], found[0]), asset("still.html"))


def half_floats(relief: F32) -> bytes:
    """Encode a relief (h, w) for the script as little-endian 16-bit floats in row-major order."""
    return np.clip(relief, -1e3, 1e3).astype("<f2").tobytes()


def stack_table(stack: PanelStack) -> dict[str, Any]:
    """Return a table for the script with the geometry of the stack and the 8-bit value of panels at rest."""
    fields = ("width_m", "height_m", "x_m", "width_px", "height_px")
    table: dict[str, Any] = {name: getattr(stack, name) for name in fields}
    table["rest_code"] = rest_code(stack.count)
    if stack.tilt is not None:
        table["tilt"] = {"depth": stack.tilt.depth, "seen_from_m": stack.tilt.seen_from_m}
    return table


@cache
def _script() -> str:
    """Concatenate the JavaScript modules into one script without comments, imports and exports."""
    text = "\n".join(asset(name) for name in ("display.js", "look.js", "still.js"))
    return re.sub(r"^ *//.*\n| +// .*$|^ +|^export |^import .*\n", "", text, flags=re.MULTILINE)


def _exact(layer: U8, *, quick: bool) -> str:
    """Encode a layer without losses as a data URL.

    The format is WebP if possible, because WebP files are a third smaller than PNG files, which offsets the growth by
    base64.
    """
    if max(layer.shape) > WEBP_MAX_PX:
        return _url(layer, "png")
    return _url(layer, "webp", **({"method": 0} if quick else {}))


def _stored(pictures: Sequence[U8], room: int, *, qualities: Sequence[int] = QUALITIES) -> tuple[list[str], float]:
    """Encode pictures as AVIF at the first quality at which they fit into `room` bytes.

    Args:
        pictures: Pictures (h, w, 3 or 4).
        room: Maximum total size in bytes. If no quality fits, the last quality is used.
        qualities: AVIF qualities in descending order.

    Returns:
        Data URLs of the pictures, and the mean squared error of the compressed pictures.
    """
    urls: list[str] = []
    for quality in qualities:
        urls = parallel_map(partial(_url, kind="avif", quality=quality), list(pictures))
        if sum(map(len, urls)) <= room:
            break
    coded = [Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB") for url in urls]
    differences = [np.asarray(a, np.float32) - b[..., :3] for a, b in zip(coded, pictures, strict=True)]
    return urls, float(np.mean(np.square(differences)) / 255**2)


def _url(picture: U8, kind: Literal["png", "webp", "avif"], **options: int) -> str:
    coded = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture[..., :3])).save(coded, format=kind, **CODINGS[kind] | options)
    return f"data:image/{kind};base64,{base64.b64encode(coded.getvalue()).decode()}"


def _embedded(value: Any) -> str:
    """Encode a value as JSON without the character `<`, which could end the script element."""
    return to_json(value).replace("<", "\\u003c")
