"""Tests that a connected program outlives the solver, and finds the process that serves it again."""

from __future__ import annotations

import json
import os
import signal
import struct
import threading
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tests.daemon.rig import TRACKING, Rig


class Painter:
    """A program that draws grey pictures, each of another shade, until its connection is closed."""

    def __init__(self, address: str) -> None:
        self.drawn, self._address = 0, address
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def is_connected(self) -> bool:
        return self._thread.is_alive()

    def _run(self) -> None:
        with suppress(OSError, ConnectionClosed), connect(self._address, max_size=None, compression=None) as socket:
            socket.send(json.dumps({"name": "painter"}))
            for message in socket:
                asked = json.loads(message)
                pixels = bytes([self.drawn % 256]) * (4 * asked["width"] * asked["height"])
                for side, _ in enumerate(asked["eyes"]):
                    socket.send(struct.pack("<II", asked["frame"], side) + pixels)
                self.drawn += 1

    def ended(self) -> bool:
        self._thread.join(10)
        return not self._thread.is_alive()


@pytest.fixture(scope="module")
def rig() -> Iterator[Rig]:
    steady: dict[str, Any] = {"sensor": {"timeout_s": 5.0}, "tracker": {"hold_s": 20.0}}
    with Rig(in_process=True, content={"scene": "program"}, **steady) as made:
        yield made


def address(rig: Rig) -> str:
    rig.refresh_until(lambda: rig.presenter.solver.live.program)
    return rig.presenter.solver.live.program["address"]


def kill(rig: Rig, role: str) -> None:
    (pid,) = [process["pid"] for process in rig.run.processes() if process["role"] == role]
    os.kill(pid, signal.SIGKILL)


def refresh_until_drawn(rig: Rig, program: Painter) -> None:
    before = program.drawn
    rig.refresh_until_solved(times=2)
    rig.refresh_until(lambda: program.drawn > before + 2)


def test_a_program_stays_connected_while_the_solver_is_replaced(rig: Rig) -> None:
    program, before = Painter(address(rig)), address(rig)
    rig.refresh_until(TRACKING)
    refresh_until_drawn(rig, program)
    kill(rig, "solver")
    rig.refresh_until(lambda: rig.presenter.missing)
    rig.refresh_until(lambda: not rig.presenter.missing)
    refresh_until_drawn(rig, program)
    assert program.is_connected and address(rig) == before


def test_a_new_process_serves_programs_at_the_same_address(rig: Rig) -> None:
    program, before = Painter(address(rig)), address(rig)
    refresh_until_drawn(rig, program)
    kill(rig, "program server")
    rig.refresh_until(program.ended)
    rig.refresh_until(lambda: rig.presenter.missing)
    again: list[Painter] = []

    def returns() -> bool:
        if not again or not again[-1].is_connected:
            again.append(Painter(before))
        return again[-1].drawn > 2

    rig.refresh_until(returns)
    rig.refresh_until(lambda: not rig.presenter.missing)
    assert address(rig) == before
