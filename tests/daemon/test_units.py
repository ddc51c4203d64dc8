"""Tests units, rules, installer, image and locks with systemd's own tools."""

from __future__ import annotations

import os
import re
import shutil
import stat
import subprocess
import tempfile
import tomllib
from pathlib import Path

import pytest

from runtime.config import ServiceSettings, load_settings
from runtime.daemon.socket_file import GROUP
from runtime.sensor.usb_devices import KNOWN_DEVICES
from runtime.support.gl import DEBIAN_PACKAGES
from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
UNITS = ROOT / "systemd"
SYSTEM = ("phasestack.service", "phasestack-x.service", "phasestack-page.service")
EXPOSURE_MAX = {"phasestack.service": 1.8, "phasestack-x.service": 7.0, "phasestack-page.service": 1.2}

LOCKS = ROOT / "requirements"

with_systemd = pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze here")


def run(*command: str, mask: int = -1, **environment: str) -> subprocess.CompletedProcess[str]:
    surroundings = {**os.environ, **environment}
    return subprocess.run(
        command, capture_output=True, text=True, timeout=900, env=surroundings, umask=mask, check=False
    )


def with_programs_that_exist(unit: str, folder: Path) -> Path:
    """The unit as it would be where everything is installed: only the paths of its programs are others."""
    text = re.sub(r"^(Exec\w+=)\S+", rf"\g<1>{shutil.which('true')}", (UNITS / unit).read_text(), flags=re.MULTILINE)
    copy = folder / unit.replace("-user", "")
    copy.write_text(text)
    return copy


@with_systemd
@pytest.mark.parametrize("unit", SYSTEM)
def test_systemd_finds_nothing_wrong_with_the_system_units(unit: str, tmp_path: Path) -> None:
    for each in SYSTEM:
        with_programs_that_exist(each, tmp_path)
    result = run("systemd-analyze", "verify", "--man=no", str(tmp_path / unit))
    # An unknown key is only a warning, with exit 0.
    assert (result.returncode, result.stderr.strip()) == (0, "")


@with_systemd
def test_systemd_finds_nothing_wrong_with_the_user_unit(tmp_path: Path) -> None:
    copy = with_programs_that_exist("phasestack-user.service", tmp_path)
    result = run("systemd-analyze", "--user", "verify", "--man=no", str(copy), XDG_RUNTIME_DIR=str(tmp_path))
    assert (result.returncode, result.stderr.strip()) == (0, "")


@with_systemd
@pytest.mark.parametrize("unit", SYSTEM)
def test_exposure_stays_low(unit: str) -> None:
    threshold = f"--threshold={round(EXPOSURE_MAX[unit] * 10)}"
    result = run("systemd-analyze", "security", "--offline=yes", threshold, str(UNITS / unit))
    assert result.returncode == 0, result.stdout.splitlines()[-1]


def keys(unit: str) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in (UNITS / unit).read_text().splitlines():
        if "=" in line and not line.startswith("#"):
            key, _, value = line.partition("=")
            found.setdefault(key, []).append(value)
    return found


@pytest.mark.parametrize("unit", ["phasestack.service", "phasestack-user.service"])
def test_the_daemon_is_watched_bounded_and_restarted_with_limits(unit: str) -> None:
    unit_keys = keys(unit)
    assert unit_keys["Type"] == ["notify"]
    assert unit_keys["Restart"] == ["on-failure"]
    assert unit_keys["RestartPreventExitStatus"] == ["2"]
    assert int(unit_keys["WatchdogSec"][0]) > 0
    assert unit_keys["StartLimitIntervalSec"] == ["0"]  # never given up
    assert 0 < int(unit_keys["MemoryMax"][0].removesuffix("%")) < 100
    assert 64 <= int(unit_keys["TasksMax"][0]) <= 4096
    assert int(unit_keys["CPUWeight"][0]) > 100  # the default: the picture goes first


@pytest.mark.skipif(os.getuid() != 0, reason="only root writes in /run")
def test_repeated_failures_delay_the_next_start_and_a_deliberate_stop_does_not(tmp_path: Path) -> None:
    sleep = tmp_path / "sleep"
    sleep.write_text("#!/bin/sh\necho $1\n")
    sleep.chmod(0o755)
    path = f"{tmp_path}:{os.environ['PATH']}"
    unit, waits = f"test-{tmp_path.name}-{os.getpid()}", []
    for result in [*["exit-code", "signal"] * 4, "success"]:
        assert run("sh", str(UNITS / "back-off"), unit, SERVICE_RESULT=result).returncode == 0
        waits.append(run("sh", str(UNITS / "back-off"), unit, PATH=path).stdout.strip())
    assert waits == ["1", "2", "4", "8", "16", "32", "32", "32", ""]
    failures = Path(f"/run/{unit}.failures")
    assert run("sh", str(UNITS / "back-off"), unit, SERVICE_RESULT="watchdog").returncode == 0
    os.utime(failures, (failures.stat().st_mtime - 180,) * 2)
    assert run("sh", str(UNITS / "back-off"), unit, PATH=path).stdout == ""  # it ran well for three minutes
    assert not failures.exists()


def test_the_socket_of_the_defaults_lies_in_the_units_runtime_folder() -> None:
    settings = ServiceSettings()
    unit_keys = keys("phasestack.service")
    assert Path(settings.socket).parent == Path("/run") / unit_keys["RuntimeDirectory"][0]
    assert unit_keys["Group"] == [GROUP]


def test_the_daemon_finds_the_kiosks_x_server() -> None:
    daemon, server = keys("phasestack.service"), keys("phasestack-x.service")
    environment = dict(entry.split("=", 1) for entry in daemon["Environment"])
    assert f" {environment['DISPLAY']} " in server["ExecStart"][0]
    assert environment["XAUTHORITY"] in server["ExecStart"][0]
    assert environment["XAUTHORITY"] in server["ExecStartPre"][-1]


def test_the_udev_rules_are_those_of_the_known_devices() -> None:
    rule = (
        'ATTR{{idVendor}}=="{:04x}", ATTR{{idProduct}}=="{:04x}", MODE="0660", GROUP="plugdev", TAG+="uaccess", '
        'TEST=="power/control", ATTR{{power/control}}="on"'
    )
    lines = (UNITS / "70-phasestack-sensors.rules").read_text().splitlines()
    wanted = [rule.format(device.vendor_id, device.product_id) for device in KNOWN_DEVICES]
    assert [line for line in lines if "idVendor" in line] == wanted


def test_the_installed_configuration_is_valid() -> None:
    load_settings(UNITS / "phasestack.toml")


@with_systemd
def test_sysusers_and_tmpfiles_make_the_user_and_its_folders(tmp_path: Path) -> None:
    if os.getuid() != 0:
        pytest.skip("only root can give folders away")
    install(tmp_path)
    assert run("systemd-sysusers", f"--root={tmp_path}").returncode == 0
    groups = (tmp_path / "etc" / "group").read_text()
    unit_keys = keys("phasestack.service")
    for group in (*unit_keys["SupplementaryGroups"][0].split(), *unit_keys["Group"]):
        assert re.search(rf"^{group}:", groups, re.MULTILINE)
    assert run("systemd-tmpfiles", f"--root={tmp_path}", "--create", "phasestack.conf").returncode == 0
    assert stat.S_IMODE((tmp_path / "var/lib/phasestack").stat().st_mode) == 0o750


def install(root: Path, *, mask: int = -1, **environment: str) -> subprocess.CompletedProcess[str]:
    return run("sh", str(UNITS / "install.sh"), mask=mask, **({"DESTDIR": str(root), "APP": "no"} | environment))


def files(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


def test_the_installer_writes_below_destdir_and_the_uninstaller_takes_it_away(tmp_path: Path) -> None:
    result = install(tmp_path)
    assert result.returncode == 0, result.stderr
    installed = files(tmp_path)
    assert {
        "usr/bin/phasestack",
        "usr/lib/systemd/system/phasestack.service",
        "usr/lib/systemd/system/phasestack-x.service",
        "usr/lib/systemd/system/phasestack-page.service",
        "usr/lib/systemd/user/phasestack.service",
        "usr/lib/sysusers.d/phasestack.conf",
        "usr/lib/tmpfiles.d/phasestack.conf",
        "usr/lib/udev/rules.d/70-phasestack-sensors.rules",
        "usr/lib/phasestack/x-authority",
        "etc/phasestack/phasestack.toml",
    } <= installed
    assert not any(str(tmp_path).encode() in (tmp_path / name).read_bytes() for name in installed)
    assert run("sh", str(UNITS / "uninstall.sh"), DESTDIR=str(tmp_path)).returncode == 0
    assert files(tmp_path) == {"etc/phasestack/phasestack.toml"}
    assert run("sh", str(UNITS / "uninstall.sh"), DESTDIR=str(tmp_path), PURGE="yes").returncode == 0
    assert files(tmp_path) == set()


def test_installing_again_keeps_the_operators_configuration(tmp_path: Path) -> None:
    install(tmp_path)
    mine = tmp_path / "etc/phasestack/phasestack.toml"
    mine.write_text("# mine\n")
    install(tmp_path)
    assert mine.read_text() == "# mine\n"


def test_the_installer_refuses_an_old_or_missing_python(tmp_path: Path) -> None:
    result = install(tmp_path, PYTHON="no-such-python")
    assert result.returncode == 2
    assert "no-such-python" in result.stderr


@pytest.mark.skipif(shutil.which("Xvfb") is None or os.getuid() != 0, reason="needs Xvfb, and root to be another user")
def test_an_x_authority_admits_the_daemon_s_user_and_nobody_else() -> None:
    """65534 (nobody): in the group or not, as the daemon's user is to root, who makes the file and runs the server."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        file, number, cookies = Path(folder) / "authority", 99 + os.getpid() % 1000, []
        for _ in range(2):
            done = subprocess.run(["sh", str(UNITS / "x-authority"), str(file), f":{number}"], check=False, group=65534)
            assert done.returncode == 0
            cookies.append(file.read_bytes()[-16:])
        assert cookies[0] != cookies[1]
        assert stat.S_IMODE(file.stat().st_mode) == 0o640
        server = subprocess.Popen(["Xvfb", f":{number}", "-auth", str(file)], stderr=subprocess.DEVNULL)
        try:

            def let_in(group: int) -> bool:
                return subprocess.run(
                    ["xrandr"], env={"DISPLAY": f":{number}", "XAUTHORITY": str(file), "PATH": os.environ["PATH"]},
                    check=False, capture_output=True, user=65534, group=group, extra_groups=[], timeout=60,
                ).returncode == 0  # fmt: skip

            assert eventually(lambda: let_in(65534))
            assert not let_in(12345)
        finally:
            server.kill()
            server.wait()


@pytest.mark.parametrize("script", ["install.sh", "uninstall.sh"])
def test_an_argument_that_nobody_knows_is_refused_and_nothing_is_touched(tmp_path: Path, script: str) -> None:
    done = run("sh", str(UNITS / script), "--hlep", DESTDIR=str(tmp_path), APP="no")
    assert done.returncode == 2
    assert "--hlep" in done.stderr
    assert list(tmp_path.iterdir()) == []


def others_may_read(path: Path) -> bool:
    mode = path.stat().st_mode
    return bool(mode & stat.S_IROTH) and (not path.is_dir() or bool(mode & stat.S_IXOTH))


def test_under_a_narrow_mask_the_services_user_can_read_what_is_installed(tmp_path: Path) -> None:
    root = tmp_path / "tree"
    root.mkdir(mode=0o755)
    done = install(root, mask=0o077)
    assert done.returncode == 0, done.stderr
    assert [path for path in root.rglob("*") if not others_may_read(path)] == []


def test_the_image_has_a_pinned_base_opengl_and_its_own_user() -> None:
    text = (ROOT / "Dockerfile").read_text().replace("\\\n", " ")
    bases = dict(re.findall(r"^ARG (\w+)=(\S+)", text, re.MULTILINE))
    for image in re.findall(r"^FROM (\S+)", text, re.MULTILINE):
        named = re.sub(r"\$\{(\w+)\}", lambda name: bases[name[1]], image)
        assert re.search(r":\d+\.\d+\.\d+-[\w-]+@sha256:[0-9a-f]{64}$", named), named
    last_stage = text[text.rindex("\nFROM ") :]
    installed = re.findall(r"apt-get install ([^&\n]*)", last_stage)
    assert set(DEBIAN_PACKAGES.split()) <= set(" ".join(installed).split())
    user = re.findall(r"^USER (\S+)", last_stage, re.MULTILINE)[-1]
    assert user not in ("root", "0") and f"useradd --system --uid 990 --gid {user}" in last_stage


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


def test_all_locks_mean_the_same_files() -> None:
    runtime, test = packages("runtime.lock"), packages("test.lock")
    assert {name: test.get(name) for name in runtime} == runtime


def test_everything_that_is_declared_is_locked() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    test = packages("test.lock") | packages("docs.lock") | {"torch": ("2.13.0", [])}
    for requirement in (
        *project["dependencies"],
        *(one for all_ in project["optional-dependencies"].values() for one in all_),
    ):
        name = re.match(r"[A-Za-z0-9._-]+", requirement)[0].lower().replace("_", "-")
        if name not in ("phasestack", "vtk", "pylsl"):  # vtk: 100 MB; pylsl announces itself to the network
            assert name in test, requirement
