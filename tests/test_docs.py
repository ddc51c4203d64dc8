"""The pages of docs/: those of commands say what the commands' help says, and every link leads somewhere."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import runtime.config
from runtime.sensor.known_devices import KNOWN_DEVICES
from tests.shown import DOCS, PAGES, ROOT, shown_commands

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")


def script(name: str) -> Any:
    """A script of docs/ as a module."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


FIGURE = re.compile(r"(?<![\w.])\d+(?:\.\d+)? (?:dB|ms|us|px)\b")
DAY = re.compile(
    r"(?:January|February|March|April|May|June|July|August|September|October|November|December) 20\d\d|20\d\d-\d\d-\d\d"
)
BY = re.compile(
    r"`(?:phasestack |calibrate |bench |photo-trial|setup |plan |run |report|pytest |make )|tests/\w|^    phasestack",
    re.M,
)
REPORTED = {"models.md", "performance.md"}  # whose tables are remade with every model, and dated one by one


def sections_with_unexplained_figures(text: str) -> list[str]:
    """The headings of sections that tell decibels, milliseconds or pixels and not by what and when."""
    sections = re.split(r"(?m)^(?=#{1,4} )", text)
    return [
        section.partition("\n")[0]
        for section in sections
        if FIGURE.search(section) and not (DAY.search(section) and BY.search(section))
    ]


def anchors(page: Path) -> set[str]:
    """What GitHub and its like make of a page's headings."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_every_commands_page_says_what_its_help_says() -> None:
    written = {path.name: path.read_text(encoding="utf-8") for path in (DOCS / "commands").glob("*.md")}
    wanted = script("make_pages").pages()
    stale = sorted(name for name in written.keys() | wanted.keys() if written.get(name) != wanted.get(name))
    assert stale == [], "run `make docs`"


def test_a_changed_help_makes_its_page_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    pages = script("make_pages")
    before = pages.pages()
    demo = next(info for info in pages.app.registered_commands if info.callback.__name__ == "demo")
    monkeypatch.setattr(
        demo.callback, "__doc__", "Another text. Exits with 7 on Sundays.\n\nExample: phasestack demo -7\n"
    )
    after = pages.pages()
    assert [name for name in before if before[name] != after[name]] == ["README.md", "demo.md"]
    assert "Another text." in after["demo.md"]
    assert "    phasestack demo -7\n" in after["demo.md"]
    assert "; 7 on Sundays." in after["demo.md"]
    assert "| 7 | `demo`: on Sundays |" in after["README.md"]


def test_every_command_and_sub_command_has_an_example_and_says_what_its_options_are() -> None:
    pages = script("make_pages")
    root = pages.typer.main.get_command(pages.app)
    for path, command in pages.walk(root, ["phasestack"]):
        name = " ".join(path)
        assert f"Example: {name}" in command.help, name
        silent = [parameter.name for parameter in command.params if not parameter.help]
        assert silent == [], name


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        assert place.exists(), f"{page.name}: {target}"
        assert not anchor or anchor in anchors(place), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_file_and_module_that_a_page_names_is_there(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    files = re.findall(r"`((?:runtime|calib|model_export|tests|docs|systemd|examples|requirements)/[\w./{},*-]*)", text)
    modules = re.findall(r"python -m ((?:runtime|calib|model_export|tests)[\w.]*)", text)
    gone = [name for name in files if not any(list(ROOT.glob(one)) for one in alternatives(name.rstrip("/.")))]
    gone += [name for name in modules if importlib.util.find_spec(name) is None]
    assert gone == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_target_of_make_that_a_page_names_is_there(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    calls = re.findall(r"(?:^    |`)make ([a-z][a-z -]*)", page.read_text(encoding="utf-8"), re.MULTILINE)
    assert {target for call in calls for target in call.split()} <= targets


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda page: page.name)
def test_a_figure_says_by_what_and_when_it_was_measured(page: Path) -> None:
    if page.name not in REPORTED:
        assert sections_with_unexplained_figures(page.read_text(encoding="utf-8")) == []


def test_a_figure_without_a_day_or_without_a_command_is_found() -> None:
    whole = "# A\n\n## B\n\n`phasestack bench` takes 12 ms (21 November 2026).\n"
    assert sections_with_unexplained_figures(whole) == []
    assert sections_with_unexplained_figures(whole.replace(" (21 November 2026)", "")) == ["## B"]
    assert sections_with_unexplained_figures(whole.replace("`phasestack bench`", "It")) == ["## B"]


def alternatives(name: str) -> list[str]:
    """`a/{b,c}.json` as a/b.json and a/c.json."""
    head, brace, rest = name.partition("{")
    inner, _, tail = rest.partition("}")
    return [head + one + tail for one in inner.split(",")] if brace else [name]


def test_every_page_can_be_reached_from_the_readme() -> None:
    reached, waiting = set(), [ROOT / "README.md"]
    while waiting:
        page = waiting.pop()
        reached.add(page)
        links = (link.partition("#")[0] for link in LINK.findall(page.read_text(encoding="utf-8")))
        places = ((page.parent / link).resolve() for link in links if link.endswith(".md") and ":" not in link)
        waiting += [place for place in places if place not in reached]
    assert sorted(str(page.relative_to(ROOT)) for page in PAGES if page not in reached) == []


def test_the_gallery_shows_what_its_list_names_with_the_commands_that_made_it() -> None:
    gallery = script("make_gallery")
    made = json.loads(gallery.MADE.read_text(encoding="utf-8"))
    assert gallery.PAGE.read_text(encoding="utf-8") == gallery.page(made), "run `make gallery`"
    sizes = {path.name: path.stat().st_size for path in gallery.IMAGES.iterdir()}
    assert sizes.keys() == {picture.file for picture in gallery.pictures().values()} | {gallery.MADE.name}
    assert max(sizes.values()) <= gallery.LIMIT_BYTES
    assert sum(sizes.values()) <= 2_500_000


def test_every_command_that_a_page_shows_exists_with_its_options() -> None:
    pages = script("make_pages")
    known = {tuple(path[1:]): command for path, command in pages.walk(pages.typer.main.get_command(pages.app), [""])}
    shown = shown_commands()
    assert len(shown) > 60
    for page, line in shown:
        for part in line.split(", "):  # `phasestack record, doctor, status`
            words = re.sub(r"^(?:phasestack|torchrun .* -m runtime\.cli) ", "", part).split()
            name = max((path for path in known if tuple(words[: len(path)]) == path), key=len)
            options = {option for parameter in known[name].params for option in parameter.opts} | {"--help"}
            assert name, f"{page}: {line}"
            asked = {word.strip("[];") for word in words if word.startswith(("--", "[--"))}
            assert asked <= options, f"{page}: {line}: {asked - options}"


def test_every_known_camera_with_a_driver_is_on_the_page_of_hardware() -> None:
    page = (DOCS / "hardware.md").read_text(encoding="utf-8")
    assert [device.name for device in KNOWN_DEVICES if device.driver and device.name not in page] == []


def test_ci_runs_what_the_readme_tells_a_newcomer_to_run() -> None:
    told = re.findall(r"^    (make \w+)", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert told == ["make demo", "make test"]
    run = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert [command for command in told if not re.search(rf"^{command}\b", run, re.MULTILINE)] == []


def test_a_picture_that_cannot_be_made_leaves_the_gallery_as_it_was(tmp_path: Path) -> None:
    gallery = script("make_gallery")
    before = {path: path.read_bytes() for path in [gallery.PAGE, *gallery.IMAGES.iterdir()]}
    call = [sys.executable, DOCS / "make_gallery.py", "--work", tmp_path / "w"]
    (tmp_path / "w" / "verniers").mkdir(parents=True)  # as if the command had left nothing
    result = subprocess.run([*call, "--keep", "verniers"], capture_output=True, text=True, timeout=60)
    assert result.returncode != 0
    assert "vernier-1-2-layer-1.png" in result.stderr
    assert {path: path.read_bytes() for path in before} == before


def test_the_first_change_that_contributing_leads_to_is_there_to_be_made() -> None:
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (name, section, before) = re.findall(r"find `(\w+)` \(of `(\w+)`\) and change its ([\d.]+) to", text)[0]
    assert getattr(getattr(runtime.config, section)(), name) == float(before)
    command = [sys.executable, "-m", "runtime.cli", "config"]
    lines = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=60, check=True
    ).stdout.splitlines()
    (place,) = [number for number, line in enumerate(lines) if line.startswith(name)]
    assert lines[place] == f"{name} = {before}" and lines[place - 1].startswith("# ")
    for run in re.findall(r"make golden GOLDEN_ARGS=(\S+)", text):
        assert (ROOT / "tests" / "golden" / "data" / f"{run}.jsonl").is_file()


@pytest.mark.parametrize(("page", "codes"), [("README.md", ()), ("docs/contracts.md", (130, 141)),
                                             ("docs/commands/README.md", (130, 141))])  # fmt: skip
def test_every_exit_code_is_in_the_tables(page: str, codes: tuple[int, ...]) -> None:
    told = re.findall(r"^\| (\d+) \|", (ROOT / page).read_text(encoding="utf-8"), re.MULTILINE)
    assert told == [str(code) for code in (0, 1, 2, 70, 75, *codes)]
