"""Draw optics.png, architecture.png, clocks.png and as-built.jpg in docs/images, and the example pair.

Run `python -m docs.make_figures`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch
from PIL import Image, ImageDraw, ImageFont

from phasestack.example import EYES_M, SCENE
from phasestack.example import FOV_DEG as EXAMPLE_FOV_DEG
from runtime.config import ModelSettings, StackGeometry
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.optics.real.cells import Cell
from runtime.optics.real.panels import Placement, RealPanels
from runtime.optics.retina import as_codes, seen_by
from runtime.report.pairs import PairPainter, eyes_at
from runtime.report.tolerance import IMPERFECTIONS, solved, together
from runtime.report.tolerance_page import scene_pair, seen_through
from runtime.support.artifacts import write_png

IMAGES = Path(__file__).resolve().parent / "images"
LEFT, RIGHT, INK, SOFT = "#1f6fb4", "#d1661b", "#222222", "#8a8f98"
FOV_DEG = 40.0
CROP_PX = (240, 160)  # part of the left eye's picture, width and height
RAYS_PASSED = 24  # rays per pixel that pass all panels, about


def arrow(axes: Any, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow between two points in data coordinates."""
    axes.add_patch(FancyArrowPatch(start, end, arrowstyle="-|>", mutation_scale=12, lw=1.4, color=INK))


def box(axes: Any, x: float, y: float, width: float, height: float, text: str, colour: str) -> None:
    """Draw a box with centred text."""
    shape = "round,pad=0.02,rounding_size=0.12"
    axes.add_patch(FancyBboxPatch((x, y), width, height, boxstyle=shape, fc=colour, ec=INK, lw=1.0))
    axes.text(x + width / 2, y + height / 2, text, ha="center", va="center", fontsize=9.5, color=INK)


def blank(figure: Any, place: Any, x: tuple[float, float], y: tuple[float, float]) -> Any:
    """Add axes without ticks or a frame to a figure."""
    axes = figure.add_subplot(place)
    axes.set(xlim=x, ylim=y, xticks=[], yticks=[])
    axes.set_frame_on(False)
    return axes


def optics() -> Figure:
    """Draw the stack from above with both eyes' rays, the layers, and each eye's view."""
    stack = StackGeometry().stack()
    eyes = eyes_at(distance_m=0.6, height_m=0.05)
    with PairPainter("room", stack) as painter:
        pair = painter.pair("room", eyes, off_mm=())
    predictor = load_predictor("balanced", stack, ModelSettings())
    layers = np.array(solve_still(*pair.images, eyes_m=eyes, fov_deg=FOV_DEG, predictor=predictor).layers[..., :3])
    seen = [seen_by(eye, layers, stack, fov_deg=FOV_DEG).codes() for eye in eyes]

    figure = Figure(figsize=(11, 8.2), layout="constrained")
    grid = figure.add_gridspec(3, 6, height_ratios=(2.3, 1, 1.25))
    axes = blank(figure, grid[0, :], (-22, 70), (-31, 31))
    half = 100 * stack.width_m / 2
    axes.fill_between([-20, -16], -half, half, color="#fff3c4")
    axes.text(-18, 0, "backlight", rotation=90, ha="center", va="center", fontsize=9)
    for x, name in ((-11, "polarizer"), (11, "crossed\npolarizer")):
        axes.plot([x, x], [-half, half], color=SOFT, lw=2, ls=(0, (2, 2)))
        axes.text(x, half + 1, name, ha="center", va="bottom", fontsize=8.5, color=SOFT)
    for n, x_m in enumerate(stack.x_m):
        axes.plot([100 * x_m] * 2, [-half, half], color=INK, lw=3)
        axes.text(100 * x_m, -half - 1, f"panel {n}", ha="center", va="top", fontsize=9)
    for eye, colour, name in ((eyes[0], LEFT, "left eye"), (eyes[1], RIGHT, "right eye")):
        x, y = 100 * eye[0], 100 * eye[1]  # in the view from above, the viewer's right is up
        for place in (9.0, -7.0):
            slope = (y - place) / x
            axes.plot([x, -16], [y, place - 16 * slope], color=colour, lw=1.1, alpha=0.8)
            crossings = [100 * x_m for x_m in stack.x_m]
            axes.plot(crossings, [place + slope * c for c in crossings], "o", color=colour, ms=4)
        axes.plot([x], [y], "o", ms=9, color=colour)
        axes.text(x + 1.5, y, name, va="center", fontsize=9.5, color=colour)
    axes.text(34, 22, "along a ray the panels' turns add up:", fontsize=9.5, ha="center")
    axes.text(34, 18.5, r"intensity $= \sin^2\left(\frac{\pi}{2}\,(v_0 + v_1 + v_2)\right)$", fontsize=12, ha="center")
    axes.text(34, -22, "both eyes look through the same pixel of the middle panel\nand through different ones of the"
              " outer panels", fontsize=9.5, ha="center", va="center")  # fmt: skip
    for n, layer in enumerate(layers):
        own = figure.add_subplot(grid[1, 2 * n : 2 * n + 2])
        own.imshow(layer)
        own.set(xticks=[], yticks=[])
        own.set_title(f"what panel {n} is given" + (" (rear)", "", " (front)")[n], fontsize=10)
    for side, (picture, colour) in enumerate(zip(seen, (LEFT, RIGHT), strict=True)):
        own = figure.add_subplot(grid[2, 3 * side : 3 * side + 3])
        own.imshow(picture)
        own.set(xticks=[], yticks=[])
        own.set_title(f"what the {('left', 'right')[side]} eye sees through all three", fontsize=10, color=colour)
    return figure


def architecture() -> Figure:
    """Draw a diagram of the processes and the data they exchange."""
    figure = Figure(figsize=(11, 5.6), layout="constrained")
    axes = blank(figure, 111, (0, 22), (0, 11))
    processes = (
        (0.2, 7.3, 10.0, 3.1, "#eef4fb", "sensor's process"),
        (10.5, 7.3, 5.4, 3.1, "#f7eef8", "measuring process"),
        (16.2, 7.3, 5.6, 3.1, "#f4f4e8", "page's process"),
        (0.2, 3.9, 21.6, 3.1, "#fdf1e7", "presenter's process: the display's clock, one refresh after another"),
        (0.2, 0.1, 4.9, 3.5, "#e9f6f6", "program server's process"),
        (5.4, 0.1, 16.4, 3.5, "#eef8ee", "solver's process: at its own pace"),
    )
    for x, y, width, height, colour, name in processes:
        axes.add_patch(
            FancyBboxPatch((x, y), width, height, boxstyle="round,pad=0,rounding_size=0.2", fc=colour, ec="none")
        )
        axes.text(x + width - 0.2, y + height - 0.15, name, fontsize=9, va="top", ha="right", color=SOFT)
    white = "#ffffff"
    box(axes, 0.6, 7.8, 4.2, 1.6, "sensor: driver or recording\nsensor/polling.py", white)
    box(axes, 5.7, 7.8, 4.2, 1.6, "eyes: pupils in pictures\neyes/detect.py", white)
    box(axes, 10.9, 7.8, 4.6, 1.6, "quality: light at the eyes\nframe/measuring.py", white)
    box(axes, 16.7, 7.8, 4.6, 1.6, "page: state and commands\npage/server.py", white)
    box(axes, 0.6, 4.4, 4.2, 1.6, "calibration: sensor to stack\neyes/calibration.py", white)
    box(axes, 5.7, 4.4, 4.2, 1.6, "tracker: predicts the eyes\neyes/tracker.py", white)
    box(axes, 12.2, 4.4, 4.4, 1.6, "alignment: scale and shift\noptics/alignment.py", white)
    box(axes, 17.4, 4.4, 4.2, 1.6, "panels: one refresh\npanels/presentation.py", white)
    box(axes, 0.55, 1.0, 4.2, 1.6, "programs: their pictures\ndaemon/programs.py", white)
    box(axes, 5.7, 1.0, 4.2, 1.6, "policy: solve, reuse or flat\nframe/policy.py", white)
    box(axes, 10.8, 1.0, 4.2, 1.6, "content: a picture per eye\nplan/drawing.py", white)
    box(axes, 15.9, 1.0, 4.2, 1.6, "model: pictures to layers\nmodel/solver.py", white)
    for start, end in (
        ((4.9, 8.6), (5.6, 8.6)), ((4.9, 5.2), (5.6, 5.2)), ((10.0, 5.2), (12.1, 5.2)), ((16.7, 5.2), (17.3, 5.2)),
        ((10.0, 1.8), (10.7, 1.8)), ((15.1, 1.8), (15.8, 1.8)), ((7.0, 7.7), (3.4, 6.1)), ((7.8, 4.3), (7.8, 2.7)),
        ((16.3, 2.7), (16.3, 4.3)), ((13.2, 6.9), (13.2, 7.7)), ((18.8, 6.9), (18.8, 7.7)), ((19.2, 7.7), (19.2, 6.9)),
        ((12.9, 0.35), (12.9, 0.95)),
    ):  # fmt: skip
        arrow(axes, start, end)
    axes.plot([2.65, 2.65, 12.9], [0.9, 0.4, 0.4], lw=1.4, color=INK, solid_joinstyle="miter")
    axes.text(6.4, 7.15, "samples", fontsize=9, va="center")
    axes.text(13.05, 7.15, "refreshes", fontsize=9, va="center", ha="right")
    axes.text(18.65, 7.15, "status", fontsize=9, va="center", ha="right")
    axes.text(19.35, 7.15, "commands", fontsize=9, va="center")
    axes.text(7.95, 3.6, "eyes to solve for", fontsize=9, va="center")
    axes.text(16.15, 3.6, "newest solution", fontsize=9, va="center", ha="right")
    return figure


def clocks() -> Figure:
    """Draw the samples, solutions and refreshes during a fifth of a second."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = blank(figure, 111, (-38, 205), (-0.7, 3.4))
    refresh_ms, solve_ms, first_ms = 1e3 / 60, 42.0, 18.0
    rows = {"sensor, 30 Hz": 2.6, "solver": 1.6, "refreshes, 60 Hz": 0.4}
    for name, y in rows.items():
        axes.text(-37, y, name, fontsize=9.5, va="center")
        axes.plot([0, 203], [y, y], color="#dddddd", lw=1, zorder=0)
    for k in range(6):
        axes.plot([k * 33.3], [rows["sensor, 30 Hz"]], "v", color=INK, ms=8)
    shades, solutions = ("#9ecae1", "#fdae6b", "#a1d99b", "#d4b9da"), []
    for k in range(4):
        start = first_ms + k * (solve_ms + 3)
        solutions.append(start + solve_ms)
        axes.barh(rows["solver"], solve_ms, left=start, height=0.5, color=shades[k], ec=INK, lw=0.8)
        axes.text(start + solve_ms / 2, rows["solver"], f"solution {k + 1}", ha="center", va="center", fontsize=9)
    shown = 0
    for k in range(12):
        time = k * refresh_ms
        done = sum(end <= time for end in solutions)
        colour = "#eeeeee" if done == 0 else shades[done - 1]
        axes.barh(rows["refreshes, 60 Hz"], refresh_ms * 0.86, left=time, height=0.5, color=colour, ec=INK, lw=0.8)
        if done > shown:
            arrow(axes, (solutions[done - 1], rows["solver"] - 0.28), (time + 4, rows["refreshes, 60 Hz"] + 0.3))
        shown = max(shown, done)
    note = "every refresh shows the newest solution, each panel scaled and shifted to the eyes at its display time"
    axes.text(0, -0.35, note, fontsize=9.5)
    return figure


def as_built() -> Image.Image:
    """Draw what the left eye sees of the build that docs/planning.md recommends, on ideal panels and imperfect ones."""
    stack = replace(StackGeometry().stack(), width_m=0.598, height_m=0.336, colour=(True, True, False))
    subject = solved(scene_pair(stack))
    off = Placement(right_mm=1.6 * stack.width_m / stack.width_px * 1e3)
    kinds = {
        "ideal panels": RealPanels(),
        "front panel 1.6 px off": RealPanels(placement=(Placement(), Placement(), off)),
        "full white of 85°": RealPanels(cells=(Cell(white_deg=85.0),)),
        "mounted by hand": together(IMPERFECTIONS, stack, left=False),
        "and calibrated": together(IMPERFECTIONS, stack, left=True),
    }
    sheet = Image.new("RGB", (len(kinds) * CROP_PX[0], CROP_PX[1]))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    for n, (name, real) in enumerate(kinds.items()):
        sheet.paste(Image.fromarray(as_codes(seen_through(subject, real, RAYS_PASSED, CROP_PX))), (n * CROP_PX[0], 0))
        draw.text((n * CROP_PX[0] + 8, 6), name, fill="white", font=font, stroke_width=3, stroke_fill="black")
    return sheet


def draw_example() -> None:
    """Render the pictures used by `phasestack.example_pair`."""
    stack = replace(StackGeometry().stack(), width_px=640, height_px=360)
    with PairPainter(SCENE, stack) as painter:
        pair = painter.pair(SCENE, np.array(EYES_M), fov_deg=EXAMPLE_FOV_DEG, off_mm=())
    for side, picture in zip(("left", "right"), pair.images, strict=True):
        write_png(IMAGES.parents[1] / "phasestack" / "data" / f"{side}.png", picture)


def main() -> None:
    """Write the example pair and all figures."""
    draw_example()
    for draw in (optics, architecture, clocks):
        draw().savefig(IMAGES / f"{draw.__name__}.png", dpi=110, metadata={"Software": None})
    as_built().save(IMAGES / "as-built.jpg", quality=88, optimize=True)


if __name__ == "__main__":
    main()
