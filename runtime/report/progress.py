"""Progress of long work, on stderr, so that stdout stays the result's. Off a terminal: a line now and then."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from runtime.support.progress import NowAndThen

T = TypeVar("T")


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[int, int], None]]:
    """A bar that is told (done, of)."""
    if not sys.stderr.isatty():
        told = NowAndThen(sys.stderr)
        yield lambda done, of: told(f"{title}: {done} of {of}")
        return

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(title, total=None)
        yield lambda done, of: progress.update(task, completed=done, total=of)


def tracked(title: str, items: Sequence[T]) -> Iterator[T]:
    """The items, one after the other, with a bar of how many are done."""
    with progress_bar(title) as tell:
        for number, item in enumerate(items, start=1):
            yield item
            tell(number, len(items))


@contextmanager
def status_line(title: str) -> Iterator[Callable[[str], None]]:
    """A line that says what is being done."""
    if not sys.stderr.isatty():
        told = NowAndThen(sys.stderr)
        yield lambda text: told(f"{title}: {text}")
        return

    with Console(stderr=True).status(title) as status:
        yield lambda text: status.update(f"{title}: {text}")
