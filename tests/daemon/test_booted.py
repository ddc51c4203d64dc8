"""Tests an installed display PC, booted in a container (systemd-nspawn) with a fresh Debian.

Its tests are one story, in their order; ten minutes on two cores. BOOTED=/some/folder keeps its root for another run.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from tests.daemon.test_units import ROOT
from tests.panels.xserver import CONFIG as DUMMY_SCREENS
from tests.waiting import eventually

NEEDED = ("debootstrap", "systemd-nspawn", "nsenter")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(
        os.getuid() != 0 or any(shutil.which(name) is None for name in NEEDED),
        reason=f"needs root and {', '.join(NEEDED)}",
    ),
]
PACKAGES = "systemd,systemd-sysv,dbus,udev,ca-certificates,libpam-systemd,procps,sudo"
CONFIG = """
[stack]
width_px = 320
height_px = 180
[sensor]
driver = "replay"
source = "demo"
loop = true
[output]
kind = "windows"
[[output.panels]]
connector = "DUMMY0"
[[output.panels]]
connector = "DUMMY1"
[[output.panels]]
connector = "DUMMY2"
"""
PLUG = """#!/bin/sh
export DISPLAY=:7 XAUTHORITY=/run/phasestack-x/authority
for _ in $(seq 50); do xrandr >/dev/null 2>&1 && break; sleep 0.2; done
xrandr --newmode 320x180p 6.0 320 336 368 400 180 183 188 250
for o in 0 1 2; do
  xrandr --addmode DUMMY$o 320x180p
  xrandr --output DUMMY$o --mode 320x180p --pos $((320 * o))x0
  xrandr --query >/dev/null
done
"""
QUOTAS = Path("/sys/fs/cgroup/cpu")
UP = ("multi-user.target", "phasestack", "phasestack-page")


def debian(root: Path, packages: str) -> None:
    """A fresh Debian 12 with these packages, and this machine's ways to package registries."""
    command = ["debootstrap", "--variant=minbase", f"--include={packages}", "bookworm", root]
    subprocess.run(command, check=True, capture_output=True, timeout=1200)
    for path in ("/etc/pip.conf", "/etc/ssl/certs/ca-certificates.crt", "/etc/resolv.conf"):
        if Path(path).exists():
            shutil.copy(path, root / path[1:])


class Pc:
    """The container, with its files under `root`."""

    def __init__(self, folder: Path) -> None:
        self.root, self._console = folder / "root", folder / "console.log"
        self._container: subprocess.Popen[bytes] | None = None
        self._leader = 0
        if not (self.root / "etc/debian_version").exists():
            debian(self.root, PACKAGES)
        self.write("etc/hosts", "127.0.0.1 localhost displaypc\n")
        shutil.rmtree(self.root / "etc/systemd/system/phasestack-x.service.d", ignore_errors=True)  # an earlier run's
        source = self.root / "root/phasestack"
        shutil.rmtree(source, ignore_errors=True)
        subprocess.run(["git", "clone", "-q", ROOT, source], check=True)

    def write(self, path: str, text: str, *, mode: int = 0o644) -> None:
        file = self.root / path
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
        file.chmod(mode)

    def boot(self) -> None:
        # No registering: the host has no systemd; cgroup2 also where it has both. tty7 is phasestack-x's. No private
        # network: apt and pip go through the host.
        command = ["systemd-nspawn", "--boot", "--register=no", "--keep-unit", "-M", "displaypc", "--resolv-conf=off",
                   "--bind=/dev/tty0", "--bind=/dev/tty7", "-D", self.root]  # fmt: skip
        with self._console.open("wb") as console:
            self._container = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=console, stderr=console, start_new_session=True,
                env={**os.environ, "SYSTEMD_NSPAWN_UNIFIED_HIERARCHY": "1"},
            )  # fmt: skip
        assert eventually(self._has_leader)
        assert eventually(lambda: self.run("systemctl list-units").returncode == 0)

    def _has_leader(self) -> bool:
        """The container's first process, if it exists yet; nspawn starts others before it."""
        assert self._container is not None
        children = Path(f"/proc/{self._container.pid}/task/{self._container.pid}/children").read_text().split()
        for child in children:
            with suppress(OSError):  # it has gone
                if Path(f"/proc/{child}/comm").read_text() == "systemd\n":
                    self._leader = int(child)
                    return True
        return False

    def cut(self) -> None:
        """The power is gone."""
        if self._container is not None and self._container.poll() is None:
            if self._leader:
                os.kill(self._leader, 9)
            self._container.wait(60)

    def reboot(self) -> None:
        assert self._container is not None
        self.run("systemctl poweroff")
        self._container.wait(90)
        self._leader = 0
        self.boot()

    def run(self, command: str, *, timeout_s: float = 900.0, user: str = "") -> subprocess.CompletedProcess[str]:
        """A shell's command inside."""
        become = ["runuser", "-u", user, "--"] if user else []
        return subprocess.run(
            ["nsenter", "-t", str(self._leader), "-m", "-u", "-i", "-n", "-p", "-C", "--", "env", "-i",
             "PATH=/usr/sbin:/usr/bin:/sbin:/bin", "HOME=/root", "LANG=C.UTF-8", "TERM=dumb",
             "DEBIAN_FRONTEND=noninteractive", *become, "sh", "-c", command],
            check=False, capture_output=True, text=True, timeout=timeout_s, errors="replace",
        )  # fmt: skip

    def limit(self, pid: str, group: Path) -> None:
        """Put a process inside into a control group of the host's."""
        put = f"echo {pid} > {group}/cgroup.procs"
        subprocess.run(["nsenter", "-t", str(self._leader), "-p", "sh", "-c", put], check=True)

    def done(self, command: str) -> str:
        result = self.run(command)
        assert result.returncode == 0, (command, result.stdout[-2000:], result.stderr[-2000:])
        return result.stdout.strip()

    def prop(self, name: str, unit: str = "phasestack") -> str:
        return self.done(f"systemctl show -p {name} --value {unit}")

    def is_active(self, *units: str) -> bool:
        return all(self.prop("ActiveState", unit) == "active" for unit in units)

    def shows(self) -> bool:
        """Return True once the daemon shows a picture on the panels."""
        told = self.run("phasestack status --json", timeout_s=30).stdout
        return json.loads(told or "{}").get("state") in ("tracking", "holding", "flat")

    def comes_back(self, unlike: str) -> bool:
        return eventually(
            lambda: self.prop("MainPID") not in ("0", unlike) and self.is_active("phasestack") and self.shows(),
            within_s=150,
        )


@pytest.fixture(scope="module")
def pc(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pc]:
    kept = os.environ.get("BOOTED")
    made = Pc(Path(kept) if kept else tmp_path_factory.mktemp("pc"))
    try:
        made.boot()
        yield made
    finally:
        made.cut()
    if not kept:
        subprocess.run(["rm", "-rf", "--one-file-system", made.root], check=False)


def test_it_is_installed_by_the_book(pc: Pc) -> None:
    book = re.search(r"apt-get install (make.*?)\n\n", (ROOT / "docs/install.md").read_text(), re.DOTALL)
    pc.done(f"apt-get update -qq; apt-get install -y -qq {book[1]}".replace("\\\n", " "))
    done = pc.done("umask 077; cd /root/phasestack && make install")
    assert "phasestack is installed" in done


def test_without_an_x_server_it_boots_waits_and_answers(pc: Pc) -> None:
    pc.done("systemctl enable -q phasestack phasestack-page")
    pc.reboot()
    assert eventually(lambda: pc.is_active(*UP), within_s=60)
    status = pc.done("phasestack status")
    assert "waiting for a panel: no X server" in status
    time.sleep(60)
    assert int(pc.prop("NRestarts", "phasestack-x")) >= 4
    assert pc.prop("ActiveState", "phasestack-x") != "failed"
    assert pc.prop("NRestarts") == "0"
    assert int(pc.done("journalctl -b -u phasestack -o cat | grep -c 'waiting for a panel'")) == 1


def test_an_empty_configuration_is_no_display_and_status_advises_correctly(pc: Pc) -> None:
    pc.done("apt-get install -y -qq xserver-xorg-video-dummy x11-xserver-utils x11-apps")
    server = re.search(r"^ExecStart=(.*)$", (ROOT / "systemd/phasestack-x.service").read_text(), re.MULTILINE)
    pc.write("etc/X11/dummy.conf", DUMMY_SCREENS)
    pc.write("usr/local/sbin/plug", PLUG, mode=0o755)
    pc.write("etc/systemd/system/phasestack-x.service.d/dummy.conf",
             f"[Service]\nExecStart=\nExecStart={server[1]} -config /etc/X11/dummy.conf\n"
             "ExecStartPost=/usr/local/sbin/plug\n")  # fmt: skip
    pc.done("systemctl daemon-reload; systemctl restart phasestack-x")
    assert eventually(lambda: pc.prop("ActiveState") == "failed")
    told = pc.run("phasestack status").stderr
    assert "does not select a monitor" in told and "exit status 2" in told
    advice = "sudo systemctl restart phasestack"
    assert told.strip().endswith(advice)
    pc.write("etc/phasestack/phasestack.toml", CONFIG)
    pc.done(advice)
    assert pc.is_active("phasestack")


def test_the_kiosk_shows_a_picture_and_identifies_its_panels(pc: Pc) -> None:
    assert eventually(pc.shows)
    as_daemon = "env DISPLAY=:7 XAUTHORITY=/run/phasestack-x/authority"
    pc.done(f"{as_daemon} xwd -root -silent -out /root/screen")
    assert len(set((pc.root / "root/screen").read_bytes()[10_000:])) > 100
    shown = pc.run(f"cd /; {as_daemon} timeout 15 phasestack identify </dev/null", user="phasestack").stdout
    assert re.findall(r"connector = \"(.*)\"", shown) == ["DUMMY0", "DUMMY1", "DUMMY2"]
    doctor = pc.run("phasestack doctor --service")
    assert re.search(r"^ok +panels: panel 2 is DUMMY2", doctor.stdout, re.MULTILINE), doctor.stdout + doctor.stderr


def test_the_socket_is_the_group_s_and_the_journal_tells_the_truth(pc: Pc) -> None:
    pc.done("id tech 2>/dev/null || useradd -m -G phasestack tech; id other 2>/dev/null || useradd -m other")
    assert pc.run("phasestack status", user="tech").returncode == 0
    assert pc.run("phasestack ctl pause", user="other").returncode == 1
    assert "this user's alone" not in pc.done("journalctl -b -u phasestack -o cat")
    assert "phasestack.conf" not in pc.done("journalctl -b -t systemd-sysusers -o cat")
    pc.done("systemctl reload phasestack")
    with (pc.root / "etc/phasestack/phasestack.toml").open("a") as config:
        config.write("[broken")
    assert pc.run("systemctl reload phasestack").returncode != 0 and pc.is_active("phasestack")
    pc.write("etc/phasestack/phasestack.toml", CONFIG)


@pytest.mark.parametrize(
    "harm", ["kill -9 $(systemctl show -p MainPID --value phasestack)",
             "kill -STOP $(systemctl show -p MainPID --value phasestack)",
             "kill -9 $(systemctl show -p MainPID --value phasestack-x)",
             "for _ in $(seq 8); do systemctl restart phasestack; done;"
             " for _ in $(seq 6); do systemctl kill -s KILL phasestack; sleep 3; done"],
)  # fmt: skip
def test_it_comes_back(pc: Pc, harm: str) -> None:
    before = pc.prop("MainPID")
    pc.done(harm)
    assert pc.comes_back(unlike=before)


@pytest.mark.parametrize("after_s", [0.5, 1.5, 3.0, 4.0, 10.0])
def test_it_stops_within_two_seconds(pc: Pc, after_s: float) -> None:
    pc.done("systemctl stop phasestack")
    assert "is stopped; run: sudo systemctl start phasestack" in pc.run("phasestack status").stderr
    pc.done("systemctl start --no-block phasestack")
    time.sleep(after_s)
    begun_s = time.monotonic()
    pc.done("systemctl stop phasestack")
    took_s = time.monotonic() - begun_s
    assert pc.prop("Result") == "success"
    assert took_s < 2.5, took_s  # with the commands' own time


@pytest.mark.skipif(not QUOTAS.is_dir(), reason="needs the cpu controller of cgroups v1: nspawn hands down no other")
def test_at_a_twentieth_of_a_core_it_goes_on_showing(pc: Pc) -> None:
    group = QUOTAS / "phasestack-test"
    group.mkdir(exist_ok=True)
    (group / "cpu.cfs_quota_us").write_text("5000")  # of each 100,000
    pc.done("systemctl start --no-block phasestack")
    assert eventually(lambda: pc.prop("MainPID") != "0")
    pid = pc.prop("MainPID")
    pc.limit(pid, group)
    assert eventually(pc.shows, within_s=300)
    time.sleep(60)
    assert pc.prop("MainPID") == pid and pc.is_active(*UP)
    pc.done("systemctl stop phasestack")
    group.rmdir()


def test_an_upgrade_swaps_the_program_and_goes_back_if_it_cannot_start(pc: Pc) -> None:
    pc.done("systemctl start phasestack")
    before, program = pc.prop("MainPID"), pc.root / "root/phasestack/runtime/commands/run.py"
    told = "journalctl -b -u phasestack -o cat | grep -c 'the X server died\\|the run before was cut' || true"
    faults = pc.done(told)
    pc.done("cd /root/phasestack && make install")
    assert pc.comes_back(unlike=before)
    assert pc.done(told) == faults
    good = program.read_text()
    program.write_text(good + "\n\nraise RuntimeError('a bad release')\n")
    failed = pc.run("cd /root/phasestack && make install")
    program.write_text(good)
    assert failed.returncode != 0 and "restoring the previous version" in failed.stderr
    assert eventually(lambda: pc.is_active("phasestack") and pc.shows(), within_s=90)
    assert not list((pc.root / "opt/phasestack").glob("lib.*"))


def test_reboot_power_cut_full_disk_and_missing_panel_block_nobody(pc: Pc) -> None:
    pc.reboot()
    assert eventually(lambda: pc.is_active(*UP) and pc.shows(), within_s=120)
    owner = pc.done("id -u phasestack")
    pc.write("etc/systemd/system/var-lib-phasestack.mount", small_disk(owner))
    pc.done("systemctl enable var-lib-phasestack.mount; sync")
    pc.cut()
    pc.boot()
    assert eventually(lambda: pc.is_active("var-lib-phasestack.mount"))
    assert eventually(lambda: pc.is_active(*UP) and pc.shows(), within_s=150)
    assert pc.run("head -c 32M /dev/zero > /var/lib/phasestack/full").returncode != 0
    before = pc.prop("MainPID")
    pc.done("systemctl restart phasestack phasestack-page")
    assert pc.comes_back(unlike=before) and pc.prop("NRestarts") == "0" and pc.is_active(*UP)
    pc.done("systemctl disable var-lib-phasestack.mount")
    pc.done("rm /etc/systemd/system/var-*.mount")
    pc.write("etc/phasestack/phasestack.toml", CONFIG.replace("DUMMY2", "HDMI-9"))
    pc.reboot()
    assert eventually(lambda: pc.is_active(*UP), within_s=60)
    assert "HDMI-9" in pc.done("phasestack status")


def small_disk(owner: str) -> str:
    return (
        f"[Mount]\nWhat=tmpfs\nType=tmpfs\nWhere=/var/lib/phasestack\nOptions=size=16M,uid={owner}\n"
        "[Install]\nWantedBy=local-fs.target\n"
    )


def test_it_is_uninstalled_twice_and_says_what_it_leaves(pc: Pc) -> None:
    assert "kept /etc/phasestack" in pc.done("cd /root/phasestack && make uninstall")
    pc.done("systemctl stop systemd-udevd systemd-udevd-control.socket systemd-udevd-kernel.socket")
    assert "kept the user and group" in pc.done("cd /root/phasestack && PURGE=yes make uninstall")
    assert pc.run("systemctl is-active phasestack phasestack-page phasestack-x").stdout.count("active\n") == 3
    left = pc.done("find /etc /usr /opt /run /var/lib -xdev -name '*phasestack*' -not -path '*.service.d*'")
    assert left == ""
