"""Films read by OpenCV through FFmpeg, which may open nothing but the file that was named."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import cv2

from runtime.support import untrusted_input

VIDEOS = (".mp4", ".mkv", ".avi", ".mov", ".webm", ".m4v")
CONTAINERS = "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi"
OPTIONS = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
_alone = threading.Lock()


def open_film(path: Path) -> cv2.VideoCapture:
    """A film's file. FFmpeg's complaints and OpenCV's stay off stderr: our own line names the file.

    A playlist or a script under a film's name would make FFmpeg open other files, and connections, and so would a name
    that it takes for an address. Raises InputError for what is no file.
    """
    untrusted_input.open_regular(path).close()
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    with _alone:
        before, level = os.environ.get(OPTIONS), cv2.utils.logging.setLogLevel(0)
        os.environ[OPTIONS] = f"protocol_whitelist;file|format_whitelist;{CONTAINERS}"
        try:
            return cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
        finally:
            cv2.utils.logging.setLogLevel(level)
            os.environ.pop(OPTIONS)
            if before is not None:
                os.environ[OPTIONS] = before
