"""Writes a recording of the RealSense SDK by its own recorder, from a device that the SDK simulates."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

SERIAL, RATE_HZ = "SIM-0001", 30
OFFSET_M = 0.05  # of the colour camera, to the right of the depth camera


def write_recording(path: Path, depth: Any, colour: Any, *, focal_px: float, unit_m: float = 0.001) -> None:
    """depth: (n, h, w) uint16 in `unit_m`; colour: (n, h, w, 3) uint8."""
    import pyrealsense2 as rs

    count, height, width = depth.shape
    camera = rs.intrinsics()
    camera.width, camera.height, camera.fx, camera.fy = width, height, focal_px, focal_px
    camera.ppx, camera.ppy, camera.model = width / 2 - 0.5, height / 2 - 0.5, rs.distortion.none
    device = rs.software_device()
    device.register_info(rs.camera_info.serial_number, SERIAL)
    sensors, profiles = [], []
    for name, kind, bytes_px, form in (
        ("Stereo Module", rs.stream.depth, 2, rs.format.z16),
        ("RGB Camera", rs.stream.color, 3, rs.format.rgb8),
    ):
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.width, stream.height = kind, 0, bytes_px, width, height
        stream.fps, stream.bpp, stream.fmt, stream.intrinsics = RATE_HZ, bytes_px, form, camera
        sensors.append(device.add_sensor(name))
        profiles.append(rs.video_stream_profile(sensors[-1].add_video_stream(stream)))
    sensors[0].add_read_only_option(rs.option.depth_units, unit_m)
    moved = rs.extrinsics()
    moved.rotation, moved.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-OFFSET_M, 0, 0]
    profiles[0].register_extrinsics_to(profiles[1], moved)
    recorder, queue = rs.recorder(str(path), device), rs.frame_queue(100)
    recorded = recorder.query_sensors()
    for sensor in recorded:
        sensor.open(sensor.get_stream_profiles())
        sensor.start(queue)
    for number in range(count):
        for sensor, profile, picture in zip(sensors, profiles, (depth[number], colour[number]), strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.bpp = np.ascontiguousarray(picture), picture[0, 0].nbytes
            frame.stride, frame.frame_number, frame.profile = width * frame.bpp, number + 1, profile
            frame.timestamp, frame.domain = 1000 * (1 + number / RATE_HZ), rs.timestamp_domain.hardware_clock
            frame.depth_units = unit_m
            sensor.on_video_frame(frame)
        time.sleep(1 / RATE_HZ)  # the file keeps when each arrived, too
    for sensor in recorded:
        sensor.stop()
        sensor.close()
