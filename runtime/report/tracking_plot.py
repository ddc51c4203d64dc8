"""The benchmark of the tracker as one figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from runtime.eyes.motions import MOTIONS
from runtime.report.tracking import BEST, EURO, HORIZONS_MS, NONE, SHIPPED, UNPREDICTED, Row, Trade

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STYLES = {
    SHIPPED: ("C0", "-", 2.4),
    BEST: ("k", ":", 1.6),
    UNPREDICTED: ("C2", "--", 1.4),
    EURO: ("C1", "--", 1.4),
    NONE: ("C3", "-.", 1.4),
}


def plot_benchmark(rows: Sequence[Row], trades: Sequence[Trade], path: Path | None = None) -> Figure:
    """p95 error against horizon, a panel a motion, and jitter against lag; written as PNG where a path is given."""
    from matplotlib.figure import Figure

    motions = [m for m in MOTIONS if any(row.motion == m for row in rows)]
    rate_hz = min(row.rate_hz for row in rows)
    columns = (len(motions) + 2) // 2
    figure = Figure(figsize=(4.6 * columns, 7.6), layout="constrained")
    axes = figure.subplots(2, columns, squeeze=False).ravel()
    for axis, motion in zip(axes, motions):
        tops = []
        for method, (colour, dashes, width) in STYLES.items():
            line = [r for r in rows if (r.motion, r.rate_hz, r.method) == (motion, rate_hz, method)]
            axis.plot(
                [r.horizon_ms for r in line],
                [r.p95_mm for r in line],
                dashes,
                color=colour,
                linewidth=width,
                label=method,
            )
            tops += [r.p95_mm for r in line if method == SHIPPED]
        axis.set(title=motion, xlabel="ahead of the newest sample, ms", ylabel="mm", xlim=(0, max(HORIZONS_MS)))
        axis.set_ylim(0, 2.2 * max(tops))
        axis.grid(alpha=0.3)
    trade = axes[len(motions)]
    for method, colour in (("Kalman", "k"), ("One Euro", "C1")):
        curve = sorted((t.lag_ms, t.jitter_mm) for t in trades if t.method == method)
        trade.plot(*zip(*curve), "o-", color=colour, markersize=4, label=f"{method}, by its setting")
    shipped = next(t for t in trades if t.method == SHIPPED)
    trade.plot(shipped.lag_ms, shipped.jitter_mm, "*", color="C0", markersize=16, label=SHIPPED)
    trade.set(title="still head's jitter, moving head's lag", xlabel="lag, ms", ylabel="step to step, mm rms")
    trade.set_ylim(bottom=0)
    trade.legend(fontsize=9)
    trade.grid(alpha=0.3)
    for spare in axes[len(motions) + 1 :]:
        spare.axis("off")
        spare.legend(*axes[0].get_legend_handles_labels(), loc="upper left", title="curves over the horizon")
        note = "Lines that leave a panel at its top\nare worse than the panel shows."
        spare.text(0.02, 0.35, note, transform=spare.transAxes)
    figure.suptitle(
        f"Error of the predicted eyes (worse eye, 95th percentile): {rate_hz} Hz, 3 mm noise, 5 % outliers, dropouts"
    )
    if path is not None:
        from runtime.support.artifacts import write_bytes

        write_bytes(path, _png(figure))
    return figure


def _png(figure: Figure) -> bytes:
    import io

    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
