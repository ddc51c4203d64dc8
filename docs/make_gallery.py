"""Writes docs/performance.md, from one demo and one report, and the pages' pictures. `make gallery` (minutes), or

    python -m docs.make_gallery [--work FOLDER] [--keep] [REPORT OPTION ...]

`--keep` reuses the work folder of an earlier call. Other options (such as `--quick`) are passed to the report.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import phasestack
from calib.board import boards as boards_of
from calib.placed import ideal_panel
from runtime.config import StackGeometry
from runtime.optics.alignment import align, shown_layers
from runtime.optics.retina import seen_by
from runtime.records import PanelFrame
from runtime.report.pairs import PairPainter, eyes_at
from tests.calib.simulator import Camera, camera_from_stack, photograph

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images"
WIDTH_PX, LIMIT_BYTES = 1200, 200_000
MOVED_MM, MOVED_FRAMES, MOVED_MS = 70, 16, 90  # the head's way to either side, and the pictures of it
PICTURES = {  # in docs/images, by the file of a command that they are made from
    "boards.jpg": "boards.png",
    "kinds.jpg": "kinds.png",
    "contact-sheet.jpg": "demo/contact-sheet.png",
    "frontier.png": "report/frontier-scenes.png",
    "moving-viewer.png": "report/moving-viewer.png",
    "focal-slices.jpg": "report/focal-slices.png",
}
# Measured with the commands that it names, on 2026-11-25: not by this script.
CHOSEN = """\
With `model.effort = "auto"` the loop chooses raster and steps for each solution ([how](mathematics.md#effort)).
Costs of a slow processor (render 44, prepare 40, inference 31, finish 38, step 85 ms on the full raster), 960x540,
0.3 mm of sensor noise, seed 780: `record --motion NAME --seed 780 --noise-mm 0.3 --seconds 12`, then
`run --max-speed --scale 0.5`.

| motion | live, dB | view error, mm | 95% | efforts, most of the time |
| --- | --- | --- | --- | --- |
| still | 27.9 | 0.8 | 2.9 | 1/1+0, 1/1+1 |
| lean | 21.0 | 5.1 | 11.1 | 1/2+0 |
| walk | 20.4 | 10.4 | 95 | 1/3+0 |
| stop-and-go | 22.5 | 1.7 | 23.2 | 1/2+0, 1/3+0 |
"""
HEAD = """\
<!-- Written by `make gallery`: change docs/make_gallery.py, not this page. -->

# Performance: light against run time

    phasestack report --out report            # the page is there within a minute, and grows
    phasestack report --pairs DIR --focal     # on your own pairs too, and with focal parallax
    phasestack bench --out new.json           # the regression file
    phasestack bench compare old.json new.json

**Quote light, at a tracking error of 1 mm** (`light_db`, `"1"`). It, *one ray* (`psnr_db`) and *carried* are
[defined in contracts](contracts.md#error); *time* is that of a whole solution, from two decoded pictures to 8-bit
layers. Every method runs in a separate process, whose peak is its memory. Times hold for one machine and hour:
compare ratios. The published network (`eyereal`), exported from its checkpoint, is compared as `--model FILE.onnx`.

`bench compare` divides times by a yardstick of the same run, does not compare them where the machine was busy, and
exits with 1 if a model got slower by more than the noise, lost 0.1 dB or took 15% more memory.

A [case file](contracts.md#cases-pairs-calibration) is any `*.json` in DIR like this one; `off` (optional) is what
should be seen `mm` away from an eye:

    {"panels": {"width_m": 0.5184, "height_m": 0.2916, "x_m": [-0.06, 0.0, 0.06]},
     "eyes": [[0.78, -0.03, 0.24], [0.78, 0.03, 0.24]], "images": ["left.png", "right.png"], "fov": 40.0,
     "off": [{"mm": 2, "eye": [0.78, -0.028, 0.24], "image": "left-2mm-right.png"}]}

![what the demo leaves: layers, and what each eye should see, sees, and the difference](images/contact-sheet.jpg)

"""


def page(report: dict[str, Any]) -> str:
    """The text of docs/performance.md."""
    machine = report["machine"]
    facts = f"{machine['processor']}, {machine['cores']} cores, phasestack {machine['phasestack']}, {machine['date']}"
    methods = sorted(report["methods"], key=lambda method: method["ms_p50"])
    quickest = methods[0]["ms_p50"]
    size = f"{methods[0]['width_px']}x{methods[0]['height_px']}"
    rows = [
        [method["name"], f"{method['ms_p50'] / quickest:.1f}", f"{method['ms_p50']:.0f}", f"{method['memory_mib']:.0f}"]
        + [_number(method["light_db"].get(key)) for key in ("0", "1", "2")]
        + [_number(method["psnr_db"])]
        for method in methods
    ]
    moving = [
        [
            one["motion"],
            f"{one['solver_ms']:g}",
            *map(_number, (one["live_db"], *one["view_error_mm"], one["tracker_mm"][0])),
        ]
        for one in report["moving"]
    ]
    cards = [[f"{1000 * card[key]:.0f}" for key in card] for card in report["focal"]["cards"]]
    return "\n".join(
        [
            HEAD,
            f"## Error against run time\n\nBuilt-in scenes, panels of {size}; `{report['command']}`; {facts}.\n",
            _table(["method", "× fastest", "ms", "MiB", "light 0 mm, dB", "**1 mm**", "2 mm", "one ray"], rows),
            "![light against run time](images/frontier.png)\n",
            "## What a moving viewer sees\n",
            "The daemon's own loop on the simulated clock, with solvers of the given times. *Live* is\n"
            "[defined in contracts](contracts.md#error): the light at the true eyes against what they should see from\n"
            "there at that refresh, so that a stale view counts.\n",
            _table(["motion", "solver, ms", "live, dB", "view error, mm", "95%", "tracking error, mm"], moving),
            "![live quality](images/moving-viewer.png)\n",
            CHOSEN,
            "## Focal parallax\n",
            "Three cards, seen by a pupil of 4 mm: where the eyes converge on each, where its picture is sharpest\n"
            "through the layers, and where in truth.\n",
            _table(["card at, mm", "sharpest through the layers", "sharpest in truth"], cards),
            "![focused behind, in and before the panels](images/focal-slices.jpg)",
            "",
        ]
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def kinds(folder: Path) -> Image.Image:
    """Contact sheet of `examples/content.py`: front layer, both eyes' views, and the left eye's target."""
    names = ("layer-2.png", "seen-left.png", "seen-right.png", "wanted-left.png")
    runs = sorted(path.parent for path in folder.glob(f"*/{names[0]}"))
    width, height, rows = 176, 99, -(-len(runs) // 2)
    sheet = Image.new("RGB", (2 * len(names) * width + 8, rows * (height + 16)), "white")
    for number, run in enumerate(runs):
        x, y = number // rows * (len(names) * width + 8), number % rows * (height + 16)
        ImageDraw.Draw(sheet).text((x + 2, y + 2), run.name, fill="black")
        for column, name in enumerate(names):
            sheet.paste(Image.open(run / name).convert("RGB").resize((width, height)), (x + column * width, y + 15))
    return sheet


def boards() -> Image.Image:
    """Boards of three panels seen by a phone from the left."""
    stack = StackGeometry().stack()
    panels = [ideal_panel(stack, index) for index in range(stack.count)]
    pose = camera_from_stack(np.array([0.44, -0.26, 0.07]), towards_m=np.array([0.0, -0.06, 0.0]))
    camera = Camera(800, 600, 610.0)
    return Image.fromarray(photograph(boards_of(stack), panels, stack, camera, pose, np.random.default_rng(0)))


def look_into(folder: Path) -> None:
    """Write `looked-into.webp` (an eye's view while the head moves, with unaligned and aligned outer panels) and the
    solution's `viewer.html`."""
    stack = replace(StackGeometry().stack(), width_px=640, height_px=360)
    eyes = eyes_at(distance_m=0.65, angle_deg=4, height_m=0.08)
    with PairPainter("room", stack) as painter:
        pair = painter.pair("room", eyes, stack, off_mm=())
    result = phasestack.solve(*pair.images, eyes_m=eyes, stack=stack)
    result.save(folder)
    codes = np.concatenate([result.layers, np.full_like(result.layers[..., :1], 255)], axis=-1)
    frames = []
    for k in range(MOVED_FRAMES):
        now = eyes + np.array([0.0, MOVED_MM / 1000 * math.sin(2 * math.pi * k / MOVED_FRAMES), 0.0])
        maps = align(stack, solved_for_m=eyes, eyes_m=now).solved_from_shown
        aligned = shown_layers(PanelFrame(k, codes, 1, maps))
        seen = [seen_by(now[0], layers, stack, fov_deg=46) for layers in (codes, aligned)]
        sheet = Image.new("RGB", (2 * stack.width_px, stack.height_px))
        for n, retina in enumerate(seen):
            picture = np.rint(255 * np.where(retina.mask[..., None], retina.image, 0.1)).astype(np.uint8)
            sheet.paste(Image.fromarray(picture), (n * stack.width_px, 0))
        sheet, moved_mm = sheet.resize((960, 270), Image.Resampling.LANCZOS), 1000 * (now - eyes)[0, 1]
        side = "right" if moved_mm > 0 else "left"
        _label(sheet, (8, 8), "panels as they were solved")
        _label(sheet, (488, 8), "the same, aligned at every refresh")
        _label(sheet, (8, 244), f"the head is {abs(moved_mm):.0f} mm to the {side}")
        frames.append(sheet)
    path = folder / "looked-into.webp"
    options: dict[str, Any] = {"duration": MOVED_MS, "loop": 0, "method": 6}
    for quality in range(60, 10, -10):
        frames[0].save(path, save_all=True, append_images=frames[1:], quality=quality, **options)
        if path.stat().st_size <= LIMIT_BYTES:
            return
    raise SystemExit(f"{path.name}: more than {LIMIT_BYTES} bytes")


def _label(sheet: Image.Image, place: tuple[int, int], text: str) -> None:
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    draw.text(place, text, fill="white", font=font, stroke_width=3, stroke_fill="black")


def smaller(source: Path, name: str) -> bytes:
    """A picture as the pages show it. Raises SystemExit if it stays too large."""
    image = Image.open(source).convert("RGB")
    image.thumbnail((WIDTH_PX, 10 * WIDTH_PX), Image.Resampling.LANCZOS)
    for quality in range(90, 50, -5):
        file = io.BytesIO()
        if name.endswith(".jpg"):
            image.save(file, "JPEG", quality=quality, optimize=True)
        else:
            image.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
        if file.tell() <= LIMIT_BYTES:
            return file.getvalue()
    raise SystemExit(f"{name}: more than {LIMIT_BYTES} bytes")


def main() -> None:
    """Run, and only then write: a command that fails leaves the page as it was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=DOCS.parent / "out" / "gallery")
    parser.add_argument("--keep", action="store_true")
    arguments, options = parser.parse_known_args()
    for command in (["demo"], ["report", "--focal", *options]):
        out = arguments.work / command[0]
        if not (arguments.keep and out.is_dir()):
            subprocess.run([sys.executable, "-m", "runtime.cli", *command, "--out", str(out)], check=True)
    content = arguments.work / "content"
    if not (arguments.keep and content.is_dir()):
        subprocess.run(
            [sys.executable, str(DOCS.parent / "examples" / "content.py"), "--out", str(content)], check=True
        )
    kinds(content).save(arguments.work / "kinds.png")
    boards().save(arguments.work / "boards.png")
    look_into(arguments.work / "look")
    files = {name: smaller(arguments.work / source, name) for name, source in PICTURES.items()}
    files |= {name: (arguments.work / "look" / name).read_bytes() for name in ("looked-into.webp", "viewer.html")}
    text = page(json.loads((arguments.work / "report" / "report.json").read_text(encoding="utf-8")))
    for name, data in files.items():
        (IMAGES / name).write_bytes(data)
    (DOCS / "performance.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
