"""What Prometheus scrapes, over real HTTP on loopback."""

from __future__ import annotations

import os
import resource
import socket
import threading
import urllib.request
from contextlib import ExitStack
from typing import Any

import pytest

from runtime.daemon import listener, supervise
from runtime.daemon.metrics import LOOPBACK, Metrics
from runtime.records import RefreshAccount, State
from tests.waiting import eventually


def account(**changes: Any) -> Any:
    values = {
        "frame": 1, "capture_ns": 1_000_000_000, "predicted_for_ns": 0, "present_ns": 1_062_000_000, "eyes_m": None,
        "eyes_label": "predicted", "eye_sigma_mm": 2.5, "state": State.TRACKING, "solution": 7, "solved_for_m": None,
        "solution_age_ms": 42.0, "inference": "ran", "presented": True, "skew_ms": 0.3, "photon_ns": 1_070_000_000,
        "stage_ms": {"render": 3.0, "inference": 12.5},
    }  # fmt: skip
    return RefreshAccount(**(values | changes))


def refreshed(metrics: Metrics, told: Any, *, faults: Any = None, missed_blanks: int = 0) -> None:
    metrics.refresh(told, faults=faults or {}, missed_blanks=missed_blanks)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


@pytest.fixture
def metrics() -> Any:
    made = Metrics()
    yield made
    made.close()


def scraped(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/metrics", timeout=60) as answer:
        lines = answer.read().decode().splitlines()
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))}


def test_refreshes_solutions_stages_faults_and_state_are_told(metrics: Metrics) -> None:
    port = free_port()
    metrics.serve(port)
    refreshed(metrics, account())
    refreshed(metrics, account(inference="reused", present_ns=1_078_000_000, photon_ns=1_086_000_000), missed_blanks=2)
    last = account(presented=False, state=State.DEGRADED, inference="skipped", solution_age_ms=None)
    refreshed(metrics, last, faults={"sensor": 1}, missed_blanks=2)
    told = scraped(port)
    assert told['phasestack_refreshes_total{result="presented"}'] == 2
    assert told['phasestack_refreshes_total{result="dropped"}'] == 1
    assert told['phasestack_solutions_total{result="ran"}'] == 1
    assert told['phasestack_stage_milliseconds_sum{stage="inference"}'] == 37.5
    assert told['phasestack_stage_milliseconds_bucket{le="12.0",stage="inference"}'] == 0
    assert told["phasestack_photon_latency_milliseconds_sum"] == 70.0 + 86.0
    assert told["phasestack_interval_milliseconds_sum"] == 16.0
    assert told["phasestack_solution_age_milliseconds_count"] == 2
    assert told["phasestack_eye_sigma_millimetres_sum"] == 7.5
    assert told['phasestack_state{phasestack_state="degraded"}'] == 1
    assert told['phasestack_state{phasestack_state="tracking"}'] == 0
    assert told['phasestack_faults_total{part="sensor"}'] == 1
    assert told["phasestack_missed_blanks_total"] == 2


def test_nothing_is_told_that_was_not_measured(metrics: Metrics) -> None:
    """No gauge stands at 0.0 for a quality that nobody looked at, and no rate is a mean since the start."""
    port = free_port()
    metrics.serve(port)
    refreshed(metrics, account(solution_age_ms=None, eye_sigma_mm=None, capture_ns=0))
    told = scraped(port)
    for name in ("solution_age_milliseconds", "eye_sigma_millimetres", "photon_latency_milliseconds"):
        assert told[f"phasestack_{name}_count"] == 0
    assert not [name for name in told if "psnr" in name or "fps" in name or "per_second" in name]


def test_connections_that_ask_nothing_cost_no_thread_and_hold_nobody_up(metrics: Metrics) -> None:
    """Any local user may connect: a thousand of them took the presenter its turns and the service its threads."""
    metrics.serve(port := free_port())
    threads = threading.active_count()
    held = [socket.create_connection((LOOPBACK, port), timeout=20.0) for _ in range(4 * listener.CLIENTS_MAX)]
    try:
        refreshed(metrics, account())
        assert scraped(port)['phasestack_solutions_total{result="ran"}'] == 1
        assert threading.active_count() == threads
        assert held[0].recv(100).startswith(b"HTTP/1.1 503 "), "who has waited longest was sent away"
    finally:
        for client in held:
            client.close()


def test_a_connection_that_never_ends_its_request_is_let_go(metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "REQUEST_S", 0.2)
    metrics.serve(port := free_port())
    with socket.create_connection((LOOPBACK, port), timeout=20.0) as client:
        client.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert client.makefile("rb").read().startswith(b"HTTP/1.1 503 ")


def test_without_descriptors_who_comes_is_served_later_and_a_line_tells_it(
    metrics: Metrics, caplog: pytest.LogCaptureFixture
) -> None:
    metrics.serve(port := free_port())
    with socket.socket() as client:
        client.settimeout(20.0)
        os.close(free := os.dup(0))
        before = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free, before[1]))
        try:
            client.connect((LOOPBACK, port))
            client.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            assert eventually(lambda: "metrics: socket.accept() out of system resource" in caplog.text)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
        assert client.recv(100).startswith(b"HTTP/1.1 200 ")
    assert "Traceback" not in caplog.text


def test_a_port_that_is_taken_costs_the_figures_and_not_the_display(metrics: Metrics) -> None:
    port = free_port()
    metrics.serve(port)
    with ExitStack() as cleanup:
        assert supervise._metrics(port, cleanup) is None
        assert supervise._metrics(0, cleanup) is None
