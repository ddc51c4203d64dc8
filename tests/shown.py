"""The command lines that the pages show: what a reader would type."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md")])

# An example, perhaps with who asks (`sudo -u ...`) or where the program is before it; torchrun starts it by its module.
EXAMPLE = re.compile(r"^ {4,}(?:sudo .*|\S*/)?((?:phasestack|torchrun .* -m runtime\.cli) .+)$", re.MULTILINE)
IN_A_SENTENCE = re.compile(r"`(phasestack [^`]* --[^`]+)`")  # without an option it is a command's name
REMARK = re.compile(r"\s+(?:#|&&)\s|;\s|\s{4,}")
# What is no command as it stands: `[OPTIONS]`, `...`, `--out FILE`, `left|right`, `phasestack record, doctor, status`.
SYNTAX = re.compile(r"\[|\.\.\.|\b[A-Z]{2,}\b|\S\||, ")


def shown_commands() -> list[tuple[str, str]]:
    """Every call of phasestack in the pages, remarks taken off and continued lines joined: page and words."""
    return [(str(page.relative_to(ROOT)), line) for page in PAGES for line in commands_in(page.read_text("utf-8"))]


def commands_in(text: str) -> list[str]:
    """The same of one page's text."""
    text = re.sub(r"\s*\\\n\s*", " ", text)
    found = [REMARK.split(line)[0] for line in EXAMPLE.findall(text)]
    return found + [" ".join(words.split()) for words in IN_A_SENTENCE.findall(text)]


def runnable_commands() -> list[str]:
    """Those that can be typed as they stand, each once, in the pages' order; contracts.md has forms, not examples."""
    lines = [line for page, line in shown_commands() if page != "docs/contracts.md" and not SYNTAX.search(line)]
    return list(dict.fromkeys(lines))
