"""What Prometheus scrapes, over real HTTP on loopback."""

from __future__ import annotations

import socket
import urllib.request

import pytest

from runtime.daemon.metrics import LOOPBACK, Metrics
from runtime.errors import InputError
from runtime.records import FrameAccount, State


def account(**changes):
    values = {
        "frame": 1, "capture_ns": 1_000_000_000, "predicted_for_ns": 0, "present_ns": 1_070_000_000, "eyes_m": None,
        "eyes_label": "predicted", "state": State.TRACKING, "inference": "ran", "presented": True, "skew_ms": 0.3,
        "stage_ms": {"render": 3.0, "inference": 12.5},
    }  # fmt: skip
    return FrameAccount(**(values | changes))


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


@pytest.fixture
def metrics():
    made = Metrics()
    yield made
    made.close()


def scraped(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/metrics", timeout=5) as answer:
        lines = answer.read().decode().splitlines()
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))}


def test_frames_stages_faults_and_state_are_told(metrics):
    port = free_port()
    metrics.serve(port)
    metrics.frame(account())
    metrics.frame(account(presented=False, state=State.DEGRADED, inference="reused"))
    metrics.fault("sensor")
    metrics.missed_vblanks(2)
    metrics.fps(59.5)
    told = scraped(port)
    assert told['phasestack_frames_total{result="presented"}'] == 1
    assert told['phasestack_frames_total{result="dropped"}'] == 1
    assert told['phasestack_stage_milliseconds_sum{stage="inference"}'] == 25.0
    assert told['phasestack_stage_milliseconds_bucket{le="12.0",stage="inference"}'] == 0
    assert told["phasestack_photon_latency_milliseconds_sum"] == 70.0
    assert told['phasestack_state{phasestack_state="degraded"}'] == 1
    assert told['phasestack_state{phasestack_state="tracking"}'] == 0
    assert told['phasestack_faults_total{part="sensor"}'] == 1
    assert told["phasestack_missed_vblanks_total"] == 2
    assert told["phasestack_presented_frames_per_second"] == 59.5


def test_it_listens_on_loopback_only(metrics):
    metrics.serve(free_port())
    server, _ = metrics._server
    assert server.server_address[0] == LOOPBACK


def test_a_port_that_is_taken_is_named(metrics):
    with socket.socket() as other:
        other.bind((LOOPBACK, 0))
        other.listen()
        with pytest.raises(InputError, match="service: metrics_port"):
            metrics.serve(other.getsockname()[1])


def test_after_closing_nobody_listens(metrics):
    port = free_port()
    metrics.serve(port)
    metrics.close()
    metrics.close()
    with socket.socket() as probe:
        assert probe.connect_ex((LOOPBACK, port)) != 0
