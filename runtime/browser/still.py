"""Make self-contained HTML pages that hold a solution's layers and a script to render views of them."""

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
from runtime.records import F32, U8, Eyes
from runtime.support.artifacts import png_bytes, to_json
from runtime.support.threads import parallel_map

WEBP_MAX_PX = 16383
EXTRA_BYTES = 64 << 10  # how much larger a page may be than its layers as PNG files
PAGE_BYTES = 8_000_000  # maximum size of a page
LAYERS_BYTES = 6_400_000  # maximum size of lossless layers in a page; larger ones (4K) are compressed lossily
QUALITY_BYTES = 512  # space reserved for the lines that state how good the compressed pictures are
QUALITIES = (92, 84, 76, 70, 65, 60, 54)  # AVIF qualities, tried in this order until the pictures fit
CODINGS: dict[str, dict[str, Any]] = {
    "png": {},
    "webp": {"lossless": True, "method": 2, "quality": 20},
    "avif": {"speed": 8, "subsampling": "4:4:4"},
}


def asset(name: str) -> str:
    """Return the text of an assets file."""
    return (files("runtime.browser") / "assets" / name).read_text(encoding="utf-8")


def viewer_html(
    layers: U8,
    wanted: Sequence[U8],
    stack: PanelStack,
    *,
    eyes_m: Eyes,
    fov_deg: float,
    text: Sequence[str],
    relief: F32 | None = None,
    follows: bool = True,
) -> str:
    """Return the HTML of a viewer page for one solution, with each eye's target picture, if any, and its
    relief (h, w).

    The layers are stored losslessly if they fit into `LAYERS_BYTES`. If not, they are stored as AVIF, and the page
    states their PSNR. `text` is the page's title, then lines below the controls. If `follows`, the outer panels are
    aligned to the viewer's head until the user switches this off.
    """
    title, *lines = text
    scene = {"stack": stack_table(stack), "eyes_m": eyes_m, "fov_deg": fov_deg, "title": title, "follows": follows}
    scene["lines"] = lines
    if relief is not None:
        deflated = base64.b64encode(zlib.compress(half_floats(relief), 9)).decode()
        scene["relief"] = {"size": relief.shape[::-1], "deflated": deflated}
    parts = {"TITLE": html.escape(title), "CSS": asset("look.css"), "SCRIPT": _script(), "SCENE": _embedded(scene)}
    quick = not wanted  # after a stopped run, encode layers in a third of the time and 1.5 to 2 times the space
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
    """Encode a relief (h, w) for the script, as little-endian 16-bit floats in row-major order."""
    return np.clip(relief, -1e3, 1e3).astype("<f2").tobytes()


def stack_table(stack: PanelStack) -> dict[str, Any]:
    """Return the stack's geometry and the 8-bit value of a panel at rest, as a table for the script."""
    fields = ("width_m", "height_m", "x_m", "width_px", "height_px")
    table: dict[str, Any] = {name: getattr(stack, name) for name in fields}
    table["rest_code"] = rest_code(stack.count)
    if stack.tilt is not None:
        table["tilt"] = {"depth": stack.tilt.depth, "seen_from_m": stack.tilt.seen_from_m}
    return table


@cache
def _script() -> str:
    """Concatenate the JavaScript modules into one script, leaving out comments, imports, exports and some spaces."""
    text = "\n".join(asset(name) for name in ("display.js", "look.js", "still.js"))
    text = re.sub(r"^ *//.*\n| +// .*$|^ +|^export |^import .*\n", "", text, flags=re.MULTILINE)
    operators = r"=>|===?|!==|=|&&|\|\||\?\?|\+=|<=|>="
    return re.sub(rf"(?<=[\w)\]}}\"'`]) ({operators}) ", r"\1", text, flags=re.ASCII)


def _exact(layer: U8, *, quick: bool) -> str:
    """Encode a layer losslessly as a data URL: WebP if possible, because it is a third smaller than PNG."""
    if max(layer.shape) > WEBP_MAX_PX:
        return _url(layer, "png")
    return _url(layer, "webp", **({"method": 0} if quick else {}))


def _stored(pictures: Sequence[U8], room: int, *, qualities: Sequence[int] = QUALITIES) -> tuple[list[str], float]:
    """Encode pictures as AVIF data URLs, by the first of descending qualities, or the last, that fits `room` bytes.
    Also return their mean squared error after compression.
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
    """Encode a value as JSON, escaping `<`, which could otherwise end the script element."""
    return to_json(value).replace("<", "\\u003c")
