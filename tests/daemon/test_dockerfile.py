"""The Dockerfile, as far as it can be judged without an engine: its rules, its sources and its packages."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

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


def test_it_is_built_in_one_stage_and_run_in_another() -> None:
    assert [value.split(" AS ")[1] for value in of("FROM")] == ["build", "runtime"]
    after = instructions()[[key for key, _ in instructions()].index("FROM") :]
    last_stage = after[[i for i, (key, _) in enumerate(after) if key == "FROM"][-1] :]
    assert not any("pip install" in value for key, value in last_stage if key == "RUN")


def test_it_does_not_run_as_root() -> None:
    users = of("USER")
    assert users and users[-1] not in ("root", "0")
    assert f"useradd --system --uid 990 --gid {users[-1]}" in " ".join(of("RUN"))


def test_it_is_started_without_a_shell_and_is_asked_for_its_health() -> None:
    assert json.loads(of("ENTRYPOINT")[-1]) == ["phasestack"]
    assert json.loads(of("CMD")[-1]) == ["demo"]
    health = of("HEALTHCHECK")[-1]
    assert json.loads(health[health.index("CMD") + 4 :]) == ["phasestack", "status"]


def test_dependencies_come_from_the_lock_alone() -> None:
    installs = [command for value in of("RUN") for command in value.split("&&") if "pip install" in command]
    assert installs
    for command in installs:
        assert "-r requirements/runtime.lock" in command or "--no-deps" in command
        assert "--no-cache-dir" in command


def test_what_is_copied_is_there() -> None:
    for value in of("COPY"):
        if not value.startswith("--from="):
            for source in value.split()[:-1]:
                assert (ROOT / source).exists(), source


def apt_packages() -> list[str]:
    (command,) = [part for value in of("RUN") for part in value.split("&&") if "apt-get install" in part]
    assert "--no-install-recommends" in command
    return [word for word in command.split()[2:] if not word.startswith("-")]


def test_package_lists_do_not_stay_in_the_image() -> None:
    (run,) = [value for value in of("RUN") if "apt-get" in value]
    assert run.index("apt-get update") < run.index("apt-get install") < run.index("rm -rf /var/lib/apt/lists/*")


@pytest.mark.skipif(shutil.which("apt-cache") is None, reason="no apt here")
def test_every_package_exists() -> None:
    known = subprocess.run(["apt-cache", "policy", *apt_packages()], capture_output=True, text=True, timeout=60)
    if not known.stdout:
        pytest.skip("apt has no lists here")
    assert {line[:-1] for line in known.stdout.splitlines() if not line.startswith(" ")} == set(apt_packages())


def test_what_opens_without_a_screen_is_installed() -> None:
    from runtime.support.gl import DEBIAN_PACKAGES

    assert set(DEBIAN_PACKAGES.split()) <= set(apt_packages())
