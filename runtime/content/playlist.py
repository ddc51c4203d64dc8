"""Play a list of scenes one after another, each with a duration and settings.

All are loaded before the first one is shown, so missing files are reported at the start, and changes take no time.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from runtime.clock import NS_PER_S
from runtime.config import PLACING, ContentSettings, Section, read_table, validated
from runtime.content.base import ContentInfo, ContentSource, ForwardingSource, View
from runtime.errors import InputError
from runtime.support.picture_header import CAMERA_SET
from runtime.support.plausible import within
from runtime.support.plugins import located

ENTRIES_MAX = 64  # largest number of entries; all are kept in memory


class PlaylistFile(Section):
    """Contents of a TOML or JSON playlist file, with a `[[show]]` table for each scene."""

    repeat: bool = Field(True, description="restart after the last scene (if false, keep showing the last scene)")
    show: list[dict[str, Any]] = Field(min_length=1, max_length=ENTRIES_MAX, description="the scenes, in order")


class Entry(ContentSettings):
    """A scene in a playlist, with the settings and placement that apply to it."""

    scene: str = Field(
        min_length=1,
        description="scene to show, specified as in content.scene (paths are relative to the playlist's folder)",
    )
    seconds: Annotated[float, within(0.5, 86_400.0, "s")] = Field(
        description="number of seconds for which to show the scene"
    )

    @field_validator("scene")
    @classmethod
    def _no_list(cls, value: str) -> str:
        if Path(value).suffix.lower() in (".toml", ".json"):
            raise ValueError("a playlist cannot contain another playlist")
        return value


@dataclass(frozen=True, slots=True)
class Playlist:
    """A validated playlist. Its scenes have not been opened yet."""

    path: Path
    repeat: bool
    entries: tuple[Entry, ...]


def read_playlist(path: Path, settings: ContentSettings) -> Playlist:
    """Read a playlist file. `settings` are the entries' defaults, except for the placement, which applies
    to the whole. Raises InputError, which names the file, the entry and the field, if it is not valid.
    """
    table = read_table(path)
    if "frames" in table and "show" not in table:
        raise InputError(path, "", f"is a set of cameras for training a NeRF; {CAMERA_SET}")
    if path.suffix.lower() == ".json" and "show" not in table:
        raise InputError(
            path, "show", "is missing; a JSON file must be a playlist, with its scenes listed under `show`"
        )
    file = validated(PlaylistFile, table, source=path)
    common = settings.model_dump(exclude={"scene", "file", *PLACING})
    entries = []
    for number, own in enumerate(file.show):
        places = {
            key: place(own[key], path.absolute().parent)
            for key, place in (("scene", located), ("file", lambda name, folder: str(folder / name)))
            if isinstance(own.get(key), str) and own[key]
        }
        try:
            entries.append(validated(Entry, common | own | places, source=""))
        except InputError as error:
            raise InputError(path, f"show[{number}].{error.field}".rstrip("."), error.problem) from None
    return Playlist(path, file.repeat, tuple(entries))


class PlaylistSource(ForwardingSource):
    """Source that plays a list of scenes one after another. The first request starts the playlist."""

    def __init__(self, playlist: Playlist, openers: list[Callable[..., ContentSource]], *, context: Any) -> None:
        """Create the sources of all entries. Raises InputError if an entry cannot be shown."""
        self._list = playlist
        self._ends_ns = list(accumulate(round(entry.seconds * NS_PER_S) for entry in playlist.entries))
        self._begin_ns: int | None = None
        self._number = 0  # number of the current entry, counted across repetitions
        self._sources: list[ContentSource] = []
        try:
            for number, opener in enumerate(openers):
                try:
                    self._sources.append(opener(context=context))
                except InputError as error:
                    raise InputError(playlist.path, f"show[{number}]", str(error)) from None
        except BaseException:
            self.close()
            raise

    @property
    def info(self) -> ContentInfo:  # type: ignore[override]
        """The current scene's properties, with the playlist's name put before the scene's."""
        index, inner = self._number % len(self._sources), self.source.info
        name = f"{self._list.path.stem}: {inner.name} ({index + 1} of {len(self._sources)})"
        return replace(inner, name=name, moving=True)

    @property
    def source(self) -> ContentSource:  # type: ignore[override]
        return self._sources[self._number % len(self._sources)]

    def describe(self, *, time_ns: int) -> dict[str, Any]:
        """Return `entries` (scenes and durations), `index` and `left_s` (None if the scene stays)."""
        entries = [{"scene": entry.scene, "seconds": entry.seconds} for entry in self._list.entries]
        index, since_ns = self._at(time_ns)
        left_s = self._list.entries[index % len(entries)].seconds - since_ns / NS_PER_S
        last = not self._list.repeat and index >= len(entries) - 1
        return {"entries": entries, "index": index % len(entries), "left_s": None if last else round(left_s, 1)}

    def skip(self, *, time_ns: int) -> bool:
        index, _ = self._at(time_ns)
        if not self._list.repeat and index >= len(self._sources) - 1:
            return False
        rounds, within = divmod(index, len(self._sources))
        self._begin_ns = time_ns - rounds * self._ends_ns[-1] - self._ends_ns[within]
        self._turn_to(time_ns)
        return True

    def forwarded(self, view: View, time_ns: int) -> tuple[ContentSource, View, int]:
        since_ns = self._turn_to(time_ns)
        return self.source, view, since_ns

    def revision(self, *, time_ns: int) -> int:
        since_ns = self._turn_to(time_ns)
        return (self._number << 64) + self.source.revision(time_ns=since_ns)

    def close(self) -> None:
        for source in self._sources:
            source.close()

    def _turn_to(self, time_ns: int) -> int:
        """Switch to the entry due at a given time, and return how long it has been due, in ns."""
        if self._begin_ns is None:
            self._begin_ns = time_ns
        self._number, since_ns = self._at(time_ns)
        return since_ns

    def _at(self, time_ns: int) -> tuple[int, int]:
        """Return the number of the entry due, counted across repetitions, and how long it has been due, in ns."""
        passed_ns = max(0, time_ns - (time_ns if self._begin_ns is None else self._begin_ns))
        count, round_ns = len(self._ends_ns), self._ends_ns[-1]
        if not self._list.repeat:
            passed_ns = min(passed_ns, round_ns - 1)
        rounds, within_ns = divmod(passed_ns, round_ns)
        index = bisect_right(self._ends_ns, within_ns)
        begin_ns = self._ends_ns[index - 1] if index else 0
        return rounds * count + index, within_ns - begin_ns
