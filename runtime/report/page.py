"""Self-contained HTML pages for reports, a plot style, and a description of the machine."""

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
FIGURE_LENGTH = 16  # characters of a number with its unit, at most
PACKAGES = (
    "phasestack", "numpy", "scipy", "onnxruntime", "opencv-contrib-python-headless", "moderngl", "matplotlib",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Figure:
    """A PNG picture with a caption, for use on a page."""

    name: str  # file name without .png
    png: bytes
    caption: str

    @property
    def source(self) -> str:
        """The picture's data URI, which keeps the page independent of other files."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text, with a heading for each column."""

    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""

    def is_numeric(self, column: int) -> bool:
        """Return True if a column contains only figures."""
        cells = [row[column] for row in self.rows]
        return all(not cell or (cell[0] in "+-0123456789" and len(cell) <= FIGURE_LENGTH) for cell in cells)


@dataclass(frozen=True, slots=True)
class PageSection:
    """A page section, shown as paragraphs, figures, tables and links under a title."""

    title: str
    text: Sequence[str] = ()  # paragraphs of plain text
    figures: Sequence[Figure] = ()
    tables: Sequence[Table] = ()
    links: Sequence[tuple[str, str]] = ()  # pairs of link text and file name; names are relative to the page's folder


@dataclass(frozen=True, slots=True)
class Page:
    """A complete report page that can be written to a folder with its pictures and data."""

    title: str
    lead: str  # sentence below the title that gives the main result
    sections: Sequence[PageSection]
    machine: Mapping[str, str] = field(default_factory=dict)  # facts about the machine, keyed by name (`describe`)
    command: str = ""  # command that reproduces the page; not shown if empty
    notes: Sequence[str] = ()  # caveats

    def html(self) -> str:
        """Return the page as HTML. All text is escaped, and the page makes no external requests."""
        from jinja2 import Environment, StrictUndefined

        template = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
        environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
        return environment.from_string(template).render(page=self)

    def figures(self) -> list[Figure]:
        """Return all figures on the page, in order of appearance."""
        return [figure for section in self.sections for figure in section.figures]

    def write(self, out: Path, *, data: Any, data_name: str = "report.json") -> None:
        """Write index.html, the pictures and a JSON file of the data, all or none. Raises InputError."""
        with OutputFolder(out) as folder:
            write_json(folder.staging / data_name, data)
            write_text(folder.staging / "index.html", self.html())
            for figure in self.figures():
                write_bytes(folder.staging / f"{figure.name}.png", figure.png)


@contextmanager
def drawing(width_in: float, height_in: float) -> Iterator[Any]:
    """Yield an empty matplotlib figure in the reports' style, without using pyplot's global state."""
    from matplotlib import style
    from matplotlib.figure import Figure as Drawing

    with style.context(STYLE):  # type: ignore[arg-type]
        yield Drawing(figsize=(width_in, height_in), layout="constrained")


def png(figure: Any) -> bytes:
    """Return a matplotlib figure as a PNG file without time stamps, so that its bytes are reproducible."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def describe() -> dict[str, str]:
    """Return facts about the machine and package versions, keyed by name, for a report page."""
    facts = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "memory": f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.1f} GiB",
        "system": f"{platform.system()} {platform.release()}",
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
