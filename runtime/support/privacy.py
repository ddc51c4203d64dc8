"""What dependencies would write or send of their own accord, switched off by their environment before they are loaded.

A service that watches people leaves nothing behind but what it was asked for, and opens no connection.
"""

from __future__ import annotations

import os

QUIET = {
    "ORT_DISABLE_TELEMETRY": "1",  # onnxruntime: a device number and events under the user's cache, and connections
    "MESA_SHADER_CACHE_DISABLE": "true",  # Mesa: compiled shaders under the user's cache; ours take milliseconds
}


def keep_quiet() -> None:
    """Must come before onnxruntime and OpenGL are loaded."""
    wanted = dict(QUIET)
    if "MESA_SHADER_CACHE_DIR" in os.environ:  # somebody gave it a place, as the service's unit does
        del wanted["MESA_SHADER_CACHE_DISABLE"]
    os.environ.update(wanted)
