"""A solution as one self-contained HTML file: its layers and the script that traces what eyes see."""

from __future__ import annotations

import base64
import html
import io
import re
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from PIL import Image

from runtime.optics.stack import PanelStack
from runtime.records import F64, U8
from runtime.support.artifacts import to_json

WEBP_MAX_PX = 16383


def asset(name: str) -> str:
    """The text of one of the browser's files."""
    return (files("runtime.browser") / "assets" / name).read_text(encoding="utf-8")


def viewer_html(
    layers: U8,
    wanted: Sequence[U8],
    stack: PanelStack,
    *,
    eyes_m: F64,
    fov_deg: float,
    title: str,
    lines: Sequence[str] = (),
    follows: bool = True,
) -> str:
    """The viewer page. layers: (N, h, w, 3 or 4), rear to front, as shown to eyes (2, 3), frame `stack`.

    Layers are stored exactly. wanted: an (h, w, 3) picture for each eye, `fov_deg` wide, stored to some 48 dB; () where
    none is known; lines: what stands below.
    follows: outer panels follow the head until one says otherwise.
    """
    scene = {"stack": stack_table(stack), "eyes_m": eyes_m, "fov_deg": fov_deg, "title": title, "lines": list(lines)}
    targets = [_stored(picture) for picture in wanted]
    scene |= {"follows": follows, "target_error": float(np.mean([error for _, error in targets] or 0))}
    parts = {
        "TITLE": html.escape(title),
        "CSS": asset("look.css"),
        "SCRIPT": _script(),
        "SCENE": _embedded(scene),
        "LAYERS": _embedded([_exact(layer) for layer in layers]),
        "WANTED": _embedded([url for url, _ in targets]),
    }
    return re.sub(r"@([A-Z]+)@", lambda found: parts.get(found[1], found[0]), asset("still.html"))


def stack_table(stack: PanelStack) -> dict[str, Any]:
    """The stack's geometry as a table for the script."""
    fields = ("width_m", "height_m", "x_m", "width_px", "height_px")
    table: dict[str, Any] = {name: getattr(stack, name) for name in fields}
    if stack.tilt is not None:
        table["tilt"] = {"depth": stack.tilt.depth, "seen_from_m": stack.tilt.seen_from_m}
    return table


@cache
def _script() -> str:
    """The modules as one script: what they export to each other is in one scope."""
    text = "\n".join(asset(name) for name in ("display.js", "look.js", "still.js"))
    return re.sub(r"^export |^import .*\n", "", text, flags=re.MULTILINE)


def _exact(layer: U8) -> str:
    """A layer as a data URL, to the bit; a third smaller than PNG, which makes up for base64."""
    how = {"format": "WEBP", "lossless": True, "method": 2, "quality": 20}
    return _url(layer, **(how if max(layer.shape) <= WEBP_MAX_PX else {"format": "PNG"}))


def _stored(picture: U8) -> tuple[str, float]:
    """A target as a data URL, and the mean square of what its coding changes (1: full scale)."""
    url = _url(picture, format="AVIF", quality=92, speed=8, subsampling="4:4:4")
    decoded = np.asarray(Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB"), np.float32)
    return url, float(np.square((decoded - picture[..., :3]) / 255).mean())


def _url(picture: U8, **how: Any) -> str:
    coded = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture[..., :3])).save(coded, **how)
    return f"data:image/{how['format'].lower()};base64,{base64.b64encode(coded.getvalue()).decode()}"


def _embedded(value: Any) -> str:
    """JSON that ends no script element."""
    return to_json(value).replace("<", "\\u003c")
