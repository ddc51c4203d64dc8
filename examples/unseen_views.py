"""Evaluate a model on a folder of views from EyeReal's data set, with the figures that the paper reports.

The data set and the published network are not shipped; EyeReal's repository links them. The pictures' names contain the
eyes' positions, such as `pair0_x6.486_y-0.263_z2.004_1.jpg`, and the preset is the scene's name (docs/content.md).

python examples/unseen_views.py unseen/lego_bulldozer --preset lego_bulldozer --model balanced --model eyereal.onnx
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

import phasestack
from runtime.content.eyereal import Pair, read_folder
from runtime.content.presets import preset_names
from runtime.errors import InputError

WIDTH_M, HEIGHT_M, X_M = 0.5184, 0.2916, (-0.06, 0.0, 0.06)  # the published code's display
FOV_DEG = 40.0
FIGURES = ("psnr_db", "ssim", "light_db")


def evaluated(pairs: Sequence[Pair], model: str) -> dict[str, float]:
    """Return a model's means over all pairs: PSNR and SSIM with one ray per pixel, as published, and the light PSNR."""
    found = []
    for pair in pairs:
        left, right = (Image.open(path) for path in pair.paths)
        width, height = left.size
        stack = phasestack.Stack(WIDTH_M, HEIGHT_M, X_M, width_px=width, height_px=height)
        size = {"width_px": width, "height_px": height, "fov_deg": FOV_DEG}
        cameras = [pair.image_from_stack(side, **size) for side in (0, 1)]
        aimed = not pair.looks_at_m.any()  # at the display's centre, as `solve` assumes
        how = {"eyes_m": pair.eyes_m, "fov_deg": FOV_DEG} if aimed else {"cameras": cameras}
        quality = phasestack.solve(left, right, stack=stack, model=model, **how).quality
        found.append((quality.psnr_db, quality.ssim, quality.light_db["1"]))
    return dict(zip(FIGURES, np.mean(found, axis=0).round(3).tolist(), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    names = {"choices": preset_names(), "metavar": "NAME", "help": "the scene's name, such as lego_bulldozer"}
    parser.add_argument("--preset", required=True, **names)
    parser.add_argument("--model", action="append", help="a model's name or ONNX file (can be repeated)")
    asked = parser.parse_args()
    try:
        pairs = read_folder(asked.folder, asked.preset)
        for model in asked.model or ["balanced"]:
            print(json.dumps({"model": Path(model).stem, "pairs": len(pairs), **evaluated(pairs, model)}), flush=True)
    except (InputError, OSError, ValueError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
