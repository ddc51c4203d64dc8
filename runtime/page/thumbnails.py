"""A small picture of each scene: of the built-in ones as shipped, of all others as they were last seen by the page."""

from __future__ import annotations

import base64
import binascii
import contextlib
import hashlib
import time
from importlib.resources import files
from pathlib import Path
from typing import Any

SETTLED_S = 3.0  # after a change of scene the pictures may still be of the one before it
RENEWED_S = 60.0
KEPT = 300
BYTES_MAX = 1 << 18


class Thumbnails:
    """Keeps them in a folder. Any thread may call; the worst of two at once is a picture written twice."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._since: tuple[str, float] = ("", 0.0)  # the scene that is shown, and from when on
        self._renewed: dict[str, float] = {}

    def note(self, status: dict[str, Any], pictures: dict[str, Any]) -> None:
        """What the daemon tells, and the pictures that it told shortly before that: perhaps one to keep."""
        scene, now_s = str(status.get("scene", "")), time.monotonic()
        shown = f"{scene}\0{status.get('content')}\0{status.get('placing')}"
        if shown != self._since[0]:
            self._since = (shown, now_s)
        if not scene or status.get("loading") or status.get("flat_asked") or now_s - self._since[1] < SETTLED_S:
            return
        coded = (pictures.get("jpegs") or {}).get("seen-left")
        if not isinstance(coded, str) or now_s - self._renewed.get(scene, -RENEWED_S) < RENEWED_S:
            return
        self._renewed[scene] = now_s
        with contextlib.suppress(OSError, binascii.Error):
            self._keep(scene, base64.b64decode(coded, validate=True))

    def jpeg(self, scene: str) -> bytes | None:
        """The picture of a scene; None: it was never seen."""
        with contextlib.suppress(OSError):
            return self._path(scene).read_bytes()
        with contextlib.suppress(OSError, ValueError):
            if scene.isidentifier():
                return (files("runtime.page") / "assets" / "scenes" / f"{scene}.jpg").read_bytes()
        return None

    def _keep(self, scene: str, jpeg: bytes) -> None:
        if len(jpeg) > BYTES_MAX:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._path(scene)
        half = path.with_suffix(".new")
        half.write_bytes(jpeg)
        half.replace(path)
        kept = sorted(self._folder.glob("*.jpg"), key=lambda item: item.stat().st_mtime)
        for old in kept[:-KEPT]:
            old.unlink(missing_ok=True)

    def _path(self, scene: str) -> Path:
        return self._folder / f"{hashlib.sha256(scene.encode(errors='replace')).hexdigest()[:32]}.jpg"
