"""Write THIRD_PARTY.md, which lists the runtime's packages and their licences.

Run it in the environment used by `make test`. The packages are those listed in requirements/runtime.lock; their
metadata is read by pip-licenses.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "THIRD_PARTY.md"
HEAD = """\
# Third-party licences

phasestack is licensed under Apache-2.0. It runs with the packages below, which are installed from PyPI, unchanged, with
their licence texts in `*.dist-info`. `python docs/make_licences.py` writes this page from `requirements/runtime.lock`
and the packages' metadata.

"""
TAIL = """
Wheels of binary packages bundle further libraries, each under the licence in that wheel's texts: among them
OpenBLAS and the GCC runtime (numpy, scipy), FFmpeg under LGPL-2.1 (opencv), FFmpeg with x264 and x265
under GPL-2.0 or later (av), GLFW under Zlib (glfw).

The compiled loops include nanobind (BSD-3-Clause) and robin-map (MIT); their texts are in `runtime/kernels/LICENSE`.

The networks that find eyes (`runtime/eyes/models`) are under Apache-2.0 (the text in LICENSE): `yunet.onnx` is YuNet as
its authors publish it (ShiqiYu/libfacedetection.train); `face_mesh.onnx` and `iris.onnx` are MediaPipe's face landmark
and iris models (Google LLC), converted by `docs/make_eye_models.sh`.

At run time phasestack loads, and does not ship, the system's OpenGL and EGL (Mesa: MIT), Xlib and RandR (MIT),
libusb (LGPL-2.1) and OpenNI2 (Apache-2.0).
"""


def locked() -> list[str]:
    """Return the names of the runtime's packages."""
    text = (ROOT / "requirements" / "runtime.lock").read_text(encoding="utf-8")
    return re.findall(r"^([A-Za-z0-9._-]+)==", text, re.MULTILINE)


def licences(names: list[str]) -> list[dict[str, str]]:
    """Return installed packages' `Name`, `License` and `URL` entries, sorted by name."""
    command = [
        str(Path(sys.executable).parent / "pip-licenses"),
        "--from=mixed",
        "--with-urls",
        "--format=json",
        "--packages",
    ]
    done = subprocess.run([*command, *names], capture_output=True, text=True, check=True)
    found: list[dict[str, str]] = json.loads(done.stdout)
    return sorted(found, key=lambda package: package["Name"].lower())


def page(packages: list[dict[str, str]]) -> str:
    """Format the page, with the packages grouped by licence."""
    groups: dict[str, list[str]] = {}
    for one in packages:
        groups.setdefault(one["License"], []).append(f"[{one['Name']}]({one['URL']})")
    rows = [f"* {licence}: {', '.join(links)}\n" for licence, links in sorted(groups.items())]
    return HEAD + "".join(rows) + TAIL


if __name__ == "__main__":
    PAGE.write_text(page(licences(locked())), encoding="utf-8")
