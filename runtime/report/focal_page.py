"""The section on focal parallax: slices, vergence against accommodation."""

from __future__ import annotations

import numpy as np

from runtime.report.focal import CARDS_M, DISTANCE_M, PUPIL_M, FocalStack
from runtime.report.page import Figure, Section, Table
from runtime.report.plots import drawing, png

NAMES = ("behind the panels", "in the middle panel", "before the panels")


def focal_section(stack: FocalStack) -> Section:
    """The whole section."""
    headings = ["card", "lines of sight meet at, mm", "sharpest through the layers, mm", "sharpest in truth, mm"]
    rows = []
    for name, card in zip(NAMES, stack.cards, strict=True):
        places_m = (card.card_m, card.sharpest_shown_m, card.sharpest_true_m)
        conflict = abs(1 / card.card_m - 1 / card.sharpest_shown_m)
        rows.append([name, *(f"{1000 * place:.0f}" for place in places_m), f"{conflict:.3f}"])
    text = [
        f"Three cards, 5 cm behind, in and 4.5 cm before the middle panel, seen from {DISTANCE_M:g} m by a pupil of "
        f"{1000 * PUPIL_M:g} mm. The layers ({stack.model}) are solved for two pinhole eyes only; what the rest of the "
        "pupil sees nobody asked for. On a flat panel every card is sharpest in the panel's plane, wherever it seems "
        "to stand.",
    ]
    caption = (
        "Vergence against accommodation, from the right eye: up to 0.3 dioptres are commonly taken as comfortable."
    )
    table = Table([*headings, "conflict, dioptres"], rows, caption)
    return Section("Focal parallax", text, [slice_picture(stack)], [table])


def slice_picture(stack: FocalStack) -> Figure:
    """Shown above true, focused behind, in the middle and before."""
    chosen = [min(stack.slices, key=lambda s: abs(s.plane_m - x)) for x in CARDS_M]
    with drawing(9.6, 3.1) as figure:
        axes = figure.subplots(2, 3)
        for column, s in enumerate(chosen):
            for row, image in enumerate((s.shown, s.true)):
                axes[row, column].imshow(np.clip(image, 0, 1), interpolation="nearest")
                axes[row, column].set(xticks=[], yticks=[])
                axes[row, column].grid(visible=False)
            axes[0, column].set_title(f"focused {NAMES[column]}", fontsize=10)
        axes[0, 0].set_ylabel("through the layers")
        axes[1, 0].set_ylabel("true")
    text = "From left to right the eye's lens focuses on the card behind, in and before the middle panel."
    return Figure("focal-slices", png(figure), text)
