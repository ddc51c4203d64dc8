"""A program that draws phasestack's pictures: a turning wire cube, by numpy alone.

Start the daemon with `phasestack run --scene external`, then:

    python examples/external_cube.py --socket /run/phasestack/content.sock
"""

from __future__ import annotations

import argparse

import numpy as np

from runtime.content.external_client import ExternalClient

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
EDGES = [(a, b) for a in range(8) for b in range(a) if np.abs(CORNERS[a] - CORNERS[b]).sum() == 2]
HALF_SIDE_M = 0.05
THICKNESS_M = 0.002


def draw(pixels_from_stack: np.ndarray, width: int, height: int, angle: float) -> np.ndarray:
    """(height, width, 4) RGBA of the cube as one eye sees it: dots along its edges, white and clear elsewhere."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    picture = np.zeros((height, width, 4), np.uint8)
    picture[..., :3] = 255
    steps = np.linspace(0, 1, 2 * max(width, height) // 3)[:, None]
    for a, b in EDGES:
        points = (CORNERS[a] + steps * (CORNERS[b] - CORNERS[a])) @ turn.T * HALF_SIDE_M
        for shift in (-0.5, 0.0, 0.5):
            thick = points + np.array([0, 0, shift * THICKNESS_M])
            projected = np.column_stack([thick, np.ones(len(thick))]) @ pixels_from_stack.T
            pixels = np.floor(projected[:, :2] / projected[:, 2:]).astype(int)
            inside = ((pixels >= 0) & (pixels < [width, height])).all(1) & (projected[:, 2] > 0)
            columns, rows = pixels[inside].T
            picture[rows, columns] = [30, 30 + 25 * a, 250 - 25 * b, 255]
    return picture


def main() -> None:
    """Draw for whichever eyes the daemon asks for, until it is gone."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--socket", default="/run/phasestack/content.sock")
    arguments = parser.parse_args()
    try:
        display = ExternalClient(arguments.socket)
    except (OSError, ValueError) as error:
        raise SystemExit(f"{arguments.socket}: {error}") from None
    with display:
        while (request := display.wait()) is not None:
            angle = request.time_ns * 1e-9
            size = (display.width_px, display.height_px)
            left, right = (draw(matrix, *size, angle) for matrix in request.pixels_from_stack)
            display.send(request, left, right)


if __name__ == "__main__":
    main()
