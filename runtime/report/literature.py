"""Published figures beside ours by their measure: 640x360, one ray a pixel, 8-bit layers."""

from __future__ import annotations

from collections.abc import Sequence

from runtime.report.frontier import MethodResult
from runtime.report.page import Section, Table

SIZE_PX = (640, 360)
REPORTED = (  # by others, for ten views of the Lego scene that no network was trained on; milliseconds on their GPU
    ("EyeReal's network (Nature 2025, doi:10.1038/s41586-025-09752-y)", 27.46, "20 (1080p)"),
    ("a Bayesian flow network", 31.40, "35"),
    ("conjugate gradients", 34.31, "691"),
)
TEXT = (
    "The rows marked as reported are others', for ten unseen views of the Lego scene; they came to this project "
    "without the name of their publication and could not be checked. The rest was measured here, on the pairs of this "
    "size in this report (`--pairs` with the Lego scene's for the same content), or on its first scene: displayed "
    "8-bit layers, one ray a pixel. `--published FILE.onnx` adds the published network, exported from its checkpoint "
    "by `phasestack export --arch eyereal --checkpoint F --width 640 --height 360`. Not comparable: views, weights "
    "and machines (their times are a GPU's); and one ray a pixel is no light that an eye gets: light is the figure to "
    "quote."
)


def literature_section(results: Sequence[MethodResult]) -> Section:
    """The table; results: of pairs of SIZE_PX, none where there are none."""
    rows = [[name, f"{psnr_db:.2f}", ms, "reported", "–"] for name, psnr_db, ms in REPORTED]
    rows += [
        [r.name, f"{r.psnr_db:.2f}", f"{r.ms_p50:.0f}", f"here, {len(r.pairs)} pair(s)", f"{r.quoted_db:.2f}"]
        for r in results
    ]
    headings = ["method", "one ray, dB", "ms", "whose figure", "light, dB"]
    return Section("Beside published figures (640x360)", [TEXT], tables=[Table(headings, rows)])
