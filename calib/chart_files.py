"""Charts into files, and on to the panels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.charts import FOV_DEG, Kind, alone, eye_chart, line_picture
from calib.keys import Key, TerminalKeys
from calib.viewpoints import Viewpoint
from runtime.artifacts import OutputFolder, write_json, write_png
from runtime.clock import NS_PER_MS, MonotonicClock
from runtime.config import Settings
from runtime.optics.quality import quality
from runtime.optics.retina import seen_by
from runtime.optics.stack import PanelStack
from runtime.records import U8, LayerFrame

EYE_NAMES = ("left", "right")
THUMBNAIL_PX = 320
SHOW_AGAIN_NS = 100 * NS_PER_MS


@dataclass(frozen=True, slots=True)
class Chart:
    """What all panels show together at one step."""

    viewpoint: Viewpoint
    label: str  # which eye and panel, for the seed's kind; else empty
    layers: U8  # (N, H, W, 4) rear to front


def charts_of(viewpoint: Viewpoint, *, stack: PanelStack, kind: Kind, ipd_m: float, model: str) -> Iterator[Chart]:
    """One chart of the solved kind, or one for each eye and panel of the seed's. Raises InputError, MissingPart."""
    if kind == "seed":
        for index in range(stack.count):
            for side, eye in enumerate(EYE_NAMES):
                picture = eye_chart(viewpoint, stack, side=side, index=index, ipd_m=ipd_m)
                yield Chart(viewpoint, f"layer-{index}-{eye}", alone(picture, stack, index=index))
        return
    yield Chart(viewpoint, "", solved_layers(viewpoint, stack=stack, ipd_m=ipd_m, model=model))


def solved_layers(viewpoint: Viewpoint, *, stack: PanelStack, ipd_m: float, model: str) -> U8:
    """(N, H, W, 4) layers through which both eyes see the line picture at the viewpoint."""
    from runtime.model.still import solve_still

    picture = line_picture(width_px=stack.width_px, height_px=stack.height_px)
    return solve_still(picture, picture, eyes_m=viewpoint.eyes_m(ipd_m), stack=stack, fov_deg=FOV_DEG, model=model)


def fused_psnr_db(layers: U8, viewpoint: Viewpoint, *, stack: PanelStack, ipd_m: float) -> float:
    """How well both eyes see the line picture from the viewpoint (design 5.5)."""
    wanted = line_picture(width_px=stack.width_px, height_px=stack.height_px).astype(np.float32) / 255
    seen = [seen_by(eye, layers, stack, fov_deg=FOV_DEG) for eye in viewpoint.eyes_m(ipd_m)]
    return quality([r.image for r in seen], [wanted, wanted], [r.mask for r in seen]).psnr_db


def make_charts(
    out: Path, viewpoints: Sequence[Viewpoint], *, stack: PanelStack, kind: Kind, ipd_m: float, model: str
) -> dict[str, Any]:
    """Write PNGs, `charts.json` and a contact sheet. Raises InputError, MissingPart."""
    from rich.console import Console
    from rich.progress import track

    entries: list[dict[str, Any]] = []
    sheet: list[U8] = []
    with OutputFolder(out) as folder:
        for viewpoint in track(viewpoints, "charts", console=Console(stderr=True), transient=True):
            files = []
            entry: dict[str, Any] = {
                "viewpoint": viewpoint.name,
                "midpoint_m": viewpoint.midpoint_m,
                "eyes_m": viewpoint.eyes_m(ipd_m),
            }
            for chart in charts_of(viewpoint, stack=stack, kind=kind, ipd_m=ipd_m, model=model):
                for name, picture in _pictures(chart):
                    write_png(folder.staging / name, picture)
                    files.append(name)
                if not chart.label:
                    entry["psnr_db"] = fused_psnr_db(chart.layers, viewpoint, stack=stack, ipd_m=ipd_m)
                if chart.label in ("", f"layer-{stack.count - 1}-right"):
                    sheet.append(_thumbnail(chart.layers[-1], viewpoint.name))
            entries.append(entry | {"files": files})
        write_png(folder.staging / "contact-sheet.png", _tiled(sheet))
        write_json(
            folder.staging / "charts.json",
            {"kind": kind, "ipd_m": ipd_m, "fov_deg": FOV_DEG, "model": model, "charts": entries},
        )
    return {
        "out": str(out),
        "kind": kind,
        "viewpoints": [viewpoint.name for viewpoint in viewpoints],
        "files": sum(len(entry["files"]) for entry in entries),
        "psnr_db": [entry["psnr_db"] for entry in entries if "psnr_db" in entry],
    }


def _pictures(chart: Chart) -> Iterator[tuple[str, U8]]:
    stem = f"chart-{chart.viewpoint.name}"
    if chart.label:  # the other panels of the seed's charts show nothing
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

    def __init__(self, settings: Settings, stack: PanelStack, *, kind: Kind, ipd_m: float, model: str) -> None:
        """Opens the panels. Raises InputError, MissingPart, PanelLost."""
        from runtime.gl import offscreen_context
        from runtime.panels.registry import open_panels

        self._request: dict[str, Any] = {"stack": stack, "kind": kind, "ipd_m": ipd_m, "model": model}
        self._context = offscreen_context()
        self._sink = open_panels(settings.output, stack, MonotonicClock(), self._context)
        self._number = 0
        self._charts = lru_cache(maxsize=2)(self._solve)

    def _solve(self, viewpoint: Viewpoint) -> list[Chart]:
        return list(charts_of(viewpoint, **self._request))

    def charts(self, viewpoint: Viewpoint) -> list[Chart]:
        """The charts of a viewpoint; the last two viewpoints' are kept."""
        return self._charts(viewpoint)

    def show(self, viewpoint: Viewpoint) -> None:
        """The viewpoint's (first) chart on all panels."""
        self.present(self.charts(viewpoint)[0])

    def present(self, chart: Chart) -> None:
        """A chart on all panels. Raises PanelLost."""
        self._number += 1
        self._sink.present(LayerFrame(self._number, chart.layers))

    def close(self) -> None:
        """Close the panels. May be called twice."""
        self._sink.close()


def show_charts(
    settings: Settings, viewpoints: Sequence[Viewpoint], *, stack: PanelStack, kind: Kind, ipd_m: float, model: str
) -> None:
    """Show the charts one after the other until the last one is accepted, or q. Raises as `ChartDisplay`."""
    import typer

    keys = TerminalKeys()
    display = ChartDisplay(settings, stack, kind=kind, ipd_m=ipd_m, model=model)
    if settings.output.kind == "offscreen":
        typer.echo("warning: output.kind is offscreen: nobody sees these charts", err=True)
    try:
        clock = MonotonicClock()
        for chart in steps(display, viewpoints, keys.poll, wait=lambda: clock.sleep_until_ns(
            clock.now_ns() + SHOW_AGAIN_NS
        )):  # fmt: skip
            typer.echo(f"{chart.viewpoint.name} {chart.label}  (Enter, n: next, p: previous, q: stop)", err=True)
    finally:
        keys.close()
        display.close()


def steps(display: Any, viewpoints: Sequence[Viewpoint], poll: Any, *, wait: Any) -> Iterator[Chart]:
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
