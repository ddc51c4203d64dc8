"""Makes docs/images/ and docs/gallery.md anew by the commands in docs/gallery.toml. `make gallery`, or

    python docs/make_gallery.py [--work FOLDER] [--keep] [NAME ...]

With names, those pictures only. `--keep` takes what an earlier call left in the work folder and runs what is missing.
"""

from __future__ import annotations

import argparse
import io
import json
import shlex
import shutil
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from runtime.report.machine import describe

DOCS = Path(__file__).resolve().parent
IMAGES = DOCS / "images"
PICTURES = DOCS / "gallery.toml"
PAGE = DOCS / "gallery.md"
MADE = IMAGES / "made.json"
WORK = DOCS.parent / "out" / "gallery"
LIMIT_BYTES = 200_000
NOTICE = "<!-- Made by `make gallery`: change docs/gallery.toml, not this page. -->\n\n"
INTRODUCTION = """\
# Gallery

Every picture here was made by the commands beneath it, on the machine and day named there, and scaled down. All of
them are made anew by `make gallery` (some minutes). Milliseconds in a plot hold for that machine: compare ratios.
"""
GAP_PX = 8


@dataclass(frozen=True, slots=True)
class Picture:
    """One picture of the gallery: from which files of which commands it is put together."""

    name: str
    title: str
    text: str
    commands: tuple[str, ...]
    sources: tuple[str, ...]
    columns: int = 1
    photo: bool = False
    width_px: int = 1000

    @property
    def file(self) -> str:
        return f"{self.name}.{'jpg' if self.photo else 'png'}"


def pictures() -> dict[str, Picture]:
    """The gallery's pictures by name, in its order. Raises TypeError for a key that no picture has."""
    table = tomllib.loads(PICTURES.read_text(encoding="utf-8"))["picture"]
    lists = ("commands", "sources")
    return {entry["name"]: Picture(**entry | {key: tuple(entry[key]) for key in lists}) for entry in table}


def page(made: dict[str, str]) -> str:
    """The text of docs/gallery.md; `made` says of each picture on which machine and day it was made."""
    parts = [NOTICE + INTRODUCTION]
    for picture in pictures().values():
        commands = "\n".join(f"    phasestack {command}" for command in picture.commands)
        parts.append(
            f"## {picture.title}\n\n![{picture.title}](images/{picture.file})\n\n{picture.text}\n\n{commands}\n\n"
            f"*{made[picture.name]}*\n"
        )
    return "\n".join(parts)


def run_commands(chosen: list[Picture], work: Path, *, keep: bool) -> None:
    """Run what the pictures need, each command once. Raises SystemExit where one cannot do it."""
    commands = dict.fromkeys(command for picture in chosen for command in picture.commands)
    for command in commands:
        words = shlex.split(command)
        target = work / words[words.index("--out") + 1]
        if keep and target.exists():
            continue
        if target.is_dir():
            shutil.rmtree(target)
        target.unlink(missing_ok=True)
        print(f"phasestack {command}", flush=True)
        done = subprocess.run([sys.executable, "-m", "runtime.cli", *words], cwd=work, stdout=subprocess.DEVNULL)
        # 1: what the command checks has failed; its picture is there and shows it.
        if done.returncode not in (0, 1):
            raise SystemExit(f"phasestack {command}: exit {done.returncode}")


def put_together(picture: Picture, work: Path) -> bytes:
    """The picture's file: its sources side by side, scaled down. Raises SystemExit where it stays too large."""
    tiles = [Image.open(work / source).convert("RGB") for source in picture.sources]
    width = (picture.width_px - GAP_PX * (picture.columns - 1)) // picture.columns
    small = [tile.resize((width, round(tile.height * width / tile.width)), Image.Resampling.LANCZOS) for tile in tiles]
    height = max(tile.height for tile in small)
    rows = -(-len(small) // picture.columns)
    sheet = Image.new("RGB", (picture.width_px, rows * height + GAP_PX * (rows - 1)), "white")
    for index, tile in enumerate(small):
        row, column = divmod(index, picture.columns)
        sheet.paste(tile, (column * (width + GAP_PX), row * (height + GAP_PX)))
    data = _jpeg(sheet) if picture.photo else _png(sheet)
    if len(data) > LIMIT_BYTES:
        raise SystemExit(f"{picture.file}: {len(data)} bytes, more than {LIMIT_BYTES}: make it smaller")
    return data


def _png(sheet: Image.Image) -> bytes:
    """A palette of 256 colours: what plots and test pictures need, at a third of the size."""
    file = io.BytesIO()
    sheet.quantize(256, dither=Image.Dither.NONE).save(file, "PNG", optimize=True)
    return file.getvalue()


def _jpeg(sheet: Image.Image) -> bytes:
    """The best quality, from 85 down to 55, that keeps within the limit."""
    for quality in range(85, 50, -5):
        file = io.BytesIO()
        sheet.save(file, "JPEG", quality=quality, optimize=True)
        if file.tell() <= LIMIT_BYTES:
            break
    return file.getvalue()


def main() -> None:
    """Run, put together, and only then write: a command that fails leaves the gallery as it was."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(pictures()))
    parser.add_argument("--work", type=Path, default=WORK)
    parser.add_argument("--keep", action="store_true")
    arguments = parser.parse_args()
    known = pictures()
    if unknown := [name for name in arguments.names if name not in known]:
        parser.error(f"no such picture: {', '.join(unknown)}")
    chosen = [known[name] for name in arguments.names] or list(known.values())
    arguments.work.mkdir(parents=True, exist_ok=True)
    run_commands(chosen, arguments.work, keep=arguments.keep)
    files = {picture.file: put_together(picture, arguments.work) for picture in chosen}

    facts = describe()
    stamp = f"Made {facts['date'][:10]}: phasestack {facts['phasestack']}, {facts['processor']}, {facts['cores']} cores"
    made = json.loads(MADE.read_text(encoding="utf-8")) if MADE.exists() else {}
    made = {name: text for name, text in made.items() if name in known} | {picture.name: stamp for picture in chosen}
    if missing := known.keys() - made.keys():
        raise SystemExit(f"never made: {', '.join(sorted(missing))}")
    for name, data in files.items():
        (IMAGES / name).write_bytes(data)
    for old in IMAGES.iterdir():
        if old.name not in {MADE.name, *(picture.file for picture in known.values())}:
            old.unlink()
    MADE.write_text(json.dumps(dict(sorted(made.items())), indent=2) + "\n", encoding="utf-8")
    PAGE.write_text(page(made), encoding="utf-8")


if __name__ == "__main__":
    main()
