"""The Dockerfile, as far as it can be judged without an engine: its rules, its sources and its packages."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def instructions() -> list[tuple[str, str]]:
    text = (ROOT / "Dockerfile").read_text()
    lines = "\n".join(line for line in text.splitlines() if not line.startswith("#"))
    joined = lines.replace("\\\n", " ").splitlines()
    return [(line.split(None, 1)[0], " ".join(line.split(None, 1)[1].split())) for line in joined if line.strip()]


def of(name: str) -> list[str]:
    return [value for key, value in instructions() if key == name]


def test_every_base_is_pinned() -> None:
    bases = dict(value.split("=", 1) for value in of("ARG"))
    for value in of("FROM"):
        image = re.sub(r"\$\{(\w+)\}", lambda match: bases[match[1]], value.split(" AS ")[0])
        assert re.search(r":\d+\.\d+\.\d+-[\w-]+@sha256:[0-9a-f]{64}$", image), image


def test_it_does_not_run_as_root() -> None:
    users = of("USER")
    assert users and users[-1] not in ("root", "0")
    assert f"useradd --system --uid 990 --gid {users[-1]}" in " ".join(of("RUN"))


def apt_packages() -> list[str]:
    """The final image's."""
    *_, command = [part for value in of("RUN") for part in value.split("&&") if "apt-get install" in part]
    assert "--no-install-recommends" in command
    return [word for word in command.split()[2:] if not word.startswith("-")]


def test_what_opens_without_a_screen_is_installed() -> None:
    from runtime.support.gl import DEBIAN_PACKAGES

    assert set(DEBIAN_PACKAGES.split()) <= set(apt_packages())
