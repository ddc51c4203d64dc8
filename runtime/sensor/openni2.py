"""Driver `openni2`: any camera with an OpenNI2 driver, and `.oni` recordings."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from runtime.clock import NS_PER_S, Clock
from runtime.config import SensorSettings
from runtime.errors import EndOfRecording, InputError, SensorLost, SensorTimeout
from runtime.records import U8, U16, Intrinsics, SensorFrame
from runtime.sensor.base import Capabilities, DeviceClock, Sensor
from runtime.sensor.openni2_library import load

SERIAL_PROPERTY = 3  # ONI_DEVICE_PROPERTY_SERIAL_NUMBER
DEPTH_1_MM, DEPTH_100_UM, RGB888, GRAY8 = 100, 101, 200, 202
PAIR_APART_US = 40_000  # longest time between paired depth and colour: one frame period of an unsynchronised camera
PAIR_WAIT_S = 0.02  # maximum time to wait for a depth picture's colour picture
THREADS_STOP_S = 0.5  # fifteen periods of a recording's threads; three periods led to crashes on a busy machine
DRAIN_MAX = 32  # maximum number of frames to skip per call, because a fast source could otherwise block the call

log = logging.getLogger(__name__)


class _Picture(NamedTuple):
    number: int  # frame number assigned by the device
    time_us: int  # timestamp on the device's clock
    pixels: Any  # U8 (h, w, 3) or U16 (h, w)


class OpenNI2Driver(Sensor):
    """Driver for OpenNI2 cameras that delivers colour frames as well as depth frames in millimetres.
    Depth is registered to colour if the camera supports it. For use on a process's main thread only: at exit, the
    library accesses the stack of every thread that has called it.
    """

    name = "openni2"
    capabilities = Capabilities(colour=True, depth=True)

    def __init__(self, settings: SensorSettings, clock: Clock) -> None:
        """Store the settings. `source` is a serial number, a device URI, a `.oni` file, or the only camera."""
        self._settings, self._clock = settings, clock
        self._openni: Any = None
        self._device: Any = None
        self._streams: dict[str, Any] = {}
        self._newest: dict[str, _Picture] = {}
        self._intrinsics: Intrinsics | None = None
        self._times = DeviceClock()
        self._sequence = self._index = 0

    def open(self) -> None:
        self.close()
        source = self._settings.source
        if source.endswith(".oni") and not Path(source).is_file():
            raise InputError(source, "", "does not exist or is not a file")
        self._openni = load(self._settings.openni2_folder)
        try:
            self._device = self._find_device()
            self._start_streams()
        except Exception as error:  # the package raises its own exceptions, ctypes exceptions and AssertionError
            self.close()
            if isinstance(error, SensorLost):
                raise
            raise SensorLost(f"OpenNI2: {_text(error)}") from None

    def _find_device(self) -> Any:
        source, openni = self._settings.source, self._openni
        if source.endswith(".oni"):
            return openni.Device(source.encode())
        uris = openni.Device.enumerate_uris()
        wanted = self.serial or ("" if source in ("", "demo", "any") else source)
        matches = []
        for uri in uris:
            device = openni.Device(uri)
            if wanted and wanted not in (_serial(device), uri.decode(errors="replace")):
                device.close()
                continue
            matches.append(device)
        if len(matches) == 1:
            return matches[0]
        for device in matches:
            device.close()
        if matches:
            raise SensorLost(f"{len(matches)} OpenNI2 cameras match; set sensor.source to a serial number")
        raise SensorLost(
            f"no OpenNI2 camera {wanted!r} was found among {len(uris)} connected cameras"
            if wanted
            else "no OpenNI2 camera found"
        )

    def _start_streams(self) -> None:
        device, openni = self._device, self._openni
        streams = {"depth": device.create_depth_stream(), "colour": device.create_color_stream()}
        self._streams = {kind: stream for kind, stream in streams.items() if stream is not None}
        if not self._streams:
            raise SensorLost("OpenNI2: the camera delivers neither depth nor colour")
        both = len(self._streams) == 2
        mode = openni.IMAGE_REGISTRATION_DEPTH_TO_COLOR
        if both and device.is_image_registration_mode_supported(mode):
            device.set_image_registration_mode(mode)
        elif both and not device.is_file():
            log.warning(
                "OpenNI2: the camera does not register depth to colour, so parallax will shift the eye positions"
            )
        for stream in self._streams.values():
            if stream.is_property_supported(7):  # mirroring
                stream.set_mirroring_enabled(False)
            stream.start()
        if device.playback is not None:
            device.playback.set_repeat_enabled(self._settings.loop)
        self.serial = _serial(device) or self.serial
        self.capabilities = Capabilities(colour="colour" in self._streams, depth="depth" in self._streams)
        self._intrinsics = self._read_intrinsics(self._streams.get("colour") or self._streams["depth"])
        self._times, self._newest, self._index = DeviceClock(), {}, 0

    def _read_intrinsics(self, stream: Any) -> Intrinsics | None:
        """Return intrinsics for a centred camera with the reported or configured field of view, or None."""
        try:  # recordings claim to support the property but fail to return it
            fov_x, fov_y = stream.get_horizontal_fov(), stream.get_vertical_fov()
        except Exception:
            fov_x = fov_y = 0.0
        if not 0 < fov_x < math.pi:
            fov_x, fov_y = math.radians(self._settings.fov_deg), 0.0
        if fov_x == 0.0:
            log.warning("OpenNI2: the camera does not report its field of view; set sensor.fov_deg")
            return None
        mode = stream.video_mode
        camera = Intrinsics.centred(mode.resolutionX, mode.resolutionY, fov_rad=fov_x)
        if not 0 < fov_y < math.pi:
            return camera
        return replace(camera, fy_px=camera.height_px / 2 / math.tan(fov_y / 2))

    def read_newest(self, timeout_s: float) -> SensorFrame:
        if self._device is None:
            raise SensorLost("OpenNI2: the camera is not open")
        deadline_ns = self._clock.now_ns() + round(timeout_s * NS_PER_S)
        before = self._newest.get(self._main)
        while self._newest.get(self._main) is before:
            remaining_s = (deadline_ns - self._clock.now_ns()) / NS_PER_S
            if remaining_s <= 0 or not self._take(remaining_s):
                self._nothing(timeout_s)
        for _ in range(DRAIN_MAX):
            newest = self._newest[self._main]
            if not self._take(0.0):
                break
            self.skipped += self._newest[self._main] is not newest
        wait_until_ns = self._clock.now_ns() + round(PAIR_WAIT_S * NS_PER_S)
        while self._lacks_colour() and self._clock.now_ns() < wait_until_ns and self._take(PAIR_WAIT_S):
            pass
        picture, colour = self._newest[self._main], self._newest.get("colour")
        if colour is not None and abs(colour.time_us - picture.time_us) > PAIR_APART_US:
            colour = None
        ahead = picture.number - self._index if 0 < self._index < picture.number else 1
        self._index, self._sequence = picture.number, self._sequence + ahead
        return SensorFrame(
            sequence=self._sequence,
            capture_ns=self._times.host_ns(picture.time_us * 1000, arrival_ns=self._clock.now_ns()),
            colour=colour.pixels if colour is not None else None,
            depth_mm=picture.pixels if self._main == "depth" else None,
            intrinsics=self._intrinsics,
        )

    @property
    def _main(self) -> str:
        return "depth" if "depth" in self._streams else "colour"

    def _lacks_colour(self) -> bool:
        """Return True if the colour picture for the newest depth picture may still arrive."""
        colour = self._newest.get("colour")
        return "colour" in self._streams and (
            colour is None or self._newest[self._main].time_us - colour.time_us > PAIR_APART_US
        )

    def _take(self, timeout_s: float) -> bool:
        """Copy one frame from any stream. Returns False if no frame arrived in time."""
        try:
            # With a timeout of 0 the library reports an error for some devices.
            stream = self._openni.wait_for_any_stream(list(self._streams.values()), max(timeout_s, 0.001))
            if stream is None:
                return False
            frame = stream.read_frame()
            try:
                kind = next(kind for kind, ours in self._streams.items() if ours is stream)
                self._newest[kind] = _Picture(int(frame.frameIndex), int(frame.timestamp), _pixels(frame))
            finally:
                frame.close()
        except Exception as error:
            raise SensorLost(f"OpenNI2: {_text(error)}") from None
        return True

    def _nothing(self, timeout_s: float) -> None:
        if self._device.playback is not None and not self._settings.loop:
            raise EndOfRecording(f"{self._settings.source}: the recording has ended")
        raise SensorTimeout(f"no frame arrived for {timeout_s:g} s")

    def close(self) -> None:
        streams, self._streams = self._streams, {}
        device, self._device = self._device, None
        for stream in streams.values():
            _quietly(stream.stop)
        if streams and self._settings.source.endswith(".oni"):
            # The library does not wait for a recording's threads to stop. Without a pause, these threads would
            # write to freed memory.
            time.sleep(THREADS_STOP_S)
        for handle in (*streams.values(), device):
            if handle is not None:
                _quietly(handle.close)


def _quietly(call: Callable[[], object]) -> None:
    """Call a function and log any exception it raises, for example because a camera was unplugged."""
    try:
        call()
    except Exception as error:
        log.debug("OpenNI2: error while closing: %s", _text(error))


def _serial(device: Any) -> str:
    """Return a device's serial number, or an empty string if it has none."""
    import ctypes

    if not device.is_property_supported(SERIAL_PROPERTY):
        return ""
    text = device.get_property(SERIAL_PROPERTY, ctypes.c_char * 128)
    return bytes(text.value).decode(errors="replace").strip()


def _text(error: Exception) -> str:
    """Return the library's error message without the text added by the package."""
    words = error.args[1] if len(error.args) > 1 else str(error) or type(error).__name__
    return words.decode(errors="replace").strip() if isinstance(words, bytes) else str(words)


def _pixels(frame: Any) -> U8 | U16:
    """Copy a frame as (h, w) millimetres or (h, w, 3) RGB. Raises ValueError for other formats or too few bytes."""
    pixel_format, height, width = frame.videoMode.pixelFormat.value, frame.height, frame.width
    data = np.frombuffer(frame.get_buffer_as_uint8(), np.uint8)
    kinds = {DEPTH_1_MM: (2, 1), DEPTH_100_UM: (2, 1), RGB888: (1, 3), GRAY8: (1, 1)}
    if pixel_format not in kinds:
        raise ValueError(f"pixel format {pixel_format} is not supported")
    size, channels = kinds[pixel_format]
    if data.size < height * frame.stride or frame.stride < width * size * channels:
        raise ValueError("a frame has fewer bytes than its width and height require")
    rows = data[: height * frame.stride].reshape(height, frame.stride)[:, : width * size * channels]
    if size == 2:
        depth = np.ascontiguousarray(rows).view("<u2").astype(np.uint16)
        return depth if pixel_format == DEPTH_1_MM else ((depth + np.uint16(5)) // np.uint16(10)).astype(np.uint16)
    if channels == 1:
        return np.repeat(rows[..., None], 3, axis=2)
    return rows.reshape(height, width, 3).copy()
