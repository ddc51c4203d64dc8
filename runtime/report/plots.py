"""How every plot of the reports looks; what they show is the sections' business."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

STYLE = ["seaborn-v0_8-whitegrid", {"figure.dpi": 130, "axes.spines.top": False, "axes.spines.right": False}]


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """A matplotlib figure in the reports' style, without pyplot's global state."""
    from matplotlib import style
    from matplotlib.figure import Figure

    with style.context(STYLE):  # type: ignore[arg-type]
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def png(figure: Any) -> bytes:
    """A figure as PNG, without time stamps: the same data give the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
