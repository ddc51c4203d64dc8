"""Open films with OpenCV's FFmpeg backend, which may access only the named file."""

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
    """Open a film.

    FFmpeg is restricted to local files and video containers. Otherwise, a playlist or script with a film's suffix, or a
    name that looks like a URL, could make FFmpeg open other files and network connections. Messages from FFmpeg and
    OpenCV are suppressed because, unlike the project's own errors, they do not name the file.

    Raises InputError if the path is not a regular file or the file cannot be read.
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
