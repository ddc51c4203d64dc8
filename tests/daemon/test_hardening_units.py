"""Units, installer, image and locks: bounded, silent about viewers, no other file than the one that was meant."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "systemd"
LOCKS = ROOT / "requirements"
DAEMONS = ("phasestack.service", "phasestack-user.service")


def keys(unit: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in (UNITS / unit).read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


@pytest.mark.parametrize("unit", DAEMONS)
def test_what_the_daemon_may_take_of_the_machine_is_bounded(unit: str) -> None:
    found = keys(unit)
    assert 0 < int(found["MemoryMax"][0].removesuffix("%")) < 100
    assert 64 <= int(found["TasksMax"][0]) <= 4096
    assert int(found["CPUWeight"][0]) > 100  # the default: the picture goes first


def test_the_presenters_thread_may_take_the_niceness_that_it_wants() -> None:
    from runtime.support.priority import PRESENTER_NICENESS

    assert int(keys("phasestack.service")["LimitNICE"][0]) <= PRESENTER_NICENESS


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")
@pytest.mark.parametrize("unit", DAEMONS)
def test_systemd_knows_every_key_and_value(unit: str, tmp_path: Path) -> None:
    text = re.sub(r"^(Exec\w+=)\S+", rf"\g<1>{shutil.which('true')}", (UNITS / unit).read_text(), flags=re.MULTILINE)
    (tmp_path / "phasestack-x.service").write_text("[Service]\nExecStart=/bin/true\n")
    copy = tmp_path / "phasestack.service"
    copy.write_text(text)
    command = ["systemd-analyze", *(["--user"] if "user" in unit else []), "verify", "--man=no", str(copy)]
    done = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}, check=False
    )
    assert (done.returncode, done.stderr.strip()) == (0, "")


def test_units_image_and_launcher_switch_the_networks_telemetry_off(tmp_path: Path) -> None:
    for unit in DAEMONS:
        assert "ORT_DISABLE_TELEMETRY=1" in keys(unit)["Environment"]
    assert re.search(r"^ENV [^#]*ORT_DISABLE_TELEMETRY=1", (ROOT / "Dockerfile").read_text(), re.MULTILINE | re.DOTALL)
    assert installed(tmp_path).returncode == 0
    assert "ORT_DISABLE_TELEMETRY=1" in (tmp_path / "usr/bin/phasestack").read_text()


def test_the_installed_onnxruntime_knows_that_switch() -> None:
    """A name that it does not look for would switch nothing off."""
    import importlib.util

    spec = importlib.util.find_spec("onnxruntime")
    library = next((Path(spec.origin).parent / "capi").glob("onnxruntime_pybind11_state*.so"))
    assert b"ORT_DISABLE_TELEMETRY" in library.read_bytes()


def installed(root: Path, *arguments: str, mask: int = 0o022, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", str(UNITS / "install.sh"), *arguments],
        env={**os.environ, "DESTDIR": str(root), "APP": "no", **environment},
        capture_output=True,
        text=True,
        umask=mask,
        check=False,
    )


@pytest.mark.parametrize("script", ["install.sh", "uninstall.sh"])
@pytest.mark.parametrize("flag", ["--help", "-h"])
def test_help_is_help_and_touches_nothing(tmp_path: Path, script: str, flag: str) -> None:
    (tmp_path / "opt/phasestack").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    done = subprocess.run(
        ["sh", str(UNITS / script), flag],
        env={**os.environ, "DESTDIR": str(tmp_path), "APP": "no"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0
    assert "DESTDIR" in done.stdout and "Example:" in done.stdout
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("script", ["install.sh", "uninstall.sh"])
def test_an_argument_that_nobody_knows_is_refused_and_nothing_is_touched(tmp_path: Path, script: str) -> None:
    done = subprocess.run(
        ["sh", str(UNITS / script), "--hlep"],
        env={**os.environ, "DESTDIR": str(tmp_path), "APP": "no"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert "--hlep" in done.stderr
    assert list(tmp_path.iterdir()) == []


def others_may_read(path: Path) -> bool:
    mode = path.stat().st_mode
    return bool(mode & stat.S_IROTH) and (not path.is_dir() or bool(mode & stat.S_IXOTH))


def test_under_a_narrow_mask_the_services_user_can_read_what_is_installed(tmp_path: Path) -> None:
    root = tmp_path / "tree"
    root.mkdir(mode=0o755)
    done = installed(root, mask=0o077)
    assert done.returncode == 0, done.stderr
    assert [path for path in root.rglob("*") if not others_may_read(path)] == []


@pytest.mark.slow
def test_the_library_too_also_where_an_earlier_one_was_roots_alone(tmp_path: Path) -> None:
    """The whole program, from the lock with its hashes: minutes."""
    root = tmp_path / "tree"
    (root / "opt/phasestack").mkdir(parents=True)
    (root / "opt/phasestack").chmod(0o700)
    root.chmod(0o755)
    done = installed(root, mask=0o077, APP="yes")
    assert done.returncode == 0, done.stderr
    assert [path for path in root.rglob("*") if not others_may_read(path)] == []


# The locks


def packages(lock: str) -> dict[str, tuple[str, list[str]]]:
    """Name to version and hashes."""
    text = "\n".join(line for line in (LOCKS / lock).read_text().splitlines() if not line.startswith("#"))
    found = {}
    for entry in re.split(r"\n(?=\S)", text.replace("\\\n", " ")):
        name, _, rest = entry.strip().partition("==")
        if name:
            version, *options = rest.split()
            found[name.lower().replace("_", "-")] = (version, options)
    return found


@pytest.mark.parametrize(
    ("lock", "least"), [("runtime.lock", 40), ("page.lock", 6), ("test.lock", 40), ("mutation.lock", 15)]
)
def test_every_pin_has_the_hashes_of_its_files(lock: str, least: int) -> None:
    found = packages(lock)
    assert len(found) > least
    for name, (version, options) in found.items():
        assert re.fullmatch(r"[0-9][0-9A-Za-z.]*", version), name
        assert options and all(re.fullmatch(r"--hash=sha256:[0-9a-f]{64}", option) for option in options), name
        assert len(set(options)) == len(options)


def test_all_locks_mean_the_same_files() -> None:
    runtime, test = packages("runtime.lock") | packages("page.lock"), packages("test.lock")
    assert {name: test.get(name) for name in runtime} == runtime
    mutation = packages("mutation.lock")
    assert {name: test[name] for name in mutation if name in test} == {n: mutation[n] for n in mutation if n in test}


def test_torch_alone_is_left_out_and_the_lock_says_why() -> None:
    assert "torch" not in packages("test.lock")
    text = (LOCKS / "torch.lock").read_text()
    assert text.startswith("#") and "hash" in text
    (pin,) = [line for line in text.splitlines() if not line.startswith("#")]
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert pin in extras["export"]


def test_everything_that_is_declared_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    test = packages("test.lock") | {"torch": ("2.13.0", [])}
    for requirement in (
        *project["dependencies"],
        *(one for all_ in project["optional-dependencies"].values() for one in all_),
    ):
        name = re.match(r"[A-Za-z0-9._-]+", requirement)[0].lower().replace("_", "-")
        if name != "phasestack":
            assert name in test, requirement


def test_a_file_that_is_not_the_one_that_was_meant_is_refused(tmp_path: Path) -> None:
    """The lock in use: a wheel of a right name and version whose bytes are others."""
    import sys
    import zipfile

    version = packages("runtime.lock")["mdurl"][0]
    wheel = tmp_path / f"mdurl-{version}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("mdurl.py", "print('not what was meant')\n")
        info = f"mdurl-{version}.dist-info"
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: mdurl\nVersion: {version}\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    lock = re.search(rf"^mdurl=={re.escape(version)}(?: \\\n.*)+", (LOCKS / "runtime.lock").read_text(), re.MULTILINE)[
        0
    ]
    (tmp_path / "one.lock").write_text(lock.replace("\\\n", " ").rstrip(" \\") + "\n")
    command = [sys.executable, "-m", "pip", "install", "--no-index", "--find-links", str(tmp_path), "--no-deps",
               "--target", str(tmp_path / "into"), "-r", str(tmp_path / "one.lock")]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode != 0
    assert "HASH" in done.stderr.upper()
    assert not (tmp_path / "into" / "mdurl.py").exists()
