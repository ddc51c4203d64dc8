"""`calibrate grey`: a panel's grey chart photographed, or a photometer's series, to its LUT."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from calib.grey import CHANNELS, Series, fit_series, lut_text
from calib.grey_chart import Unusable, histograms, measure
from runtime.errors import InputError
from runtime.optics.stack import PanelStack
from runtime.records import U8
from runtime.support.artifacts import write_text


def fit_lut(out: Path, series: Series, *, source: str) -> tuple[dict[str, Any], str]:
    """Write a panel's LUT; returns the summary and its text. Raises InputError."""
    curves = fit_series(series, source)
    write_text(out, lut_text(curves))
    channels = dict(zip(CHANNELS, curves, strict=True))
    summary = {
        "file": str(out),
        "channels": {name: asdict(curve) for name, curve in channels.items()},
        "residual": max(curve.residual for curve in curves),
    }
    lines = [
        f"{name}: smooth in {'intensity' if curve.of_intensity else 'phase'}, gamma {curve.gamma:.3f}, contrast "
        f"{1 + curve.span / max(curve.dark, 1e-9 * curve.span):.4g}, residual {100 * curve.residual:.2f}% of the range"
        for name, curve in channels.items()
    ]
    return summary, "\n".join([*lines, f"{out}"])


def photographed_series(pictures: Iterable[tuple[str, U8]], stack: PanelStack, *, panel: int, source: str) -> Series:
    """Relative luminances from named photographs (h, w) of a panel's grey chart. Raises InputError, naming them."""
    found = []
    for name, picture in pictures:
        try:
            found.append(histograms(picture, stack, panel))
        except Unusable as problem:
            raise InputError(f"{source}, {name}", "", str(problem)) from None
    try:
        return measure(found, stack, panel)
    except Unusable as problem:
        raise InputError(source, "greys", str(problem)) from None
