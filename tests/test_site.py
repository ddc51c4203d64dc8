"""Tests that the site builds without warnings and that code on the pages runs."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.test_docs import PAGES, ROOT

SHOWN = {  # pages whose Python is run, except lines that open a browser, and what it prints
    "README.md": r"\(3, 360, 640, 3\)",
    "python.md": "",
    "for-researchers.md": r"6cm balanced: 3[67]\.\d dB in \d+ ms\n1cm fast: 3[23]\.\d dB",
}
PICTURES = r"\.(?:png|jpg|webp)$"


def python_of(page: str) -> str:
    """The first indented block of a page that imports phasestack."""
    text = next(path for path in PAGES if path.name == page).read_text(encoding="utf-8")
    blocks = re.findall(r"(?:^ {4}.*\n|^\n)+", text, re.MULTILINE)
    block = next(block for block in blocks if "import phasestack" in block)
    lines = [line.removeprefix("    ") for line in block.splitlines()]
    return "\n".join(line for line in lines if not line.startswith("result.show()"))


@pytest.mark.slow
@pytest.mark.parametrize("page", SHOWN)
def test_the_python_that_a_page_shows_runs(page: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", python_of(page)], cwd=tmp_path, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert re.search(SHOWN[page], done.stdout), done.stdout


@pytest.mark.slow
def test_the_site_builds_without_warnings_with_every_page_and_the_api(tmp_path: Path) -> None:
    pytest.importorskip("furo")
    build = "-m sphinx -q -W --keep-going -b html -c docs/site ."
    command = [sys.executable, *build.split(), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1800)
    assert done.returncode == 0, done.stderr
    for page in PAGES:
        assert (tmp_path / page.relative_to(ROOT)).with_suffix(".html").exists(), page
    api = (tmp_path / "docs" / "api.html").read_text(encoding="utf-8")
    assert "phasestack.solve" in api and "phasestack.Stack" in api
    html = (tmp_path / "docs" / "performance.html").read_text(encoding="utf-8")
    sources = [name for name in re.findall(r'<img[^>]* src="([^"]+)"', html) if re.search(PICTURES, name)]
    assert sources and all((tmp_path / "docs" / name).exists() for name in sources)
