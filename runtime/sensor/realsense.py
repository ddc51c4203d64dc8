"""Driver `realsense`: RealSense depth cameras, and recordings made with the RealSense SDK.

The driver has been tested with recordings played by the SDK (tests/sensor/test_realsense.py), but not yet with a
camera.
"""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

import numpy as np

from runtime.clock import NS_PER_MS, NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, InputError, SensorLost, SensorTimeout
from runtime.records import U8, U16, Intrinsics, SensorFrame
from runtime.sensor.base import Capabilities, DeviceClock, Sensor

RATE_HZ = 30
FILES = (".bag", ".db3")  # the SDK's old and new recording formats
STAMP_AGE_NS = NS_PER_S  # host timestamps older than this, or in the future, are ignored
DRAIN_MAX = 32  # maximum number of frames to skip per call
# Indices of the R, G and B channels in each supported format.
COLOURS = {"rgb8": [0, 1, 2], "bgr8": [2, 1, 0], "rgba8": [0, 1, 2], "bgra8": [2, 1, 0]}

log = logging.getLogger(__name__)


class RealSenseDriver(Sensor):
    """Driver for RealSense cameras: colour, depth in millimetres aligned to it, and intrinsics."""

    name = "realsense"
    capabilities = Capabilities(colour=True, depth=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """Import the SDK and store the settings. `source` is a serial number, one of `FILES`, or the only camera."""
        import pyrealsense2

        self._rs, self._settings, self._clock = pyrealsense2, settings, clock
        self._pipeline: Any = None
        self._playback: Any = None
        self._align: Any = None
        self._times = DeviceClock()
        self._number, self._sequence = -1, 0

    def open(self) -> None:
        self.close()
        rs, config = self._rs, self._rs.config()
        pipeline = rs.pipeline()
        source = self._settings.source
        try:
            if source.endswith(FILES):
                if not Path(source).is_file():
                    raise InputError(source, "", "does not exist or is not a file")
                config.enable_device_from_file(source, repeat_playback=self._settings.loop)
            else:
                config.enable_device(self._serial_to_open())
                config.enable_stream(rs.stream.depth, rs.format.z16, RATE_HZ)
                config.enable_stream(rs.stream.color, rs.format.rgb8, RATE_HZ)
            profile = pipeline.start(config)
        except RuntimeError as error:
            raise SensorLost(f"RealSense: {error}") from None
        self._pipeline = pipeline
        device, streams = profile.get_device(), {stream.stream_type() for stream in profile.get_streams()}
        self._playback = device.as_playback() if device.is_playback() else None
        if not {rs.stream.depth, rs.stream.color} <= streams:
            self.close()
            raise SensorLost("RealSense: the camera must deliver both depth and colour")
        self.serial = device.get_info(rs.camera_info.serial_number)
        self._align = rs.align(rs.stream.color)
        self._times, self._number = DeviceClock(), -1

    def _serial_to_open(self) -> str:
        """Return the configured or only camera's serial number. Raises SensorLost if none or several match."""
        source = self._settings.source
        configured = self.serial or ("" if source in ("", "demo", "any") else source)
        info = self._rs.camera_info.serial_number
        serials: list[str] = [device.get_info(info) for device in self._rs.context().query_devices()]
        matches = [serial for serial in serials if configured in ("", serial)]
        if len(matches) > 1:
            choices = ", ".join(matches)
            raise SensorLost(f"several RealSense cameras are connected; set sensor.source to one of {choices}")
        if not matches:
            camera = f"RealSense camera {configured!r}" if configured else "RealSense camera"
            raise SensorLost(f"no {camera} was found among {len(serials)} connected cameras")
        return matches[0]

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._pipeline is None:
            raise SensorLost("RealSense: the camera is not open")
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        try:
            frames = self._next(deadline_ns)
            for _ in range(DRAIN_MAX):
                if not (newer := self._pipeline.poll_for_frames()):
                    break
                if self._is_new(newer):
                    self.skipped, frames = self.skipped + 1, newer
            aligned = self._align.process(frames)
            depth, colour = aligned.get_depth_frame(), aligned.get_color_frame()
            if not (depth and colour):
                raise SensorTimeout("RealSense: a depth picture arrived without a colour picture")
            return self._frame(depth, colour)
        except RuntimeError as error:
            raise SensorLost(f"RealSense: {error}") from None

    def _next(self, deadline_ns: int) -> Any:
        """Wait for frames with an unread depth picture and return them. Raises SensorTimeout at the deadline,
        EndOfRecording, and RuntimeError if the SDK reports an error.
        """
        while True:
            remaining_ms = max(1, (deadline_ns - self._clock.now_ns()) // NS_PER_MS)
            done, frames = self._pipeline.try_wait_for_frames(remaining_ms)
            if done and self._is_new(frames):
                return frames
            if not done and self._is_over():
                raise EndOfRecording(f"{self._settings.source}: the recording has ended")
            if self._clock.now_ns() >= deadline_ns:
                raise SensorTimeout("RealSense: no new frame arrived")

    def _is_over(self) -> bool:
        playing = self._rs.playback_status.playing
        return self._playback is not None and not self._settings.loop and self._playback.current_status() != playing

    def _is_new(self, frames: Any) -> bool:
        """Return True for a colour picture with new depth, which the SDK may deliver with several colour pictures."""
        depth = frames.get_depth_frame()
        if not depth or not frames.get_color_frame() or depth.get_frame_number() == self._number:
            return False
        number = depth.get_frame_number()
        self._sequence += number - self._number if 0 <= self._number < number else 1
        self._number = number
        return True

    def _frame(self, depth: Any, colour: Any) -> SensorFrame:
        return SensorFrame(
            sequence=self._sequence,
            capture_ns=self._capture_ns(depth),
            colour=_rgb(colour),
            depth_mm=_millimetres(depth),
            intrinsics=_intrinsics(colour.profile.as_video_stream_profile().intrinsics),
        )

    def _capture_ns(self, frame: Any) -> int:
        """Return a depth picture's capture time on the run's clock, by the SDK's timestamp."""
        now_ns, stamp_ns = self._clock.now_ns(), round(frame.get_timestamp() * NS_PER_MS)
        age_ns: int = time.time_ns() - stamp_ns
        on_host = frame.get_frame_timestamp_domain() != self._rs.timestamp_domain.hardware_clock
        if on_host and 0 <= age_ns < STAMP_AGE_NS:
            return now_ns - age_ns
        return self._times.host_ns(stamp_ns, arrival_ns=now_ns)

    def close(self) -> None:
        pipeline, self._pipeline, self._playback = self._pipeline, None, None
        if pipeline is not None:
            try:
                pipeline.stop()
            except RuntimeError as error:  # for example, because the camera was unplugged
                log.debug("RealSense: error while closing: %s", error)


def _rgb(frame: Any) -> U8:
    """Copy a colour frame as (h, w, 3) RGB. Raises SensorLost if its format is not in `COLOURS`."""
    kind = frame.profile.format().name
    if kind not in COLOURS:
        raise SensorLost(f"RealSense: colour format {kind} is not supported; supported formats: {', '.join(COLOURS)}")
    return np.ascontiguousarray(np.asanyarray(frame.get_data())[..., COLOURS[kind]])


def _millimetres(frame: Any) -> U16:
    """Copy a depth frame as (h, w) millimetres, where 0 means not measured."""
    raw: U16 = np.asanyarray(frame.get_data())
    unit_mm = float(frame.get_units()) * 1e3
    if abs(unit_mm - 1) < 1e-4:
        return raw.copy()
    scaled: U16 = np.minimum(np.rint(raw * unit_mm), np.iinfo(np.uint16).max).astype(np.uint16)
    return scaled


def _intrinsics(camera: Any) -> Intrinsics:
    """Convert intrinsics from the SDK, where pixel centres have integer coordinates."""
    return Intrinsics(camera.width, camera.height, camera.fx, camera.fy, camera.ppx + 0.5, camera.ppy + 0.5)
