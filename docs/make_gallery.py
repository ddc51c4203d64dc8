"""Write docs/performance.md and the documentation's pictures, based on a demo and a report.

Run `make gallery`, which takes several minutes, or

    python -m docs.make_gallery [--work FOLDER] [--keep] [REPORT OPTION ...]

`--keep` reuses the work folder of an earlier run. Other options, such as `--quick`, are passed to the report.
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import phasestack
from calib.board import boards as boards_of
from runtime.config import StackGeometry, changed
from runtime.content import shapes
from runtime.content.scenes import Scene, Thing
from runtime.daemon.build import scaled_stack
from runtime.evaluation.motion_recording import write_motion
from runtime.evaluation.refresh_quality import Pictures, view_error_mm
from runtime.optics.carried import intensities
from runtime.optics.pupil import PUPIL_MM
from runtime.optics.retina import as_codes, average, pupil_points, seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import stack_from_eye
from runtime.records import F64, U8
from runtime.report import focal
from runtime.report.moving import (
    FULL,
    NOISE_MM,
    SECONDS,
    SEED,
    Moving,
    settings_for,
    simulated_run,
)
from runtime.report.pairs import PairPainter, eyes_at
from runtime.report.sections import most_used
from tests.calib.simulator import Camera, camera_from_stack, ideal_panel, photograph

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images"
WIDTH_PX, LIMIT_BYTES = 1200, 200_000
WRAPPED = 120  # characters per line of text
FILM_BYTES, FILM_PX, FILM_EVERY = 1_500_000, (400, 225), 4  # size limit, picture size, refreshes per film frame
PULLED, PULL_MS = 13, 250  # planes in the film of an eye that focuses, and the time for each
FILM_S = 2.0, 8.0  # the film's start and end within the run
PEOPLE_PX = 320, 180  # size of each eye's picture in the film of two people
PICTURES = {  # name in docs/images: path in the work folder
    "boards.jpg": "boards.png",
    "contact-sheet.jpg": "demo/contact-sheet.png",
    "frontier.png": "report/frontier-scenes.png",
    "moving-viewer.png": "report/moving-viewer.png",
}
MOVING = f"""\
The daemon's own loop ran for {SECONDS:g} s on the simulated clock, with 960x540 panels, {NOISE_MM} mm of sensor
noise and the costs of a slow processor (in ms on the full raster: render 44, prepare 40, inference
31, finish 38, each step 85). In the row *film*, the content moves while the head rests.

An [effort](mathematics.md#effort) combines a raster with a number of steps: `1/2+0` means half the
raster and no steps. *Full* runs the whole model for every solution; *auto*, the default, chooses an
effort for each. The table gives [live quality](contracts.md#error), the view error (median and 95th
percentile) and each effort's share of the time.
"""
SMALL = """\
On much smaller panels (`report --quick`: 288x162 pixels), a walking viewer gets 1.0 to 1.9 dB less
than with 1/2+0.
"""
HEAD = """\
<!-- Written by `make gallery`: change docs/make_gallery.py, not this page. -->

# Performance: light against run time

    phasestack report --out report            # the first version of the page appears within a minute
    phasestack report --pairs DIR --focal     # adds your own case files and focal parallax
    phasestack bench --out new.json           # figures for regression tests
    phasestack bench compare old.json new.json

**Quote [light](contracts.md#error) at a tracking error of 1 mm** (`light_db`, `"1"`), and times as
ratios. *One ray* is `psnr_db`. The solution time runs from two decoded pictures to 8-bit layers.
Memory is the method's peak. Your own pairs are [case files](contracts.md#cases-pairs-calibration).

![result of the demo: layers, and for each eye the target, the view and their difference](images/contact-sheet.jpg)

"""


SHARPEST = ["card, mm", "through the layers", "without the display"]
HEADINGS = ["method", "time, × fastest", "ms", "memory, MiB", "light 0 mm, dB", "**1 mm**", "2 mm", "one ray, dB"]


def page(report: dict[str, Any]) -> str:
    """Format the text for docs/performance.md, based on the contents of report.json."""
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
    without, focus = report["focal"]["cards"], report["focal"]["focus"]["cards"]
    cards = [
        [f"{1000 * m:.0f}" for m in (*plain.values(), own["sharpest_shown_m"])]
        for plain, own in zip(without, focus, strict=True)
    ]
    return "\n".join(
        [
            HEAD,
            "## Error against run time\n",
            fill(
                f"These figures for built-in scenes with {size} panels come from `{report['command']}` ({facts}). "
                "SART-n is `sart` after n iterations.",
                width=WRAPPED,
                break_on_hyphens=False,
            )
            + "\n",
            _table(HEADINGS, rows),
            "![light against run time](images/frontier.png)\n",
            "## What a moving viewer sees\n",
            moving_text([Moving(**one) for one in report["moving"]]),
            "![live quality and view error by effort](images/moving-viewer.png)\n",
            '![a leaning head with `model.effort = "full"`, with `"auto"`, and the true view](images/leaning.webp)\n',
            "## Focal parallax\n",
            "Distances of sharpest focus of three cards, seen through a 4 mm pupil.\n",
            _table([*SHARPEST, "layers [with focus](content.md#focus)"], cards),
            "![an eye that focuses from the rear to the front, without and with focus, and of the scene itself]"
            "(images/focus-pull.webp)",
            "",
        ]
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.1f}"


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def boards() -> Image.Image:
    """Simulate a photograph of the calibration boards on three panels, taken from the left with a phone."""
    stack = StackGeometry().stack()
    panels = [ideal_panel(stack, index) for index in range(stack.count)]
    pose = camera_from_stack(np.array([0.44, -0.26, 0.07]), towards_m=np.array([0.0, -0.06, 0.0]))
    camera = Camera(800, 600, 610.0)
    return Image.fromarray(photograph(boards_of(stack), panels, stack, camera, pose, np.random.default_rng(0)))


def moving_text(found: Sequence[Moving]) -> str:
    """Format the table of motions, and name any for which `auto` is not the best effort."""
    rows, worse = [], []
    for motion in dict.fromkeys(one.motion for one in found):
        own = {one.effort: one for one in found if one.motion == motion}
        before, now = own[FULL.name], own.pop("auto")
        best = max(own.values(), key=lambda one: one.live_db)
        rows.append([motion, *_live(before), f"{best.live_db:.1f} ({best.effort})", *_live(now), most_used(now)])
        if now.live_db < best.live_db - 0.5:
            worse.append(f"{motion} ({best.live_db - now.live_db:.1f} dB below {best.effort})")
    view = "view error, mm", "95%"
    headings = ["motion", "full, dB", *view, "best fixed effort, dB", "auto, dB", *view, "efforts of auto"]
    verdict = "never more than 0.5 dB below the best fixed effort"
    if worse:
        verdict = f"more than 0.5 dB below the best fixed effort for {', '.join(worse)}"
    return f"{MOVING}\n{_table(headings, rows)}\n*Auto* is {verdict}.\n{SMALL}"


def _live(one: Moving) -> list[str]:
    return [f"{value:.1f}" for value in (one.live_db, *one.view_error_mm)]


def look_into(folder: Path) -> None:
    """Write a solution's files. Its `viewer.html` is shown in the documentation."""
    stack = replace(StackGeometry().stack(), width_px=640, height_px=360)
    eyes = eyes_at(distance_m=0.65, angle_deg=4, height_m=0.08)
    with PairPainter("room", stack) as painter:
        pair = painter.pair("room", eyes, off_mm=())
    phasestack.solve(*pair.images, eyes_m=eyes, stack=stack).save(folder)


class KeptInMemory:
    """Output for a run that keeps its lines, layers and true pictures in memory."""

    def __init__(self) -> None:
        self.lines: list[Mapping[str, Any]] = []  # lines of frames.jsonl
        self.layers: dict[int, U8] = {}  # layers, keyed by refresh number
        self.true: dict[int, tuple[Mapping[str, Any], Pictures]] = {}  # light.json entry and pictures, keyed by refresh

    def refresh(self, line: Mapping[str, Any]) -> None:
        self.lines.append(line)

    def light(self, frame: int, *, layers: U8) -> None:
        self.layers[frame] = layers

    def light_targets(self, frame: int, *, info: Mapping[str, Any], drawn: Any, true: Pictures | None) -> None:
        if true is not None:
            self.true[frame] = info, true


def leaning(folder: Path) -> None:
    """Write the film `leaning.webp`, which shows what a leaning head's left eye sees.

    Each frame shows the full model, the `auto` effort and the true view.
    """
    recording = folder / "lean.mcap"
    write_motion(recording, "lean", seconds=FILM_S[1], seed=SEED, noise_mm=NOISE_MM)
    runs: list[KeptInMemory] = []
    for effort in ("full", "auto"):
        settings = settings_for(recording, scene="room", effort=effort)
        settings = changed(settings, "content", {"fov_deg": 46.0}, source="gallery")
        runs.append(KeptInMemory())
        simulated_run(settings, scale=0.5, keep_light=FILM_EVERY, output=runs[-1])
    stack, frames, (width, height) = scaled_stack(settings, 0.5), [], FILM_PX
    for frame, (info, true) in runs[0].true.items():
        if frame < FILM_S[0] * settings.loop.rate_hz:
            continue
        sheet = Image.new("RGB", (3 * width, height))
        eye_m, fov_deg = info["true_eyes_m"][0], info["fov"]
        pictures = [light_of(eye_m, run.layers[frame], stack, fov_deg=fov_deg) for run in runs]
        away_mm = [view_error_mm(info["true_eyes_m"], run.true[frame][0]["solved_for_m"]) for run in runs]
        texts = [
            f"before: drawn for eyes {away_mm[0]:.0f} mm away",
            f"now: {away_mm[1]:.0f} mm away",
            "as it should be",
        ]
        for column, (picture, text) in enumerate(zip([*pictures, true[0]], texts, strict=True)):
            small = Image.fromarray(picture).resize(FILM_PX, Image.Resampling.BOX)
            sheet.paste(small, (column * width, 0))
            _label(sheet, (column * width + 8, 6), text)
        frames.append(sheet)
    save_film(frames, folder / "leaning.webp", period_ms=1000 * FILM_EVERY / settings.loop.rate_hz)


def two_people(folder: Path) -> None:
    """Write the film `two-people.webp`: what four eyes see of four panels while one person sits and one leans."""
    recording = folder / "two.mcap"
    write_motion(recording, "two-one-leans", seconds=FILM_S[1], seed=SEED, noise_mm=NOISE_MM)
    settings = settings_for(recording, scene="room", effort="auto")
    settings = changed(settings, "stack", {"x_m": (-0.09, -0.03, 0.03, 0.09)}, source="gallery")
    run, scale = KeptInMemory(), 0.25
    simulated_run(settings, scale=scale, keep_light=FILM_EVERY, output=run)
    stack, frames, (width, height) = scaled_stack(settings, scale), [], PEOPLE_PX
    for frame, (info, _) in run.true.items():
        eyes = [(person, eye_m) for person in info["people"] for eye_m in person["true_eyes_m"]]
        if frame < FILM_S[0] * settings.loop.rate_hz or len(eyes) < 4:
            continue
        sheet = Image.new("RGB", (2 * width, 2 * height))
        for n, (person, eye_m) in enumerate(eyes):
            seen = light_of(eye_m, run.layers[frame], stack, fov_deg=info["fov"])
            place = n % 2 * width, n // 2 * height
            sheet.paste(Image.fromarray(seen).resize(PEOPLE_PX, Image.Resampling.BOX), place)
            text = f"person {person['number']}, {('left', 'right')[n % 2]} eye"
            _label(sheet, (place[0] + 8, place[1] + 6), text)
        frames.append(sheet)
    save_film(frames, folder / "two-people.webp", period_ms=1000 * FILM_EVERY / settings.loop.rate_hz)


def focus_pull(folder: Path) -> None:
    """Write the film `focus-pull.webp`: what the right eye sees as it focuses from the rear to the front and back.

    Each frame shows the view through layers solved without and with focus, and of the scene itself.
    """
    globe, box, card = shapes.sphere(0.017), shapes.box((0.024,) * 3), shapes.card(0.034, 0.036)
    turned = shapes.rotation_about(2, np.radians(30))
    things = (
        Thing(globe, "globe", (-0.045, -0.043, 0.0)),
        Thing(box, "crate", (0.0, 0.0, 0.0), rotation=turned),
        Thing(card, "mosaic", (0.045, 0.040, 0.0), lit=False),
    )
    stack, eyes = StackGeometry().stack(), eyes_at(distance_m=focal.DISTANCE_M)
    pixels, eye, frames = focal.seen_pixels(stack), eyes[1], []
    size = {"width_px": pixels.raster.width_px, "height_px": pixels.raster.height_px}
    with PairPainter(Scene("focus", things), stack) as painter:
        both = [focal.cards_layers(painter, stack, eyes, model="best", focus=focus) for focus in (False, True)]
        for plane_m in np.linspace(-0.06, 0.06, PULLED):
            pictures = [pixels.seen(layers, stack, eye, plane_m=plane_m).image for layers in both]
            pictures.append(pixels.true(lambda at, to: intensities(painter.draw(at, to, **size)), eye, plane_m=plane_m))
            sheet = Image.fromarray(np.vstack([as_codes(picture) for picture in pictures]))
            texts = (f"without focus, at {1000 * plane_m:+.0f} mm", "with focus", "the scene itself")
            for row, text in enumerate(texts):
                _label(sheet, (8, row * size["height_px"] + 6), text)
            frames.append(sheet)
    save_film([*frames, *frames[-2:0:-1]], folder / "focus-pull.webp", period_ms=PULL_MS)


def light_of(eye_m: F64, layers: U8, stack: PanelStack, *, fov_deg: float) -> U8:
    """Compute the picture (h, w, 3) of the layers as seen by an eye, averaged over the pupil.

    Rays that miss a panel are black. `eye_m` is the eye's position (3,) in the `stack` frame.
    """
    points = pupil_points(PUPIL_MM / 1000) @ stack_from_eye(eye_m)[:3, :2].T
    seen = average(
        [
            np.where(retina.mask[..., None], retina.image, 0)
            for retina in (seen_by(eye_m + point, layers, stack, fov_deg=fov_deg) for point in points)
        ]
    )
    return as_codes(seen)


def save_film(frames: Sequence[Image.Image], path: Path, *, period_ms: float) -> None:
    """Write an animated WebP at the best quality that the size limit permits.

    Raises SystemExit if the file is too large even at the lowest quality.
    """
    options: dict[str, Any] = {"duration": round(period_ms), "loop": 0, "method": 6}
    for quality in range(70, 10, -10):
        frames[0].save(path, save_all=True, append_images=frames[1:], quality=quality, **options)
        if path.stat().st_size <= FILM_BYTES:
            return
    raise SystemExit(f"{path.name}: more than {FILM_BYTES} bytes")


def _label(sheet: Image.Image, place: tuple[int, int], text: str) -> None:
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    draw.text(place, text, fill="white", font=font, stroke_width=3, stroke_fill="black")


def smaller(source: Path, name: str) -> bytes:
    """Reduce a picture to the pages' width, and return it as a JPEG or PNG file, depending on the name.

    Raises SystemExit if the file is too large even at the lowest quality.
    """
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
    """Run all commands, and then write the page and the pictures. A failed command leaves them unchanged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=DOCS.parent / "out" / "gallery")
    parser.add_argument("--keep", action="store_true")
    arguments, options = parser.parse_known_args()
    for command in (["demo"], ["report", "--focal", *options]):
        out = arguments.work / command[0]
        if not (arguments.keep and out.is_dir()):
            subprocess.run([sys.executable, "-m", "runtime.cli", *command, "--out", str(out)], check=True)
    boards().save(arguments.work / "boards.png")
    look_into(arguments.work / "look")
    leaning(arguments.work / "look")
    two_people(arguments.work / "look")
    focus_pull(arguments.work / "look")
    files = {name: smaller(arguments.work / source, name) for name, source in PICTURES.items()}
    files |= {
        name: (arguments.work / "look" / name).read_bytes()
        for name in ("leaning.webp", "two-people.webp", "focus-pull.webp", "viewer.html")
    }
    text = page(json.loads((arguments.work / "report" / "report.json").read_text(encoding="utf-8")))
    for name, data in files.items():
        (IMAGES / name).write_bytes(data)
    (DOCS / "performance.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
