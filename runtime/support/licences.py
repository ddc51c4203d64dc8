"""Third-party notices: `python -m runtime.support.licences > THIRD_PARTY.md`, with only the runtime installed.

Walks the requirements of the installed phasestack and tells, for each package that comes with it, what its own
metadata says: version, licence, home page, and where its licence texts are.
"""

from __future__ import annotations

import re
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from typing import Any

HEAD = """\
# Third-party notices

phasestack is licensed under Apache-2.0. A running phasestack uses the packages below; each is installed from
PyPI, unchanged, and brings its licence texts along (column "texts": files in its `*.dist-info`).
Made by `python -m runtime.support.licences` from the packages' own metadata.

| package | version | licence | home | texts |
| --- | --- | --- | --- | --- |
"""
TAIL = """
Wheels of binary packages bundle further libraries, each under the licence in that wheel's texts: among them
OpenBLAS and the GCC runtime (numpy, scipy), FFmpeg under LGPL-2.1 (opencv), GLFW under Zlib (glfw).
opencv's wheel also carries the Haar cascades that find faces (Intel License Agreement, BSD-like, in the files).

The schemas of black boxes (`runtime/blackbox/schemas/foxglove.*.json`) are those of the npm package @foxglove/schemas
2.1.0 (MIT, Foxglove Technologies Inc; its text is beside them).

At run time phasestack loads, and does not ship, the system's OpenGL and EGL (Mesa: MIT), Xlib and RandR (MIT),
libusb (LGPL-2.1) and OpenNI2 (Apache-2.0).
"""
LONG = 60


def notices(root: str = "phasestack") -> str:
    """The whole page. Raises PackageNotFoundError where `root` is not installed."""
    rows = [row(package) for package in sorted(closure(root), key=lambda package: package.name.lower())]
    return HEAD + "\n".join(rows) + "\n" + TAIL


def closure(root: str) -> list[Distribution]:
    """Every installed package that `root` needs, without its extras and itself."""
    found: dict[str, Distribution] = {}
    waiting = [root]
    while waiting:
        name = _normal(waiting.pop())
        if name in found:
            continue
        try:
            package = distribution(name)
        except PackageNotFoundError:
            if name == root:
                raise
            continue  # for another platform or Python
        found[name] = package
        for requirement in package.requires or ():
            wanted, _, condition = requirement.partition(";")
            if "extra" not in condition or _asked_for(condition, extras={"lz4"} if name == "mcap" else set()):
                waiting.append(re.split(r"[\s\[<>=!~(]", wanted.strip(), maxsplit=1)[0])
    return [package for name, package in found.items() if name != _normal(root)]


def row(package: Distribution) -> str:
    """One line of the table."""
    texts = sorted({file.name for file in package.files or () if ".dist-info/" in str(file) and _is_licence(file.name)})
    cells = (package.name, package.version, licence(package), _home(package), ", ".join(texts) or "in its metadata")
    return "| " + " | ".join(cell.replace("|", "/") for cell in cells) + " |"


def licence(package: Distribution) -> str:
    """The licence as the package states it: SPDX expression, short text, or classifier."""
    metadata: Any = package.metadata
    for field in ("License-Expression", "License"):
        text = metadata.get(field) or ""
        if text and len(text) <= LONG and "\n" not in text and text.upper() != "UNKNOWN":
            return text
    classifiers = [
        entry.rsplit(" :: ", 1)[1]
        for entry in metadata.get_all("Classifier") or ()
        if entry.startswith("License :: ") and entry.count(" :: ") > 1
    ]
    return ", ".join(classifiers) or (metadata.get("License") or "").strip().split("\n")[0][:LONG] or "see its texts"


def _home(package: Distribution) -> str:
    metadata: Any = package.metadata
    for entry in metadata.get_all("Project-URL") or ():
        label, _, url = entry.partition(",")
        if label.strip().lower() in ("homepage", "source", "repository", "source code", "github"):
            return str(url.strip())
    return metadata.get("Home-page") or f"https://pypi.org/project/{package.name}/"


def _is_licence(name: str) -> bool:
    return bool(re.match(r"(licen[sc]e|copying|notice|copyright)", name, re.IGNORECASE))


def _asked_for(condition: str, *, extras: set[str]) -> bool:
    return any(f'extra == "{extra}"' in condition or f"extra == '{extra}'" in condition for extra in extras)


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


if __name__ == "__main__":
    print(notices(), end="")
