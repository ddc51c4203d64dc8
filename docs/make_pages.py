"""Writes docs/commands/: a page for each command, made from the command's own help. `make docs`, or

    python docs/make_pages.py [FOLDER]

What a help says in a paragraph that begins with "Example:" becomes an example, and each sentence "Exits with N ..."
a row of the table of exit codes; everything else is text.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from runtime.commands.app import app

FOLDER = Path(__file__).resolve().parent / "commands"
NOTICE = "<!-- Made by `make docs` from the command's own help: change that, not this page. -->\n\n"
EVERYWHERE = {
    0: "done",
    2: "bad usage or bad input",
}
ANYWHERE = {  # but in the index alone: they say nothing about a command
    70: "an error of ours: one line on stderr names the file that tells it whole",
    130: "Ctrl-C",
    141: "nobody reads what is printed",
}
COMMON = (
    "Bad input (2) is one line on stderr that names the file or the option, and the field; bad usage (an option that",
    "is not there, a word for a number) is told with the usage. A library that decodes pictures or films may write",
    "lines of its own before.",
    "",
    "`--json` prints one JSON object on stdout. `--out` makes its parents and replaces files of the same names; after",
    "an error nothing new is left there.",
)
EXIT = re.compile(r"Exits with (\d+) ([^.]*)\. ?")
# The kinds of values as the help writes them, and as the pages do.
KINDS = {"path": "PATH", "str": "TEXT", "int": "N", "float": "X"}


def pages() -> dict[str, str]:
    """File name to text, for every page and the index."""
    root: Any = typer.main.get_command(app)
    done = {f"{name}.md": NOTICE + _page(command, ["phasestack", name]) for name, command in root.commands.items()}
    return {"README.md": NOTICE + _index(root), **done}


def write(folder: Path) -> None:
    """Write every page, and take away those of commands that are no more."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = pages()
    for old in folder.glob("*.md"):
        if old.name not in wanted:
            old.unlink()
    for name, text in wanted.items():
        (folder / name).write_text(text, encoding="utf-8")


def walk(command: Any, path: list[str]) -> Iterator[tuple[list[str], Any]]:
    """A command and all below it, each with the words that call it."""
    yield path, command
    for name, child in getattr(command, "commands", {}).items():
        yield from walk(child, [*path, name])


def _index(root: Any) -> str:
    lines = ["# Commands", "", _sentence(root), "", "| command | what it does |", "| --- | --- |"]
    for path, command in walk(root, ["phasestack"]):
        if len(path) == 1:
            continue
        anchor = "" if len(path) == 2 else "#" + "-".join(path)
        lines.append(f"| [`{' '.join(path)}`]({path[1]}.md{anchor}) | {_sentence(command)} |")
    lines += ["", "## Exit codes", "", *_table(("code", "when"), _all_codes(root)), "", *COMMON]
    return "\n".join(lines) + "\n"


def _all_codes(root: Any) -> list[tuple[str, str]]:
    told: dict[int, list[str]] = {code: [text] for code, text in (EVERYWHERE | ANYWHERE).items()}
    for path, command in walk(root, ["phasestack"]):
        for code, text in EXIT.findall(_help(command)):
            told.setdefault(int(code), []).append(f"`{' '.join(path[1:])}`: {text}")
    return [(str(code), "; ".join(told[code])) for code in sorted(told)]


def _page(command: Any, path: list[str], level: int = 1, above: dict[int, str] | None = None) -> str:
    text, examples, told = _parts(_help(command))
    codes = {**EVERYWHERE, **(above or {}), **told}
    lines = [f"{'#' * level} {' '.join(path)}", "", *text]
    children = getattr(command, "commands", {})
    if children and not command.invoke_without_command:
        lines += [
            f"    {' '.join(path)} COMMAND",
            "",
            "Its commands: " + ", ".join(f"`{n}`" for n in children) + ".",
            "",
        ]
    else:
        lines += [f"    {_synopsis(command, path)}", ""]
    if command.params:
        rows = [_option(command, parameter) for parameter in command.params]
        lines += [*_table(("option", "meaning", "default"), rows), ""]
    if examples:
        lines += ["Example:" if len(examples) == 1 else "Examples:", "", *(f"    {line}" for line in examples), ""]
    if not children or command.invoke_without_command:
        lines += ["Exit codes: " + "; ".join(f"{code} {codes[code]}" for code in sorted(codes)) + ".", ""]
    below = {} if command.callback else told  # what a group that does nothing itself says, holds for all in it
    for name, child in children.items():
        lines += [_page(child, [*path, name], level + 1, below)]
    return "\n".join(lines).rstrip() + "\n"


def _help(command: Any) -> str:
    return command.help or ""


def _sentence(command: Any) -> str:
    """The first sentence of a help."""
    first = " ".join(_help(command).split("\n\n")[0].split())
    return re.split(r"(?<=[.:]) (?=[A-Z])", first)[0].replace("|", "\\|")


def _parts(text: str) -> tuple[list[str], list[str], dict[int, str]]:
    """The lines of a help that are text, its examples, and the exit codes that it tells of."""
    codes = {int(code): " ".join(when.split()) for code, when in EXIT.findall(text)}
    lines: list[str] = []
    examples: list[str] = []
    for paragraph in map(str.strip, EXIT.sub("", text).split("\n\n")):
        if paragraph.startswith("Example:"):
            examples.append(" ".join(paragraph.removeprefix("Example:").split()))
        elif paragraph:
            lines += [*(line.strip() for line in paragraph.splitlines()), ""]
    return lines, examples, codes


def _synopsis(command: Any, path: list[str]) -> str:
    """The words of a call: what must be there, then that there is more."""
    needed = [_call(command, p) for p in command.params if p.required]
    more = ["[OPTIONS]"] if any(not p.required for p in command.params) else []
    below = ["[COMMAND]"] if getattr(command, "commands", {}) else []
    return " ".join([*path, *needed, *more, *below])


def _call(command: Any, parameter: Any) -> str:
    """An option with the kind of its value, or an argument's name, as one types it."""
    words = parameter.get_help_record(typer.Context(command))[0]
    if not words.startswith("-"):
        return words.split()[0].upper()
    option, _, kind = words.partition(" ")
    plain = kind.removesuffix("...").strip("<>").removeprefix("list[").removesuffix("]").removesuffix(" range").lower()
    if not kind.startswith("<"):
        return words
    return f"{option} " + " ".join(KINDS.get(part, part) for part in plain.split(","))


def _option(command: Any, parameter: Any) -> tuple[str, str, str]:
    """One row of the table of options."""
    told = parameter.get_help_record(typer.Context(command))[1]
    extra = re.search(r"\s*\[([^][]*)\]$", told)
    meaning, default = parameter.help or "", ""
    for note in extra[1].split("; ") if extra else []:
        if note.startswith("default: "):
            default = f"`{note.removeprefix('default: ')}`"
        elif note == "required":
            default = "required"
        else:
            meaning += f" ({_range(note)})"
    return f"`{_call(command, parameter)}`", meaning, default


def _range(text: str) -> str:
    """`1<=x<=9` as 1 to 9, `x>=1` as from 1."""
    both = re.fullmatch(r"(.+)<=x<=(.+)", text)
    if both:
        return f"{both[1]} to {both[2]}"
    return text.replace("x>=", "from ").replace("x<=", "up to ")


def _table(head: tuple[str, ...], rows: list[Any]) -> list[str]:
    lines = [head, ("---",) * len(head), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in lines]


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
