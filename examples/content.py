"""Create a scene with each kind of content and run it.

The output contains the layers, the eyes' views and a contact sheet.

    python examples/content.py gltf --out out/content        # one kind; by default, all kinds are run

The scene's file is kept next to the run's pictures, and can be shown on a display:

    phasestack run --scene out/content/gltf/ring.glb
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

Made = tuple[str, str]  # value of `scene`, and further lines for the [content] table


def ball_and_ground(width: int, height: int, eye_x: float = 0.0) -> tuple[Image.Image, Image.Image]:
    """Draw a ball and bars in front of a background, and a depth map where white is nearest.

    `eye_x` is the ball's shift in pixels, used to draw another view; nearer parts of the scene shift more.
    """
    colour, depth = Image.new("RGB", (width, height), (235, 225, 205)), Image.new("L", (width, height), 50)
    pen, deep = ImageDraw.Draw(colour), ImageDraw.Draw(depth)
    for row in range(0, height, height // 9):
        for column in range(0, width, width // 16):
            if (row // (height // 9) + column // (width // 16)) % 2:
                x = column - eye_x * 0.2
                pen.rectangle([x, row, x + width // 16, row + height // 9], fill=(120, 160, 180))
    for bar in range(3):
        x = width * (0.12 + 0.08 * bar) - eye_x * 0.6
        box = [x, height * 0.15, x + width * 0.025, height * 0.9]
        pen.rectangle(box, fill=(40, 120, 60))
        deep.rectangle(box, fill=150)
    x, y, r = width * 0.62 - eye_x, height * 0.5, height * 0.26
    pen.ellipse([x - r, y - r, x + r, y + r], fill=(210, 60, 40))
    pen.ellipse([x - r * 0.6, y - r * 0.7, x - r * 0.1, y - r * 0.2], fill=(240, 140, 120))
    deep.ellipse([x - r, y - r, x + r, y + r], fill=230)
    return colour, depth


def picture(folder: Path) -> Made:
    """Write a flat picture."""
    ball_and_ground(960, 540)[0].save(folder / "picture.png")
    return str(folder / "picture.png"), ""


def side_by_side(folder: Path, *, half: bool = False) -> Made:
    """Write two views side by side. If `half` is true, both are compressed to half the columns."""
    left, right = (ball_and_ground(960, 540, eye_x=x)[0] for x in (-12, 12))
    pair = Image.new("RGB", (1920, 540))
    pair.paste(left, (0, 0))
    pair.paste(right, (960, 0))
    name = "pair_hsbs.png" if half else "pair_sbs.png"
    (pair.resize((960, 540)) if half else pair).save(folder / name)
    return str(folder / name), ""


def quilt(folder: Path) -> Made:
    """Write a quilt: the views from 24 cameras in one picture."""
    columns, rows, wide, high = 8, 3, 240, 135
    sheet = Image.new("RGB", (columns * wide, rows * high))
    for number in range(columns * rows):
        view = ball_and_ground(480, 270, eye_x=(number - (columns * rows - 1) / 2) * 3)[0].resize((wide, high))
        sheet.paste(view, (number % columns * wide, (rows - 1 - number // columns) * high))
    sheet.save(folder / f"views_qs{columns}x{rows}a1.78.png")
    return str(folder / f"views_qs{columns}x{rows}a1.78.png"), "cone_deg = 40"


def rgbd(folder: Path) -> Made:
    """Write a picture with its depth map on the right."""
    colour, depth = ball_and_ground(960, 540)
    both = Image.new("RGB", (1920, 540))
    both.paste(colour, (0, 0))
    both.paste(depth.convert("RGB"), (960, 0))
    both.save(folder / "ball_rgbd.png")
    return str(folder / "ball_rgbd.png"), ""


def film(folder: Path) -> Made:
    """Write a film of two views side by side."""
    import cv2

    writer = cv2.VideoWriter(str(folder / "film_sbs.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25, (960, 270))
    for number in range(50):
        swing = 8 * np.sin(number / 25 * np.pi)
        views = [np.asarray(ball_and_ground(480, 270, eye_x=swing + x)[0]) for x in (-6, 6)]
        writer.write(np.ascontiguousarray(np.concatenate(views, axis=1)[..., ::-1]))
    writer.release()
    return str(folder / "film_sbs.mp4"), ""


def mesh(folder: Path, *, suffix: str) -> Made:
    """Write a mesh of two shapes, with vertex colours unless the format has none (STL)."""
    import trimesh

    parts = [trimesh.creation.torus(1.0, 0.35), trimesh.creation.icosphere(subdivisions=3, radius=0.5)]
    for part, colour in zip(parts, ([60, 120, 210, 255], [230, 120, 40, 255]), strict=True):
        part.visual.vertex_colors = np.tile(colour, (len(part.vertices), 1))
        part.apply_transform(trimesh.transformations.rotation_matrix(0.9, [1, 0.4, 0]))
    path = folder / f"ring{suffix}"
    trimesh.util.concatenate(parts).export(path)
    return str(path), ""


def splats(folder: Path) -> Made:
    """Write a ring of Gaussian splats as a PLY file in the reference implementation's format."""
    rng = np.random.default_rng(0)
    count = 4000
    u, v = rng.random((2, count)) * 2 * np.pi
    centres = np.column_stack(
        [0.35 * np.sin(v), (1 + 0.35 * np.cos(v)) * np.cos(u), (1 + 0.35 * np.cos(v)) * np.sin(u)]
    )
    colours = (np.column_stack([np.cos(u), np.sin(u), np.cos(v)]) * 0.45) / 0.2820948
    table = np.column_stack(
        [centres, colours, np.full(count, 2.0), np.full((count, 3), np.log(0.035)), rng.normal(size=(count, 4))]
    )
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
    names += ["rot_0", "rot_1", "rot_2", "rot_3"]
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n"
    head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    (folder / "splats.ply").write_bytes(head.encode() + table.astype("<f4").tobytes())
    return str(folder / "splats.ply"), "axes = '+z +x'\nrotation_deg = [0, 25, 20]"


def playlist(folder: Path) -> Made:
    """Write a playlist that shows three scenes for half a second each."""
    mesh(folder, suffix=".stl")
    rgbd(folder)
    (folder / "evening.toml").write_text(
        "[[show]]\nscene = 'ring.stl'\nseconds = 0.5\nturntable_per_min = 20\n\n"
        "[[show]]\nscene = 'ball_rgbd.png'\nseconds = 0.5\ndepth_m = [-0.06, 0.06]\n\n"
        "[[show]]\nscene = 'demo'\nseconds = 0.5\nscale = 0.8\n"
    )
    return str(folder / "evening.toml"), ""


def data_set(folder: Path) -> Made:
    """Write a pair with file names as in the published data set, in a folder named after a scene."""
    pairs = folder / "lego_bulldozer"
    pairs.mkdir(exist_ok=True)
    for half, y, shift in ((1, -0.263, -20), (0, 0.237, 20)):
        ball_and_ground(960, 540, eye_x=shift)[0].save(pairs / f"pair0_x6.486_y{y}_z2.004_{half}.png")
    return str(pairs), ""


def placed(folder: Path) -> Made:
    """Show the demo scene at a reduced size, moved and rotating."""
    return "demo", "scale = 0.8\noffset_m = [0.02, 0.0, 0.01]\nturntable_per_min = 10"


KINDS: dict[str, Callable[[Path], Made]] = {
    "picture": picture, "side-by-side": side_by_side, "half-side-by-side": partial(side_by_side, half=True),
    "quilt": quilt, "rgbd": rgbd, "film": film, "obj": partial(mesh, suffix=".obj"),
    "stl": partial(mesh, suffix=".stl"), "splats": splats, "gltf": partial(mesh, suffix=".glb"),
    "playlist": playlist, "data-set": data_set, "placed": placed,
}  # fmt: skip


def main() -> int:
    """Create and run the scenes selected on the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", nargs="*", choices=[*KINDS, []], help="kinds to run; default: all")
    parser.add_argument(
        "--out", type=Path, default=Path("out/content"), help="output folder; each kind gets a subfolder"
    )
    parser.add_argument("--frames", type=int, default=45, help="refreshes of each run")
    parser.add_argument("--scale", default="0.25", help="factor on the panels' pixels")
    given = parser.parse_args()
    for kind in given.kind or KINDS:
        folder = (given.out / kind).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        scene, further = KINDS[kind](folder)
        config = folder / "phasestack.toml"
        config.write_text(f"[content]\nscene = {json.dumps(scene)}\n{further}\n")
        options = f"--replay demo --headless --max-speed --json --frames {given.frames} --scale {given.scale}".split()
        command = [sys.executable, "-m", "runtime.cli", "run", "--config", str(config), "--out", str(folder), *options]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
        if done.returncode:
            return done.returncode
        result = json.loads(done.stdout)
        print(f"{kind:18} {result['psnr_db']:6.2f} dB  {result['scene']}  {folder / 'contact-sheet.png'}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
