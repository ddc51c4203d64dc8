"""The section on focal parallax: slices, contrast against focus, vergence against accommodation."""

from __future__ import annotations

import numpy as np

from runtime.report.focal import DISTANCE_M, PUPIL_M, FocalStack
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import COLOURS, drawing, png

NAMES = ("behind the panels", "in the middle panel", "before the panels")
SHORT = ("behind", "in the middle", "before")


def focal_section(stack: FocalStack) -> Section:
    """The whole section."""
    rows = [
        [
            f"{1000 * s.plane_m:+.0f}",
            f"{s.psnr_db:.2f}",
            *(f"{a / b:.2f}" for a, b in zip(s.contrast_shown, s.contrast_true, strict=True)),
        ]
        for s in stack.slices
    ]
    slices = Table(
        ["in focus, mm", "PSNR dB", *(f"card {name}" for name in SHORT)],
        rows,
        "Each focal slice against the true one; contrast as a fraction of the true card's at the same focus.",
    )
    conflict = Table(
        [
            "card",
            "lines of sight meet at, mm",
            "sharpest through the layers, mm",
            "sharpest in truth, mm",
            "conflict, dioptres",
        ],
        [
            [
                name,
                f"{1000 * c.card_m:.0f}",
                f"{1000 * c.sharpest_shown_m:.0f}",
                f"{1000 * c.sharpest_true_m:.0f}",
                f"{abs(1 / c.card_m - 1 / c.sharpest_shown_m):.3f}",
            ]
            for name, c in zip(NAMES, stack.cards, strict=True)
        ],
        "Vergence against accommodation, from the right eye. About 0.3 dioptres are commonly taken as comfortable.",
    )
    text = [
        f"Three cards, 5 cm behind, in and 4.5 cm before the middle panel, seen from {DISTANCE_M:g} m by a pupil of "
        f"{1000 * PUPIL_M:g} mm. The layers ({stack.model}) are solved for two pinhole eyes only; what the rest of the "
        f"pupil sees nobody asked for. Exactly at the pinhole: {stack.pinhole_db:.1f} dB.",
        "On a flat panel every card is sharpest in the panel's plane, wherever it seems to stand: how far the solid "
        "tops below lie from that plane, towards the dashed ones, is what the stack gains.",
    ]
    return Section("Focal parallax", text, [slice_picture(stack), contrast_plot(stack)], [slices, conflict])


def slice_picture(stack: FocalStack) -> Figure:
    """Shown above true, focused behind, in the middle and before."""
    chosen = [min(stack.slices, key=lambda s: abs(s.plane_m - x)) for x in (-0.05, 0.0, 0.045)]
    with drawing(9.6, 3.1) as figure:
        axes = figure.subplots(2, 3)
        for column, s in enumerate(chosen):
            for row, (image, name) in enumerate(((s.shown, "through the layers"), (s.true, "true"))):
                axes[row, column].imshow(np.clip(image, 0, 1), interpolation="nearest")
                axes[row, column].set(xticks=[], yticks=[])
                axes[row, column].grid(visible=False)
                if column == 0:
                    axes[row, column].set_ylabel(name)
                if row == 0:
                    axes[row, column].set_title(f"focused {NAMES[column]}", fontsize=10)
    text = "From left to right the eye's lens focuses on the card behind, in and before the middle panel."
    return Figure("focal-slices", png(figure), text)


def contrast_plot(stack: FocalStack) -> Figure:
    """A curve a card: where is it sharpest?"""
    with drawing(9.6, 3.6) as figure:
        all_axes = figure.subplots(1, 3, sharey=True)
        x = [1000 * s.plane_m for s in stack.slices]
        cards = (-50.0, 0.0, 45.0)
        for index, (axes, name, colour) in enumerate(zip(all_axes, NAMES, COLOURS, strict=False)):
            axes.plot(x, [s.contrast_shown[index] for s in stack.slices], marker="o", markersize=4, color=colour)
            axes.plot(x, [s.contrast_true[index] for s in stack.slices], linestyle="--", color=colour, alpha=0.6)
            axes.axvline(cards[index], color="#9aa3b5", linewidth=1)
            axes.set_title(f"card {name}", fontsize=10)
            axes.set_xlabel("in focus, mm before the middle")
        all_axes[0].set(ylabel="contrast of the card", ylim=(0, None))
    text = "Solid: through the layers; dashed: true; grey line: where the card stands. The tops should lie on it."
    return Figure("contrast-against-focus", png(figure), text)
