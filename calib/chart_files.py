"""Charts into files, and on to the panels."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import typer

from calib.charts import Kind, alone, chart_fov_deg, eye_chart, line_picture
from calib.keys import Key, TerminalKeys, WindowKeys, first_of
from calib.viewpoints import Viewpoint
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import ModelSettings, Settings
from runtime.model.predictor import load_predictor
from runtime.model.still import solve_still
from runtime.model.visible import visible_boxes
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.optics.views import relative_scale_shift
from runtime.panels.registry import open_panels
from runtime.records import F64, U8, PanelFrame
from runtime.report.progress import tracked
from runtime.support.artifacts import OutputFolder, write_json, write_png
from runtime.support.gl import offscreen_context

if TYPE_CHECKING:
    from runtime.model.predictor import Predictor

CAPTION_SHARE = 0.07  # of the height, for words
CAPTION_ROOM_M = 0.015  # by which all panels are clear beyond the words: who reads is not there yet
UNFUSED_M = 0.03
EYE_NAMES = ("left", "right")
THUMBNAIL_PX = 320
SHOW_AGAIN_NS = 100 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Chart:
    """What all panels show together at one step."""

    viewpoint: Viewpoint
    label: str  # which eye and panel, for the EyeReal supplement's kind; else empty
    layers: U8  # (N, H, W, 4) rear to front


class Drawer:
    """Draws the charts of one kind for one stack; a model is loaded when the first chart needs it."""

    def __init__(self, stack: PanelStack, *, kind: Kind, ipd_m: float, model: str, settings: ModelSettings) -> None:
        self.stack, self.kind, self.ipd_m, self.model = stack, kind, ipd_m, model
        self._settings = settings
        self._predictor: Predictor | None = None

    def charts(self, viewpoint: Viewpoint) -> Iterator[Chart]:
        """One chart of the solved kind, one for each panel and eye of the EyeReal's. Raises InputError, MissingPart."""
        if self.kind == "seed":
            for index in range(self.stack.count):
                for side, eye in enumerate(EYE_NAMES):
                    picture = eye_chart(viewpoint, self.stack, side=side, index=index, ipd_m=self.ipd_m)
                    yield Chart(viewpoint, f"layer-{index}-{eye}", alone(picture, self.stack, index=index))
            return
        yield Chart(viewpoint, "", self._solved(viewpoint))

    def _solved(self, viewpoint: Viewpoint) -> U8:
        """(N, H, W, 4) layers through which both eyes see the line picture at the viewpoint."""
        if self._predictor is None:
            self._predictor = load_predictor(self.model, self.stack, self._settings)
        picture = line_picture(width_px=self.stack.width_px, height_px=self.stack.height_px)
        eyes_m = viewpoint.eyes_m(self.ipd_m)
        fov_deg = chart_fov_deg(viewpoint, self.stack)
        prediction = solve_still(picture, picture, eyes_m=eyes_m, fov_deg=fov_deg, predictor=self._predictor)
        return np.array(prediction.layers)  # a copy: the predictor uses its own again

    def close(self) -> None:
        """Release the model. May be called twice."""
        if self._predictor is not None:
            self._predictor.close()
            self._predictor = None


def fused_psnr_db(layers: U8, viewpoint: Viewpoint, *, stack: PanelStack, ipd_m: float) -> float:
    """How well both eyes see the line picture from the viewpoint (docs/contracts.md)."""
    wanted = line_picture(width_px=stack.width_px, height_px=stack.height_px).astype(np.float32) / np.float32(255)
    seen = [seen_by(eye, layers, stack, fov_deg=chart_fov_deg(viewpoint, stack)) for eye in viewpoint.eyes_m(ipd_m)]
    return quality([r.image for r in seen], [wanted, wanted], [r.mask for r in seen]).psnr_db


def captioned(layers: U8, text: str, *, stack: PanelStack, eyes_m: F64) -> U8:
    """(N, H, W, 4) layers with a line of words that eyes (2, 3) about there read: on the middle panel, low down.

    All panels are clear where these eyes look through them at it, and `CAPTION_ROOM_M` around.
    """
    shown, middle = layers.copy(), stack.count // 2
    box, pitch_m = visible_boxes(eyes_m, stack)[middle], stack.height_m / stack.height_px
    tall_px = round(CAPTION_SHARE * stack.height_px)
    bottom = box.v1 - round(CAPTION_ROOM_M / 2 / pitch_m)
    top = max(bottom - tall_px, 0)
    edges_m = stack.height_m / 2 - np.array([top, bottom]) * pitch_m
    for index, x_m in enumerate(stack.x_m):
        seen_m = []
        for eye_m in eyes_m:
            scale, shift_m = relative_scale_shift(eye_m, from_x_m=stack.x_m[middle], to_x_m=x_m)
            seen_m.append(edges_m * scale + shift_m[1])
        rows = (
            stack.height_m / 2 - np.array([np.max(seen_m) + CAPTION_ROOM_M, np.min(seen_m) - CAPTION_ROOM_M])
        ) / pitch_m
        first, last = np.clip(np.rint(rows), 0, stack.height_px).astype(int)
        shown[index, first:last, :, :3] = 0
    (long, tall), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 1.0, 2)
    scale = min(0.6 * tall_px / tall, 0.8 * box.width_px / max(long, 1))
    page = np.zeros((stack.height_px, stack.width_px), np.uint8)
    place = (
        round((box.u0 + box.u1 - scale * long) / 2),
        round((top + bottom + scale * (tall - below)) / 2),
    )
    cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, 255, max(1, round(2 * scale)), cv2.LINE_AA)
    shown[middle, top:bottom, :, :3] = page[top:bottom, :, None]
    return shown


def reference_pictures(layers: U8, viewpoint: Viewpoint, *, stack: PanelStack, ipd_m: float) -> dict[str, U8]:
    """What the right eye sees of a solved chart at its viewpoint (fused), and 3 cm beside it (not)."""
    eye_m, fov_deg = viewpoint.eyes_m(ipd_m)[1], chart_fov_deg(viewpoint, stack)
    found = {}
    for name, aside_m in (("fused", 0.0), ("unfused", UNFUSED_M)):
        seen = seen_by(eye_m + np.array([0.0, aside_m, 0.0]), layers, stack, fov_deg=fov_deg).image
        found[f"reference-{name}.png"] = np.rint(255 * np.clip(seen, 0, 1)).astype(np.uint8)
    return found


def make_charts(out: Path, viewpoints: Sequence[Viewpoint], drawer: Drawer, *, check: bool) -> dict[str, Any]:
    """Write PNGs, `charts.json` and a contact sheet. Raises InputError, MissingPart.

    check: also measure how well both eyes see the lines through each solved chart.
    """
    stack, ipd_m = drawer.stack, drawer.ipd_m

    entries: list[dict[str, Any]] = []
    sheet: list[U8] = []
    references: dict[str, U8] = {}
    with OutputFolder(out) as folder:
        for viewpoint in tracked("charts", viewpoints):
            files = []
            entry: dict[str, Any] = {
                "viewpoint": viewpoint.name,
                "midpoint_m": viewpoint.midpoint_m,
                "eyes_m": viewpoint.eyes_m(ipd_m),
                "fov_deg": chart_fov_deg(viewpoint, stack),
            }
            for chart in drawer.charts(viewpoint):
                for name, picture in _pictures(chart):
                    write_png(folder.staging / name, picture)
                    files.append(name)
                if not chart.label and not references:
                    references = reference_pictures(chart.layers, viewpoint, stack=stack, ipd_m=ipd_m)
                if check and not chart.label:
                    entry["psnr_db"] = fused_psnr_db(chart.layers, viewpoint, stack=stack, ipd_m=ipd_m)
                if chart.label in ("", f"layer-{stack.count - 1}-right"):
                    sheet.append(_thumbnail(chart.layers[-1], viewpoint.name))
            entries.append(entry | {"files": files})
        write_png(folder.staging / "contact-sheet.png", _tiled(sheet))
        for name, picture in references.items():
            write_png(folder.staging / name, picture)
        write_json(
            folder.staging / "charts.json",
            {"kind": drawer.kind, "ipd_m": ipd_m, "model": drawer.model, "charts": entries},
        )
    return {
        "out": str(out),
        "kind": drawer.kind,
        "viewpoints": [viewpoint.name for viewpoint in viewpoints],
        "files": sum(len(entry["files"]) for entry in entries),
        "psnr_db": [entry["psnr_db"] for entry in entries if "psnr_db" in entry],
    }


def _pictures(chart: Chart) -> Iterator[tuple[str, U8]]:
    stem = f"chart-{chart.viewpoint.name}"
    if chart.label:  # the other panels of the EyeReal supplement's charts show nothing
        index = int(chart.label.split("-")[1])
        yield f"{stem}-{chart.label}.png", np.ascontiguousarray(chart.layers[index, ..., 0])
        return
    for index, layer in enumerate(chart.layers):
        yield f"{stem}-layer-{index}.png", layer


def _thumbnail(layer: U8, title: str) -> U8:
    height, width = layer.shape[:2]
    size = (THUMBNAIL_PX, round(THUMBNAIL_PX * height / width))
    small = cv2.resize(np.ascontiguousarray(layer[..., :3]), size, interpolation=cv2.INTER_AREA)
    framed = cv2.copyMakeBorder(small, 24, 4, 4, 4, cv2.BORDER_CONSTANT, value=(90, 90, 90))
    return np.asarray(
        cv2.putText(framed, title, (8, 17), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    )


def _tiled(pictures: Sequence[U8], columns: int = 3) -> U8:
    blank = np.full_like(pictures[0], 90)
    padded = [*pictures, *[blank] * (-len(pictures) % columns)]
    return np.vstack([np.hstack(padded[row : row + columns]) for row in range(0, len(padded), columns)])


class ChartDisplay:
    """The panels, showing one viewpoint's chart at a time."""

    def __init__(self, settings: Settings, drawer: Drawer) -> None:
        """Opens the panels. Raises InputError, MissingPart, PanelLost."""
        self._drawer = drawer
        self._sink = open_panels(settings.output, drawer.stack, MonotonicClock(), offscreen_context())
        self._number = 0
        self._shown: Chart | None = None
        self._caption = ""
        self.keys = WindowKeys(self._sink)
        self._kept = lru_cache(maxsize=2)(lambda viewpoint: list(drawer.charts(viewpoint)))

    def charts(self, viewpoint: Viewpoint) -> list[Chart]:
        """The charts of a viewpoint; the last two viewpoints' are kept."""
        return self._kept(viewpoint)

    def show(self, viewpoint: Viewpoint) -> None:
        """The viewpoint's (first) chart on all panels."""
        self.present(self.charts(viewpoint)[0])

    def present(self, chart: Chart) -> None:
        """A chart on all panels. Raises PanelLost."""
        self._number += 1
        self._shown = chart
        layers = chart.layers
        if self._caption:
            eyes_m = chart.viewpoint.eyes_m(self._drawer.ipd_m)
            layers = captioned(layers, self._caption, stack=self._drawer.stack, eyes_m=eyes_m)
        self._sink.present(PanelFrame(self._number, layers, self._number))

    def caption(self, text: str) -> None:
        """A line of words below the chart; empty: none. Raises PanelLost."""
        self._caption = text
        self.again()

    def again(self) -> None:
        """The same chart once more: it takes in the windows' events and keeps them alive. Raises PanelLost."""
        if self._shown is not None:
            self.present(self._shown)

    def close(self) -> None:
        """Close the panels and the model. May be called twice."""
        self._sink.close()
        self._drawer.close()


def show_charts(settings: Settings, viewpoints: Sequence[Viewpoint], drawer: Drawer) -> None:
    """Show the charts one after the other until the last one is accepted, or q. Raises as `ChartDisplay`."""
    keys = TerminalKeys()
    if settings.output.kind == "offscreen":
        typer.echo("warning: output.kind is offscreen: nobody sees these charts", err=True)
    clock = MonotonicClock()
    try:
        display = ChartDisplay(settings, drawer)
        try:
            walk = steps(
                display,
                viewpoints,
                first_of(keys.poll, display.keys.poll),
                wait=lambda: clock.sleep_until_ns(clock.now_ns() + SHOW_AGAIN_NS),
            )
            for chart in walk:
                name = f"{chart.viewpoint.name} {chart.label}".rstrip()
                typer.echo(f"{name}  (Enter, n: next, p: previous, q: stop)", err=True)
        finally:
            display.close()
    finally:
        keys.close()


def steps(
    display: ChartDisplay, viewpoints: Sequence[Viewpoint], poll: Callable[[], Key | None], *, wait: Callable[[], None]
) -> Iterator[Chart]:
    """Present charts as keys say, yielding each one that comes up; ends with q or after the last."""
    index, step = 0, 0
    while index < len(viewpoints):
        charts = display.charts(viewpoints[index])
        step = len(charts) - 1 if step < 0 else step
        chart = charts[step]
        display.present(chart)
        yield chart
        key = poll()
        while key is None:
            wait()
            display.present(chart)  # keeps the windows alive
            key = poll()
        if key is Key.QUIT:
            return
        if key in (Key.ACCEPT, Key.NEXT, Key.RIGHT):
            step += 1
            if step == len(charts):
                index, step = index + 1, 0
        elif key in (Key.PREVIOUS, Key.LEFT) and (index, step) != (0, 0):
            step -= 1
            index -= step < 0
