"""What three panels could show of a pair: Adam on light itself, beside the solver's own kind of step.

python examples/adam_bound.py left.png right.png --panels panels.json --left-eye 0.6 -0.03 0 --right-eye 0.6 0.03 0
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from model_export.light import Views, light, light_db, step
from runtime.config import load_stack


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs=2, type=Path, metavar=("LEFT", "RIGHT"))
    parser.add_argument("--panels", type=Path, required=True)
    parser.add_argument("--left-eye", nargs=3, type=float, required=True)
    parser.add_argument("--right-eye", nargs=3, type=float, required=True)
    parser.add_argument("--fov", type=float, default=40.0)
    parser.add_argument("--width", type=int, default=480, help="of the pictures and panels, pixels")
    parser.add_argument("--steps", type=int, default=300)
    asked = parser.parse_args()
    pictures = [cv2.imread(str(path))[..., ::-1] for path in asked.pictures]
    size = asked.width, round(asked.width * pictures[0].shape[0] / pictures[0].shape[1])
    small = np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures])
    targets = torch.from_numpy(small.transpose(0, 3, 1, 2).astype(np.float32) / 255)
    stack = load_stack(asked.panels, width_px=size[0], height_px=size[1])
    eyes = np.array([asked.left_eye, asked.right_eye])
    views = Views.of(stack, eyes, width_px=size[0], height_px=size[1], fov_deg=asked.fov)
    x = y = torch.full((stack.count, 3, *reversed(size)), 0.5)
    panels = x.clone().requires_grad_()
    adam = torch.optim.Adam([panels], lr=0.03)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, asked.steps)
    print("steps, dB by steps, dB by Adam")
    for number in range(asked.steps + 1):
        with torch.no_grad():
            if number in (0, 1, 2, 4, 8, 16, 32, 64, 128, asked.steps) or number % 100 == 0:
                shown = [(values.clamp(0, 1) * 255).round() / 255 for values in (x, panels)]
                print(", ".join([str(number), *(f"{light_db(codes, targets, views):.2f}" for codes in shown)]))
            x, y = step(x, y, targets, views, size=0.8)
        adam.zero_grad()
        seen, counts = light(panels.clamp(0, 1), views)
        (((seen - targets) * counts) ** 2).sum().backward()
        adam.step()
        rate.step()


if __name__ == "__main__":
    main()
