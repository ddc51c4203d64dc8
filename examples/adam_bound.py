"""Estimate the best quality that panels can reach for a pair, with solver steps and then with Adam.

Adam minimises the squared error over random rays through square pixels, with new rays in every iteration. If it used
the light model (`light`) instead, the result would be worse than the solver steps' result, because Adam finds panels
for which the model is wrong by up to 2 dB at 44 dB.

python examples/adam_bound.py left.png right.png --panels panels.json --left-eye 0.6 -0.03 0 --right-eye 0.6 0.03 0
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import torch

from model_export.light import Views, light_db, step, traced
from runtime.config import load_stack

STEPS = 24


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pictures", nargs=2, type=Path, metavar="PICTURE", help="left and right")
    parser.add_argument("--panels", type=Path, required=True)
    parser.add_argument("--left-eye", nargs=3, type=float, required=True)
    parser.add_argument("--right-eye", nargs=3, type=float, required=True)
    parser.add_argument("--fov", type=float, default=40.0)
    parser.add_argument("--width", type=int, default=480, help="of the pictures and panels, pixels")
    parser.add_argument("--iterations", type=int, default=800, help="of Adam")
    asked = parser.parse_args()
    pictures = [cv2.imread(str(path))[..., ::-1] for path in asked.pictures]
    size = asked.width, round(asked.width * pictures[0].shape[0] / pictures[0].shape[1])
    small = np.stack([cv2.resize(picture, size, interpolation=cv2.INTER_AREA) for picture in pictures])
    targets = torch.from_numpy(small.transpose(0, 3, 1, 2).astype(np.float32) / 255)
    stack = load_stack(asked.panels, width_px=size[0], height_px=size[1])
    eyes = np.array([asked.left_eye, asked.right_eye])
    views = Views.of(stack, eyes, width_px=size[0], height_px=size[1], fov_deg=asked.fov)
    x = y = torch.full((stack.count, 3, *reversed(size)), 0.5)
    print("method, number, dB")
    for number in range(STEPS + 1):
        shown("steps", number, x, targets, views)
        if number < STEPS:
            x, y = step(x, y, targets, views, size=0.8)
    panels = x.clone().requires_grad_()
    adam = torch.optim.Adam([panels], lr=0.002)
    rate = torch.optim.lr_scheduler.CosineAnnealingLR(adam, asked.iterations)
    for number in range(1, asked.iterations + 1):
        adam.zero_grad()
        (a, in_a), (b, in_b) = (traced(panels, views, rays=1) for _ in range(2))
        ((a - targets) * (b - targets) * (in_a & in_b)).sum().backward()
        adam.step()
        rate.step()
        with torch.no_grad():
            panels.clamp_(0, 1)
        if number % 100 == 0 or number == asked.iterations:
            shown("Adam", number, panels.detach(), targets, views)


def shown(method: str, number: int, panels: torch.Tensor, targets: torch.Tensor, views: Views) -> None:
    """Print a table row with the light PSNR of the panels rounded to 8 bits."""
    print(f"{method}, {number}, {light_db((panels * 255).round() / 255, targets, views):.2f}")


if __name__ == "__main__":
    main()
