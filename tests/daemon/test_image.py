"""Tests the image that buildah builds from the Dockerfile.

Its base is not the Dockerfile's, which a registry has: Debian 12 with its Python 3.11, by debootstrap.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.daemon.test_booted import debian
from tests.daemon.test_units import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(
        os.getuid() != 0 or shutil.which("buildah") is None or shutil.which("debootstrap") is None,
        reason="needs root, buildah and debootstrap",
    ),
]
BASE_PACKAGES = "python3,python3-venv,python3-pip,python-is-python3,ca-certificates"
BASE, IMAGE = "localhost/debian-python", "localhost/phasestack"
Buildah = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture(scope="module")
def buildah(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Buildah]:
    """buildah with separate storage that holds the image."""
    folder = tmp_path_factory.mktemp("image")

    def run(*arguments: str | Path, check: bool = True) -> subprocess.CompletedProcess[str]:
        storage = ["--storage-driver=vfs", f"--root={folder}/storage", f"--runroot={folder}/run"]
        done = subprocess.run(
            ["buildah", *storage, *arguments], capture_output=True, text=True, timeout=3000, check=False
        )
        assert not check or done.returncode == 0, (arguments, done.stdout[-2000:], done.stderr[-2000:])
        return done

    debian(folder / "base", BASE_PACKAGES)
    scratch = run("from", "scratch").stdout.strip()
    run("copy", "--quiet", scratch, folder / "base", "/")
    run("commit", "--quiet", "--rm", scratch, BASE)
    subprocess.run(["git", "clone", "-q", ROOT, folder / "source"], check=True)
    run("build", "--isolation=chroot", "--build-arg", f"BASE={BASE}", "--tag", IMAGE, folder / "source")
    yield run
    run("rmi", "--all", "--force", check=False)
    shutil.rmtree(folder, ignore_errors=True)


def test_the_image_s_command_page_and_doctor_run_as_its_user(buildah: Buildah) -> None:
    config = json.loads(buildah("inspect", "--type", "image", IMAGE).stdout)["OCIv1"]["config"]
    assert config["User"] == "phasestack"
    container = buildah("from", IMAGE).stdout.strip()

    def inside(*command: str, check: bool = True) -> str:
        done = buildah("run", "--isolation=chroot", container, "--", *command, check=check)
        return done.stdout + done.stderr

    shown = inside(*config["Entrypoint"], *config["Cmd"])
    assert re.search(r"^light_db +\d", shown, re.MULTILINE), shown[-1000:]
    assert re.search(r"^ok +model:", inside("phasestack", "doctor"), re.MULTILINE)
    fetch = "from urllib.request import urlopen as get; print(get('http://127.0.0.1:8791/').read().decode())"
    page = inside("sh", "-c", "phasestack page --port 8791 & for _ in $(seq 90); do sleep 1; "
                  f'python -c "{fetch}" 2>/dev/null && break; done; kill $!', check=False)  # fmt: skip
    assert "page: http://127.0.0.1:8791/" in page and "<title>phasestack</title>" in page, page
    buildah("rm", container)
