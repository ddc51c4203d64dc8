"""How every plot of the reports looks; what they show is the sections' business."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

STYLE: dict[str, Any] = {
    "figure.dpi": 130,
    "font.family": "DejaVu Sans",
    "font.size": 9.5,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9aa3b5",
    "axes.labelcolor": "#3a4357",
    "axes.grid": True,
    "grid.color": "#e6e9f0",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": "#5b6478",
    "ytick.color": "#5b6478",
    "legend.frameon": False,
    "lines.linewidth": 1.8,
}
COLOURS = ("#2456c4", "#d9662b", "#1a8f6b", "#a23b8f", "#c9a227", "#5b6478", "#2b9ec9", "#8b1e3f")


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """A matplotlib figure in the reports' style, without pyplot's global state."""
    import matplotlib as mpl
    from cycler import cycler
    from matplotlib.figure import Figure

    settings: Any = STYLE | {"axes.prop_cycle": cycler(color=COLOURS)}
    with mpl.rc_context(settings):
        yield Figure(figsize=(width_in, height_in), layout="constrained")


def png(figure: Any) -> bytes:
    """A figure as PNG, without time stamps: the same data give the same bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
