"""Send the viewer's head pose to other programs, by UDP as OpenTrack does and by LSL."""

from __future__ import annotations

import logging
import math
import socket
import struct
from typing import Any

import numpy as np

from runtime.clock import NS_PER_S
from runtime.config import PoseSettings
from runtime.errors import InputError
from runtime.frame.refresh import Refresh
from runtime.records import F64, Eyes, SensorFrame
from runtime.support.extras import missing_extra

log = logging.getLogger("phasestack.pose")

DATAGRAM = struct.Struct("<6d")  # x, y, z in centimetres; yaw, pitch, roll in degrees
CM_PER_M = 100.0
CHANNELS = {"x": "cm", "y": "cm", "z": "cm", "yaw": "degrees", "pitch": "degrees", "roll": "degrees"}  # with units


def pose_of(eyes_m: Eyes, origin_m: tuple[float, float, float]) -> F64:
    """Return the head's pose (6,): x, y and z in cm from `origin_m`, and yaw, pitch and roll in degrees.
    Seen by the viewer, x is to the right, y up and z towards the display. Yaw is positive to the right, and roll is
    positive if the head leans to its right shoulder. Pitch is 0, because two eyes do not show it.
    """
    out, right, up = eyes_m.mean(0) - origin_m
    backwards, sideways, upwards = eyes_m[1] - eyes_m[0]
    yaw = math.degrees(math.atan2(backwards, sideways))
    roll = math.degrees(math.atan2(-upwards, math.hypot(backwards, sideways)))
    return np.array([right * CM_PER_M, up * CM_PER_M, -out * CM_PER_M, yaw, 0.0, roll])


class PoseSender:
    """Observer of the loop that sends the pose of a tracked viewer."""

    def __init__(self, settings: PoseSettings) -> None:
        """Open the socket and the LSL stream. Raises InputError for the host, and MissingPart without LSL."""
        self._settings = settings
        self._stream = _lsl_stream(settings) if settings.lsl else None
        self._socket: socket.socket | None = None
        self._to: tuple[Any, ...] = ()
        if settings.port:
            self._open(settings)
        self._pose: F64 | None = None
        self._updated_ns = self._sent_ns = -NS_PER_S
        self._fails = False

    def _open(self, settings: PoseSettings) -> None:
        try:
            kind, _, _, _, to = socket.getaddrinfo(settings.host, settings.port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise InputError("pose", "host", f"{settings.host}: {error.strerror}") from None
        self._to = to
        self._socket = socket.socket(kind, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def sampled(self, sample: SensorFrame) -> None:
        """Ignore samples: the pose is predicted for the display time, as the pictures are."""

    def refreshed(self, refresh: Refresh) -> None:
        """Send the pose after a refresh, unless one was sent a short time before."""
        account = refresh.account
        if account.eyes_m is None or account.eyes_label in ("held", "none"):
            self._pose = None  # a new viewer's pose does not begin at the last one's
            return
        now_ns, pose = account.predicted_for_ns, pose_of(account.eyes_m, self._settings.origin_m)
        if self._pose is not None and self._settings.smoothing_ms > 0:
            passed_ms = (now_ns - self._updated_ns) / 1e6
            pose = self._pose + (pose - self._pose) * -math.expm1(-passed_ms / self._settings.smoothing_ms)
        self._pose, self._updated_ns = pose, now_ns
        if (now_ns - self._sent_ns) * self._settings.rate_hz < 0.9 * NS_PER_S:
            return
        self._sent_ns = now_ns
        if self._stream is not None:
            self._stream.push_sample(pose.tolist())
        if self._socket is None:
            return
        try:
            self._socket.sendto(DATAGRAM.pack(*pose), self._to)
            self._fails = False
        except OSError as error:
            if not self._fails:
                log.warning("the head pose cannot be sent to %s: %s", self._to[0], error.strerror)
            self._fails = True

    def close(self) -> None:
        """Close the socket and the stream."""
        if self._socket is not None:
            self._socket.close()
        self._stream = None  # LSL closes a stream without references


def _lsl_stream(settings: PoseSettings) -> Any:
    """Return an LSL stream for poses, which announces itself to the network. Raises MissingPart if it is impossible."""
    try:
        import pylsl
    except ImportError as error:
        raise missing_extra(error) or error from None
    about = pylsl.StreamInfo(
        settings.lsl, "Pose", len(CHANNELS), pylsl.IRREGULAR_RATE, "double64", f"phasestack-{socket.gethostname()}"
    )
    channels = about.desc().append_child("channels")
    for name, unit in CHANNELS.items():
        channel = channels.append_child("channel")
        channel.append_child_value("label", name)
        channel.append_child_value("unit", unit)
    return pylsl.StreamOutlet(about)
