"""Figure of a registration by photographs: where the camera stood, and how the panels lie."""

from __future__ import annotations

import numpy as np

from calib.figures import COLOURS
from calib.photo_registration import PhotoRegistration
from calib.placed import stack_from_pixels
from runtime.optics.stack import PanelStack
from runtime.report.plots import drawing, png


def photo_figure(found: PhotoRegistration, stack: PanelStack) -> bytes:
    """From above and from the side: panels and the camera's places; then each panel's corners, enlarged."""
    moving = [index for index in range(stack.count) if index != found.bundle.reference]
    with drawing(5 * (2 + len(moving)), 4.4) as canvas:
        axes = canvas.subplots(ncols=2 + len(moving), squeeze=False)
        places = found.bundle.places_m
        for axis, (panel_axes, name) in enumerate(
            zip(axes[0][:2], ("from above", "from the side"), strict=True), start=1
        ):
            for index, panel in enumerate(found.bundle.panels):
                ends = np.array([[0, 0, 1], [stack.width_px, stack.height_px, 1]]) @ stack_from_pixels(panel, stack).T
                panel_axes.plot(ends[:, axis], ends[:, 0], color=COLOURS[index % len(COLOURS)], label=f"panel {index}")
            panel_axes.plot(places[:, axis], places[:, 0], "o", color="#222222", markersize=4, label="camera")
            panel_axes.set(
                title=name,
                xlabel="y, to the right (m)" if axis == 1 else "z, up (m)",
                ylabel="x, before the display (m)",
            )
            panel_axes.set_aspect("equal", adjustable="datalim")
            panel_axes.legend(fontsize=8)
        corners = np.array([[0, 0], [stack.width_px, 0], [stack.width_px, stack.height_px], [0, stack.height_px]])
        for plot, index in zip(axes[0][2:], moving, strict=True):
            shift = found.corners_px[index]
            gain = 0.1 * stack.width_px / max(float(np.linalg.norm(shift, axis=1).max()), 1e-6)
            for points, colour, label in ((corners, "#999999", "ideal"), (corners + gain * shift, COLOURS[0],
                                                                         f"true, shifts ×{gain:.0f}")):  # fmt: skip
                closed = np.vstack([points, points[:1]])
                plot.plot(closed[:, 0], closed[:, 1], color=colour, label=label)
            for place, value in zip(corners + gain * shift, shift, strict=True):
                plot.annotate(f"{value[0]:+.1f}, {value[1]:+.1f}", place, fontsize=8, ha="center")
            plot.set_title(f"panel {index}: corners (px)")
            plot.invert_yaxis()
            plot.margins(0.15)
            plot.set_aspect("equal", adjustable="datalim")
            plot.legend(fontsize=8)
        return png(canvas)
