"""Tests that changes of scene, model or configuration load in the background and apply as a whole.

No change loses a refresh: the presenter keeps showing the existing solution.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from runtime.blackbox.recorder import Recorder
from runtime.clock import NS_PER_S, MonotonicClock
from runtime.config import Settings, load_settings
from runtime.content.placed import PlacedSource
from runtime.daemon import changes, reconfigure
from runtime.daemon import server as server_module
from runtime.daemon.client import ask
from runtime.daemon.notify import Notifier
from runtime.daemon.server import StatusServer
from runtime.daemon.signals import Signals
from runtime.daemon.supervise import Daemon
from runtime.support import progress
from runtime.support.logs import TextFormat
from tests.daemon.rig import SMALL, TRACKING, Rig

STEADY: dict[str, Any] = {"sensor": {"timeout_s": 5.0}, "tracker": {"hold_s": 20.0}}  # on a busy machine too


class Served:
    """A run with a listening daemon that answers requests while it refreshes."""

    def __init__(self, folder: Path, *, recorder: Any = None, **changes: Any) -> None:
        self.config = folder / "phasestack.toml"
        self.server = StatusServer(folder / "status.sock", clock=MonotonicClock())
        self.daemon = Daemon(
            self.read_settings,
            signals=Signals(),
            notifier=Notifier(MonotonicClock(), {}),
            server=self.server,
            recorder=recorder,
        )
        self.rig = Rig(host=self.daemon, **(STEADY | changes))

    def __enter__(self) -> Served:
        self.rig.__enter__()
        self.rig.refresh_until(TRACKING)
        self.rig.refresh_until_solved()
        return self

    def __exit__(self, *exception: object) -> None:
        self.rig.__exit__(*exception)
        self.server.close()

    @property
    def run(self) -> Any:
        return self.rig.run

    def read_settings(self) -> Settings:
        """The configuration file; if the test wrote none, the run's initial settings."""
        return load_settings(self.config) if self.config.exists() else self.rig.settings

    def status(self) -> dict[str, Any]:
        return ask([self.server.path], {"command": "status"})

    def asked(self, name: str, value: Any = None, *, meanwhile: Callable[[], None] = lambda: None) -> dict[str, Any]:
        """Answer to a command; refreshes continue until it arrives."""
        answers: list[dict[str, Any]] = []
        request = {"command": name, "value": value}
        asking = threading.Thread(target=lambda: answers.append(ask([self.server.path], request, timeout_s=30.0)))
        asking.start()
        while asking.is_alive():
            self.rig.presenter.refresh()
            meanwhile()
        return answers[0]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with Served(tmp_path) as made:
        yield made


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> Iterator[threading.Event]:
    """Content comes to be loaded when it is set."""
    real, opened = reconfigure.prepare_content, threading.Event()

    def prepare(settings: Any, stack: Any, **how: Any) -> Any:
        progress.tell(f"reading {settings.scene}", 1, 2)
        assert opened.wait(60.0)
        return real(settings, stack, **how)

    monkeypatch.setattr(reconfigure, "prepare_content", prepare)
    yield opened
    opened.set()


def test_the_present_scene_goes_on_while_another_is_loaded(served: Served, gate: threading.Event) -> None:
    told: list[tuple[str, str]] = []
    loading, before = ("demo", "reading sparse: 1 of 2"), len(served.rig.accounts)

    def meanwhile() -> None:
        if loading not in told:
            status = served.status()
            told.append((status["scene"], status.get("loading", "")))
        elif len(served.rig.accounts) > before + 50:  # none of these has waited for it
            gate.set()

    assert served.asked("scene", "sparse", meanwhile=meanwhile)["ok"]
    served.rig.refresh_until_solved()
    accounts = served.rig.accounts[before:]
    assert len(accounts) > 50
    assert all(account.presented and account.solution is not None for account in accounts)
    assert loading in told
    served.rig.refreshes(2)
    status = served.status()
    assert (status["scene"], status.get("loading")) == ("sparse", None)
    assert served.rig.content.info.name == "sparse"


def broken_content(folder: Path, broken: str) -> Path:
    path = folder / f"{broken}.obj"
    match broken:
        case "a list":
            path = folder / "list.toml"
            path.write_text('[[show]]\nscene = "demo"\nseconds = 5\n\n[[show]]\nscene = "gone.glb"\nseconds = 5\n')
        case "NaN":
            path.write_text("v 0 0 0\nv nan 0 1\nv 0 1 0\nf 1 2 3\n")
    return path


BROKEN = {"NaN": "vertices: 1 of 3", "missing": "not a file", "a list": "show[1]: content: scene: "}


def test_content_that_can_t_be_loaded_is_refused_and_the_old_stays(
    served: Served, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    content = served.rig.content
    for broken, field in BROKEN.items():
        path = broken_content(tmp_path, broken)
        caplog.clear()
        answer = served.asked("scene", str(path))
        assert not answer["ok"] and "\n" not in answer["error"]
        assert str(path) in answer["error"] and field in answer["error"]
        assert all(account.presented for account in served.rig.refreshes(3))
        assert served.rig.content is content
        served.rig.refresh_until(TRACKING)
        status = served.status()
        assert (status["scene"], status["refused"], status["state"]) == ("demo", answer["error"], TRACKING)
        (told,) = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
        assert answer["error"] in told
    assert served.asked("scene", "sparse")["ok"]
    served.rig.refreshes(2)
    assert "refused" not in served.status()


def loading(served: Served, scene: str) -> tuple[threading.Thread, list[dict[str, Any]]]:
    """Who asked for a scene that is being loaded by now, and the answer once it is there."""
    answers: list[dict[str, Any]] = []
    request = {"command": "scene", "value": scene}
    asking = threading.Thread(target=lambda: answers.append(ask([served.server.path], request)))
    asking.start()
    while "loading" not in served.status():
        served.rig.presenter.refresh()
    return asking, answers


def test_a_newer_scene_overtakes_one_that_is_being_loaded(served: Served, gate: threading.Event) -> None:
    first, answers = loading(served, "texture")
    assert served.asked("scene", "sparse", meanwhile=gate.set)["ok"]
    first.join(30.0)
    assert answers == [{"ok": False, "error": "superseded by a newer change"}]
    assert served.rig.content.info.name == "sparse"


def test_a_model_asked_for_while_a_scene_loads_waits_for_it(served: Served, gate: threading.Event) -> None:
    first, answers = loading(served, "texture")
    assert served.asked("model", "sart", meanwhile=gate.set)["ok"]
    first.join(30.0)
    status = served.status()
    assert answers[0]["ok"] and (status["scene"], status["model"]) == ("texture", "sart")


def test_a_place_given_while_the_scene_is_read_again_stays(served: Served, gate: threading.Event) -> None:
    first, answers = loading(served, "demo")
    assert served.asked("place", {"scale": 1.5})["placing"]["scale"] == 1.5
    gate.set()
    while first.is_alive():
        served.rig.presenter.refresh()
    assert answers[0]["ok"] and answers[0]["placing"]["scale"] == 1.5
    assert isinstance(served.rig.content, PlacedSource) and served.rig.content.placing.scale == 1.5
    assert served.asked("model", "balanced")["placing"]["scale"] == 1.5


def test_a_place_given_before_the_settings_are_read_stays(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    real, opened = changes.load_calibration, threading.Event()

    def slow(path: Path | None) -> Any:
        assert opened.wait(60.0)
        return real(path)

    monkeypatch.setattr(changes, "load_calibration", slow)
    first, answers = loading(served, "demo")
    assert served.asked("place", {"scale": 1.5})["placing"]["scale"] == 1.5
    opened.set()
    while first.is_alive():
        served.rig.presenter.refresh()
    assert answers[0]["ok"] and answers[0]["placing"]["scale"] == 1.5
    assert served.asked("model", "balanced")["placing"]["scale"] == 1.5


@pytest.mark.usefixtures("gate")
def test_what_takes_very_long_is_answered_with_where_to_look(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_module, "LOOP_ANSWERS_WITHIN_S", 0.2)
    monkeypatch.setattr(server_module, "LOADED_WITHIN_S", 0.3)
    answer = served.asked("scene", "sparse")
    assert answer["ok"]
    assert "status" in answer["note"]


def configuration(scene: str = "demo", **changes: dict[str, Any]) -> str:
    changes |= {"content": {"scene": scene}}
    tables = {
        name: {**SMALL.get(name, {}), **STEADY.get(name, {}), **changes.get(name, {})}
        for name in {**SMALL, **STEADY, **changes}
    }
    return "\n".join(
        f"[{section}]\n" + "\n".join(f"{name} = {value!r}" for name, value in table.items())
        for section, table in tables.items()
    )


def test_a_reload_keeps_what_was_chosen_unless_the_file_changed_it(served: Served) -> None:
    served.config.write_text(configuration())
    for name, value in (("scene", "sparse"), ("model", "balanced"), ("place", {"scale": 1.5})):
        holds = served.asked(name, value)
    assert (holds["scene"], holds["model"], holds["placing"]["scale"]) == ("sparse", "balanced", 1.5)
    content = served.rig.content
    served.config.write_text(configuration() + "\n[plan]\nalign = false\n")
    answer = served.asked("reload")
    assert answer == holds and served.rig.content is content
    assert served.rig.presenter.settings.plan.align is False
    served.config.write_text(configuration(scene="flat"))
    answer = served.asked("reload")
    assert (answer["scene"], answer["model"], answer["placing"]["scale"]) == ("flat", "balanced", 1.5)
    served.config.write_text(configuration(scene="nowhere.glb"))
    assert not served.asked("reload")["ok"]
    assert served.status()["scene"] == "flat"


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("loop", {"loop": {"rate_hz": 90.0}}),
        ("loop", {"loop": {"scanout_ms": 4.0}}),
        ("calibration.ipd_m", {"calibration": {"ipd_m": 0.064}}),
        ("model.backend", {"model": {"backend": "gl"}}),
    ],
)
def test_a_reload_refuses_what_is_read_only_at_the_start(
    served: Served, name: str, change: dict[str, dict[str, Any]]
) -> None:
    """`[loop]` and `calibration.ipd_m` were accepted, and changed nothing."""
    served.config.write_text(configuration(**change))
    answer = served.asked("reload")
    assert answer == {
        "ok": False,
        "error": f"reload: {name}: cannot be changed while the service is running; restart the service",
    }


def test_only_the_presenter_s_thread_writes_what_was_chosen(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Moving a scene on the solver's thread once wrote data that the presenter's thread was reading."""
    writers: dict[str, set[str]] = {}

    def note(self: Any, name: str, value: Any) -> None:
        writers.setdefault(name, set()).add(threading.current_thread().name)
        object.__setattr__(self, name, value)

    monkeypatch.setattr(type(served.daemon.changes), "__setattr__", note)
    served.config.write_text(configuration())
    assert served.asked("place", {"scale": 1.2})["placing"]["scale"] == 1.2
    for name, value in (("next", None), ("scene", "sparse"), ("model", "sart"), ("reload", None)):
        served.asked(name, value)
    assert writers.keys() >= {"choices", "refused"} and set().union(*writers.values()) == {"MainThread"}


def test_a_command_that_fails_unexpectedly_is_refused_and_the_run_continues(
    served: Served, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: Any) -> None:
        raise OverflowError("int too large to convert to float")

    monkeypatch.setattr(served.daemon.changes, "place", broken)
    answer = served.asked("place", {"scale": 2.0})
    assert answer == {"ok": False, "error": "unexpected error (OverflowError); see the log"}
    (line,) = (TextFormat(journald=False).format(record) for record in caplog.records if record.exc_info)
    assert "place: OverflowError: int too large" in line and "the trace is in" in line
    assert all(account.presented for account in served.rig.refreshes(3))
    assert served.asked("pause")["paused"] is True


@pytest.mark.parametrize("where", ["imported", "made", "drawn"])
def test_a_scene_that_ends_the_process_does_not_block_later_changes(
    served: Served, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    """`sys.exit()`, as vendors' kits do: ctl said ok, and ok to all that came later, and did nothing."""
    calls = {name: "sys.exit('no licence')" if name == where else "pass" for name in ("imported", "made", "drawn")}
    (tmp_path / "leaving.py").write_text(
        "import sys\nimport numpy as np\nfrom phasestack import ContentSource\n"
        f"{calls['imported']}\n"
        "class Scene(ContentSource):\n"
        "    def __init__(self, options, **more):\n        super().__init__(options, **more)\n"
        f"        {calls['made']}\n"
        "    def render(self, view, *, time_ns):\n"
        f"        if view.width_px > 32:\n            {calls['drawn']}\n"
        "        return np.full((view.height_px, view.width_px, 4), 200, np.uint8)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "leaving", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    answer = served.asked("scene", "leaving:Scene")
    assert answer["ok"] is (where == "drawn")
    if where == "drawn":
        served.rig.refresh_until("degraded: content")
        assert "no licence" in served.rig.presenter.machine.reason
    else:
        assert "SystemExit" in answer["error"] and "no licence" in answer["error"]
    assert served.asked("scene", "sparse")["scene"] == "sparse"
    assert served.asked("model", "sart")["model"] == "sart"
    served.rig.refresh_until(TRACKING)


def test_changes_load_one_at_a_time_and_only_the_newest_waits(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty models were loaded side by side: 4 GB."""
    real, at_once, begun = reconfigure.ready_predictor, [0, 0], []

    def ready(settings: Settings, stack: Any, **how: Any) -> Any:
        begun.append(settings.model.name)
        at_once[0] += 1
        at_once[1] = max(at_once)
        try:
            time.sleep(0.3)
            return real(settings, stack, **how)
        finally:
            at_once[0] -= 1

    monkeypatch.setattr(reconfigure, "ready_predictor", ready)
    answers: list[dict[str, Any]] = []
    names = ["sart", "fast"] * 6 + ["sart"]

    def ask_all() -> None:
        for name in names:
            threading.Thread(target=lambda name=name: answers.append(asked_by_itself(served, name))).start()
            time.sleep(0.02)

    asking = threading.Thread(target=ask_all)
    asking.start()
    served.rig.refresh_until(lambda: len(answers) == len(names))
    assert at_once[1] == 1 and len(begun) <= 4
    assert [answer.get("error", "") for answer in answers].count("superseded by a newer change") == len(names) - 1
    assert served.status()["model"] == "sart"


def asked_by_itself(served: Served, model: str) -> dict[str, Any]:
    return ask([served.server.path], {"command": "model", "value": model}, timeout_s=30.0)


def test_a_configuration_that_takes_long_to_read_takes_no_refresh(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading was done between two refreshes: a nested key took 17 seconds."""
    on: list[str] = []
    real = served.read_settings

    def slow() -> Settings:
        on.append(threading.current_thread().name)
        time.sleep(1.0)
        return real()

    monkeypatch.setattr(served.daemon, "_read_settings", slow)
    before = len(served.rig.accounts)
    assert served.asked("reload")["ok"]
    assert on == ["job reconfiguration"]
    instants = [account.present_ns for account in served.rig.accounts[before:]]
    assert max(after - before for before, after in pairwise(instants)) < 0.7 * NS_PER_S


def test_an_address_s_password_appears_in_no_answer_log_or_black_box(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "phasestack")
    with Served(tmp_path, recorder=Recorder(tmp_path / "boxes", minutes=1)) as served:
        answer = served.asked("scene", "rtsp://operator:secret@127.0.0.1:9/door")
        assert not answer["ok"] and "your own class" in answer["error"]
        boxed = served.asked("blackbox")
        told = [answer, served.status(), *(ask([served.server.path], {"command": name}) for name in ("log", "about"))]
        with Path(boxed["file"]).open("rb") as file:
            reader = make_reader(file)
            told += [attachment.data for attachment in reader.iter_attachments()]
            told += [message.data for *_, message in reader.iter_messages()]
    assert "127.0.0.1:9" in str(told) and "secret" not in str(told)
    formatted = [TextFormat(journald=True).format(record) for record in caplog.records]
    assert any("command: scene rtsp" in line for line in formatted) and "secret" not in str(formatted)
