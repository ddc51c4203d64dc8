"""What Prometheus scrapes, over real HTTP on loopback."""

from __future__ import annotations

import os
import resource
import socket
import threading
import urllib.request
from collections.abc import Iterator

import pytest

from runtime.daemon import listener
from runtime.daemon.metrics import LOOPBACK, Metrics
from runtime.errors import InputError
from tests.waiting import eventually


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        return probe.getsockname()[1]


STATUS = {
    "ok": True, "state": "degraded: sensor", "fps_now": 59.5, "frames": 120, "photon_now_ms": None, "eyes_m": [[1, 2]],
    "stage_ms": {"render": {"p50": 3.0, "p99": 4.5}, "track": None}, "faults": {"sensor": 2, 'x"} 1': 5},
}  # fmt: skip


@pytest.fixture
def port() -> Iterator[int]:
    made = Metrics(number := free_port(), lambda: STATUS)
    yield number
    made.close()


def scraped(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://{LOOPBACK}:{port}/metrics", timeout=60) as answer:
        lines = answer.read().decode().splitlines()
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines if not line.startswith("#"))}


def test_the_statuss_numbers_are_told_under_their_names_and_nothing_that_was_not_measured(port: int) -> None:
    assert scraped(port) == {
        'phasestack_state{of="degraded"}': 1, "phasestack_ok": 1, "phasestack_fps_now": 59.5, "phasestack_frames": 120,
        'phasestack_stage_ms{of="render p50"}': 3, 'phasestack_stage_ms{of="render p99"}': 4.5,
        'phasestack_faults{of="sensor"}': 2,
    }  # fmt: skip


def test_connections_that_ask_nothing_cost_no_thread_and_hold_nobody_up(port: int) -> None:
    """Any local user may connect: a thousand of them took the presenter its turns and the service its threads."""
    threads = threading.active_count()
    held = [socket.create_connection((LOOPBACK, port), timeout=20.0) for _ in range(4 * listener.CLIENTS_MAX)]
    try:
        assert scraped(port)["phasestack_frames"] == 120
        assert threading.active_count() == threads
        assert held[0].recv(100).startswith(b"HTTP/1.1 503 "), "who has waited longest was sent away"
    finally:
        for client in held:
            client.close()


def test_a_connection_that_never_ends_its_request_is_let_go(port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "REQUEST_S", 0.2)
    with socket.create_connection((LOOPBACK, port), timeout=20.0) as client:
        client.sendall(b"GET /metrics HTTP/1.1\r\n")
        assert client.makefile("rb").read().startswith(b"HTTP/1.1 503 ")


def test_without_descriptors_who_comes_is_served_later_and_a_line_tells_it(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
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


def test_a_port_that_is_taken_is_told(port: int) -> None:
    with pytest.raises(InputError, match=f"metrics_port: {port} can't be used"):
        Metrics(port, dict)
