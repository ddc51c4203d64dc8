"""A custom sensor that receives eye positions as JSON over UDP.

The file must be on Python's path, and the configuration must name the class:

    [sensor]
    driver = "udp_eyes:UdpEyes"
    options = { port = 4711 }

    PYTHONPATH=examples phasestack run --config udp.toml --headless --out out/udp

Each datagram is of the form `{"n": 1, "t_ns": 0, "left": [x, y, z], "right": [x, y, z]}`. It contains a counter, the
sender's time and the positions of the viewer's left and right eyes in metres. The sensor's frame has x to the sensor's
right, y down and z away from the sensor.
"""

from __future__ import annotations

import json
import socket
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from phasestack import Capabilities, DeviceClock, EyePoints, Sensor, SensorFrame, SensorLost, SensorTimeout


class UdpOptions(BaseModel):
    """The sensor's options, from the [sensor.options] table."""

    port: int = Field(ge=1, le=65535)
    noise_mm: tuple[float, float, float] = (0.5, 0.5, 2.0)  # standard deviations along x, y and z


class UdpEyes(Sensor):
    """Sensor that receives eye positions on a UDP port of the loopback interface."""

    Options = UdpOptions
    name = "udp-eyes"
    capabilities = Capabilities(eye_points=True)

    def __init__(self, options: UdpOptions, *, clock: Any) -> None:
        # Only store the settings here. Everything that can fail belongs in `open`.
        self._port, self._clock = options.port, clock
        self._covariance_m2 = np.diag(np.square(options.noise_mm)) * 1e-6
        self._socket: socket.socket | None = None
        self._times = DeviceClock()

    def open(self) -> None:
        self.close()
        channel = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            channel.bind(("127.0.0.1", self._port))
        except OSError as error:
            channel.close()  # release the socket if binding fails
            raise SensorLost(f"port {self._port}: {error.strerror}") from None
        self._socket, self._times = channel, DeviceClock()

    def read_newest(self, timeout_s: float) -> SensorFrame:
        newest = self._receive(timeout_s)
        if newest is None:
            raise SensorTimeout(f"no datagram for {timeout_s:g} s")
        while (later := self._receive(0.0)) is not None:
            newest, self.skipped = later, self.skipped + 1
        try:
            message = json.loads(newest)
            eyes_m = np.array([message["left"], message["right"]], dtype=np.float64).reshape(2, 3)
            number, device_ns = int(message["n"]), int(message["t_ns"])
        except (ValueError, KeyError, TypeError) as error:
            raise SensorLost(f"not an eye message: {error!r}") from None
        capture_ns = self._times.host_ns(device_ns, arrival_ns=self._clock.now_ns())
        return SensorFrame(number, capture_ns, EyePoints(eyes_m, np.ones(2), covariance_m2=self._covariance_m2))

    def _receive(self, timeout_s: float) -> bytes | None:
        if self._socket is None:
            raise SensorLost("not open")
        self._socket.settimeout(max(timeout_s, 1e-4))
        try:
            return self._socket.recv(4096)
        except TimeoutError:
            return None
        except OSError as error:
            raise SensorLost(str(error)) from None

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None
