"""Self-contained HTML pages of reports, the style of their plots, and a description of the machine."""

from __future__ import annotations

import base64
import io
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from runtime.support.artifacts import OutputFolder, write_bytes, write_json, write_text

STYLE = ["seaborn-v0_8-whitegrid", {"figure.dpi": 130, "axes.spines.top": False, "axes.spines.right": False}]
PACKAGES = (
    "phasestack", "numpy", "scipy", "onnxruntime", "opencv-contrib-python-headless", "moderngl", "matplotlib",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Figure:
    """Picture and its caption."""

    name: str  # file name without .png
    png: bytes
    caption: str

    @property
    def source(self) -> str:
        """Return the picture as a data URI, so that the page needs no other file."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True, slots=True)
class Table:
    """Table of text under headings."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class PageSection:
    """Section of a page."""

    title: str
    text: Sequence[str] = ()  # paragraphs, plain text
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    links: Sequence[tuple[str, str]] = ()  # pairs of a text and a file next to the page


@dataclass(frozen=True, slots=True)
class Page:
    """Complete report page."""

    title: str
    lead: str  # the main result in a sentence
    sections: Sequence[PageSection]
    machine: Mapping[str, str] = field(default_factory=dict)
    command: str = ""  # command that reproduces this page; empty: not shown
    notes: Sequence[str] = ()  # caveats

    def html(self) -> str:
        """Return the page as HTML, with all text escaped and no external requests."""
        from jinja2 import Environment, StrictUndefined

        template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        return environment.from_string(template).render(page=self)

    def figures(self) -> list[Figure]:
        """Return all pictures of the page, in order."""
        return [figure for section in self.sections for figure in section.figures]

    def write(self, out: Path, *, record: str, data: Any) -> None:
        """Write index.html, its PNGs and `data` (to the file `record`) into the folder `out`.

        All files appear together or not at all. Raises InputError if they cannot be written.
        """
        with OutputFolder(out) as folder:
            write_json(folder.staging / record, data)
            write_text(folder.staging / "index.html", self.html())
            for figure in self.figures():
                write_bytes(folder.staging / f"{figure.name}.png", figure.png)


def section_of(title: str, rows: Sequence[Sequence[str]]) -> PageSection:
    """Create a section with one table, whose headings are in the first row."""
    return PageSection(title, tables=[Table(rows[0], rows[1:])])


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """Yield a matplotlib figure in the reports' style, without pyplot's global state."""
    from matplotlib import style
    from matplotlib.figure import Figure as Drawing

    with style.context(STYLE):  # type: ignore[arg-type]
        yield Drawing(figsize=(width_in, height_in), layout="constrained")


def png(figure: Any) -> bytes:
    """Return a figure as PNG without time stamps, so that equal data give equal bytes."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def describe() -> dict[str, str]:
    """Return facts about the machine and the versions of installed packages, in a page's order."""
    facts = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GiB",
        "system": f"{platform.system()} {platform.release()}",
        "seed": "0",  # seed of all random numbers
        "Python": platform.python_version(),
    }
    for name in PACKAGES:
        try:
            facts[name] = version(name)
        except PackageNotFoundError:
            continue
    return facts


def _processor() -> str:
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
