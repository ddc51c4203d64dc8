"""How every plot of the reports looks; what they show is the sections' business."""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

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
INK = "#1d2433"
# Where a name may stand beside its dot, in points right and up of it, the best first.
LABEL_PLACES = tuple(
    (right, up) for reach in (8, 16, 26, 38) for up in (7, -7, 0, reach, -reach) for right in (reach, -reach)
)


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


def label_points(figure: Any, axes: Any, points: Sequence[tuple[float, float, str]]) -> None:
    """Name dots so that no name lies on another, on a dot or beyond the axes: each takes the first free place.

    To be called when everything else is drawn. Where no place is free, the least crowded one is taken.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.patheffects import withStroke
    from matplotlib.transforms import Bbox

    if not points:
        return
    canvas = FigureCanvasAgg(figure)
    canvas.draw()  # type: ignore[no-untyped-call]
    renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
    dots = axes.transData.transform([(x, y) for x, y, _ in points])
    frame, point = axes.get_window_extent(renderer), figure.dpi / 72
    halo = [withStroke(linewidth=2.5, foreground="white")]
    taken = [text.get_window_extent(renderer) for text in axes.texts]
    for index in np.argsort(dots[:, 0]):
        x, y, text = points[index]
        style: dict[str, Any] = {"textcoords": "offset points", "va": "center", "fontsize": 8.5, "path_effects": halo}
        style["color"] = INK
        label = axes.annotate(text, (x, y), xytext=(0, 0), ha="left", **style)
        size = label.get_window_extent(renderer)
        others = np.delete(dots, index, axis=0)

        def box(right: float, up: float, dot: Any = dots[index], size: Any = size) -> Any:
            left = dot[0] + right * point - (size.width if right < 0 else 0)
            return Bbox.from_bounds(left, dot[1] + up * point - size.height / 2, size.width, size.height)

        def crowding(place: tuple[float, float], others: Any = others, box: Any = box) -> float:
            own = box(*place)
            inside = frame.x0 <= own.x0 and own.x1 <= frame.x1 and frame.y0 <= own.y0 and own.y1 <= frame.y1
            dots_on_it = (_apart(own, others) < 5 * point).sum()
            return float(dots_on_it + sum(map(own.overlaps, taken)) + 3 * (not inside))

        place = min(LABEL_PLACES, key=crowding)
        taken.append(box(*place))
        label.set(ha="left" if place[0] > 0 else "right")
        label.xyann = place
        if np.hypot(*place) > 14:
            line = {"arrowstyle": "-", "color": "#b8bfcc", "linewidth": 0.7, "shrinkA": 1, "shrinkB": 4}
            axes.annotate("", (x, y), xytext=place, textcoords="offset points", arrowprops=line)


def _apart(box: Any, places: Any) -> Any:
    """How far places (n, 2) are from a box; 0 within."""
    return np.hypot(*np.maximum(np.maximum([box.x0, box.y0] - places, places - [box.x1, box.y1]), 0).T)
