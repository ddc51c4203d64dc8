"""Every command that the pages show is run as it stands there, in a folder with what it names, or said why not."""

from __future__ import annotations

import re
import shlex
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.panels import xserver
from tests.shown import ROOT, commands_in, runnable_commands, shown_commands

if TYPE_CHECKING:
    from tests.workshop import Workshop


@dataclass(frozen=True)
class Way:
    """What is added to a command here: options that make it short or keep it in its folder, and a person's keys."""

    more: str = ""
    keys: str = ""
    codes: tuple[int, ...] = (0,)
    first: str = ""  # typed before it
    monitors: bool = False  # its panels are the virtual screen's
    until: str = ""  # it ends when it is told to, which it is when it says this


SMALL_RUN = "--scale 0.1 --frames 5"
ASK = "--socket {socket}"
UP = "\x1b[A"
BOUND = f"\n{UP}\n" * 3  # identify's questions: this panel, its arrow points up, it is not mirrored

# By a command's first words; the longest that fit count. Nothing here: it is run as it stands.
WAYS = {
    "phasestack bench passes": Way("--width 192 --height 108"),
    "phasestack bench robust": Way("--pairs 1 --cache cache"),
    "phasestack calibrate capture --config": Way("--replay demo"),
    "phasestack calibrate charts": Way("--panels small.json --viewpoint R50-phi80-theta90"),
    "phasestack calibrate methods": Way("--seeds 2 --pairs-max 100"),
    "phasestack calibrate panels board": Way(keys="q", monitors=True),
    "phasestack calibrate panels charts": Way("--panels small.json"),
    "phasestack calibrate panels cost": Way("--panels small.json --model fast"),
    "phasestack calibrate panels grey-chart": Way(keys="q", monitors=True),
    "phasestack calibrate panels photo ": Way("--model ''"),
    "phasestack calibrate panels photo-trial": Way("--stacks 1 --count 6 --megapixels 5"),
    "phasestack calibrate panels simulate": Way("--panels small.json --model fast"),
    "phasestack calibrate panels vernier": Way(keys="\nq", monitors=True),
    "phasestack ctl": Way(ASK),
    "phasestack ctl next": Way(ASK, first="phasestack ctl scene playlist.toml"),
    "phasestack demo": Way(SMALL_RUN),
    "phasestack doctor": Way(codes=(0, 1)),  # what this machine lacks is no mistake of the page
    "phasestack export --arch eyereal --checkpoint": Way("--width 192 --height 108"),
    "phasestack export --arch eyereal --random-init": Way("--width 64 --height 64 --base-width 16"),
    "phasestack identify": Way("--seconds 1", monitors=True),
    "phasestack identify --ask": Way("--config phasestack.toml", keys=BOUND, monitors=True),
    "phasestack identify --config phasestack.toml --ask": Way(keys=BOUND, monitors=True),
    "phasestack identify --out": Way("--config phasestack.toml"),
    "phasestack page": Way(f"--port 0 {ASK}", until="http://", codes=(-signal.SIGTERM,)),
    "phasestack plan": Way("--scale 0.1"),
    "phasestack plan --survey": Way("--quick"),
    "phasestack record --out": Way("--config phasestack.toml --seconds 1"),
    "phasestack run": Way(SMALL_RUN),
    "phasestack run --scene external": Way(f"--config phasestack.toml --replay demo --headless {SMALL_RUN}"),
    "phasestack setup": Way(keys="nnnnnnn", monitors=True),
    "phasestack setup --config": Way(keys=f"\n{BOUND}nnnnnn", monitors=True),
    "phasestack setup --simulate": Way(keys="nnnnnnn"),
    "phasestack status": Way(ASK),
    "phasestack train": Way("--iterations 1"),
    "torchrun": Way("--iterations 1"),
}

BENCH = "measures at full size, which takes minutes where others work too: `make nightly` runs it"
REPORT = "takes many minutes: tests/report/test_report.py makes one with --quick --focal"
NOT_RUN = {
    "phasestack bench --backend gl --out gl.json": BENCH,
    "phasestack bench --out bench.json": BENCH,
    "phasestack bench --out new.json": BENCH,
    "phasestack plan --survey --out plan": "is run as `phasestack plan --survey --out out/plan`",
    "phasestack report --focal": REPORT,
    "phasestack report --out report": REPORT,
    "phasestack report --pairs my-pairs --out report": REPORT,
    "phasestack report --quick --focal --out report": REPORT,
    "phasestack stability --full --record runtime/report/stability/limits.json": "changes a file that ships",
    "phasestack stability --out stability": "the fast tests run it: tests/report/test_stability.py",
    "phasestack stability --out stability --full": "takes many minutes: tests/report/test_stability.py runs it",
    "phasestack train --recipe balanced --iterations 400 --threads 1 --out out/balanced": "is run with one iteration: "
    "`phasestack train --recipe balanced --out out/balanced`",
}

RUN = [line for line in runnable_commands() if line not in NOT_RUN]
# What the pages name and a checkout or this machine has elsewhere.
PLACES = {"/etc/phasestack/phasestack.toml": "phasestack.toml", "runtime/model/data/": f"{ROOT}/runtime/model/data/"}


def way_of(line: str) -> tuple[str, Way]:
    """The entry of WAYS that a command is run by, and its words; empty: as it stands."""
    fitting = [words for words in WAYS if f"{line} ".startswith(words)]
    words = max(fitting, key=len, default="")
    return words, WAYS.get(words, Way())


def as_run(line: str, *, socket: Path) -> str:
    """A page's line with its way's options, before a pipe or a redirection."""
    for named, there in PLACES.items():
        line = line.replace(named, there)
    call, sign, rest = re.fullmatch(r"(.*?)(?: ([|>]) (.*))?", line).groups()
    more = way_of(line)[1].more.format(socket=shlex.quote(str(socket)))
    return " ".join(filter(None, (call, more, sign, rest)))


def written_by(line: str) -> list[str]:
    """The files and folders that a command must leave."""
    return re.findall(r"(?:--out|--record| >) (\S+)", line)


def test_every_command_is_run_or_said_why_not_and_nothing_is_told_of_commands_that_no_page_shows() -> None:
    shown = runnable_commands()
    assert len(shown) > 80
    assert [line for line in NOT_RUN if line not in shown] == []
    assert [line for line, why in NOT_RUN.items() if len(why.split()) < 2] == []
    assert WAYS.keys() - {way_of(line)[0] for line in RUN} == set()


def test_a_reason_names_tests_that_are_there() -> None:
    named = [name for why in NOT_RUN.values() for name in re.findall(r"tests/[\w/.]+", why)]
    assert [name for name in named if not (ROOT / name).exists()] == []


def test_what_is_left_out_is_a_form_and_not_a_command() -> None:
    left_out = {line for page, line in shown_commands() if page != "docs/contracts.md"} - set(runnable_commands())
    assert [line for line in left_out if not re.search(r"[A-Z]{2}|\.\.\.|\[|, ", line)] == []


def test_a_page_is_read_as_a_person_reads_it() -> None:
    page = (
        "Type `phasestack config --check a.toml`, not `phasestack demo`:\n\n"
        "    phasestack demo --out out  # pictures\n"
        "    sudo -u phasestack env A=b \\\n      phasestack doctor\n"
        "    .venv/bin/phasestack config > a.toml     and so on\n"
        "    python -m other\n"
    )
    assert commands_in(page) == [
        "phasestack demo --out out",
        "phasestack doctor",
        "phasestack config > a.toml",
        "phasestack config --check a.toml",
    ]


@pytest.fixture(scope="module")
def workshop() -> Iterator[Workshop]:
    pytest.importorskip("torch")
    from tests.page.rig import short_folder
    from tests.workshop import Workshop

    with short_folder() as folder:
        made = Workshop(folder)
        yield made
        made.close()


@pytest.fixture(scope="module")
def screen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[xserver.XServer]:
    server = xserver.start_or_skip(tmp_path_factory.mktemp("xorg"))
    yield server
    server.stop()


def cases() -> list[object]:
    """Every command; those that ask the daemon come last, since it takes time from the others."""
    ways = {line: way_of(line)[1] for line in sorted(RUN, key=lambda line: ASK in way_of(line)[1].more)}
    return [
        pytest.param(line, id=line, marks=[pytest.mark.windows] if way.monitors else []) for line, way in ways.items()
    ]


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("line", cases())
def test_a_command_of_the_pages_does_what_it_says(
    line: str, workshop: Workshop, request: pytest.FixtureRequest
) -> None:
    way = way_of(line)[1]
    with workshop.copied() as folder:
        display = ""
        if way.monitors:
            display = request.getfixturevalue("screen").name
            (folder / "monitors.toml").replace(folder / "phasestack.toml")
        if ASK in way.more:
            workshop.wake_daemon()
        for name in written_by(line):
            (folder / name).unlink(missing_ok=True)
        if way.first:
            assert workshop.typed(as_run(way.first, socket=workshop.socket), folder).returncode == 0
        call = as_run(line, socket=workshop.socket)
        if way.until:
            done = workshop.told_to_end(call, folder, at=way.until)
        else:
            done = workshop.typed(call, folder, keys=way.keys, display=display)
        told = f"{call}\n{done.stdout}\n{done.stderr}"
        assert done.returncode in way.codes, told
        assert "Traceback" not in done.stderr, told
        assert [name for name in written_by(line) if not (folder / name).exists()] == [], told
        if line == "phasestack ctl restart":
            assert workshop.daemon_ended() == 75
