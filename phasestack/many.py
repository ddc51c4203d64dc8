"""Solve many pairs, one after another or by an executor."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sized
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, overload
from weakref import WeakSet

from numpy.typing import ArrayLike

from phasestack.pair import Eyes, Result, solve
from runtime.errors import one_line
from runtime.optics.stack import PanelStack
from runtime.support.progress import ShownProgress
from runtime.support.threads import ahead

AHEAD = 64  # number of pairs that an executor has at most

Pairs = Iterable[tuple[ArrayLike, ArrayLike, Eyes]]
SolveOne = Callable[[Any], Result]


@overload
def solve_each(
    pairs: Pairs,
    *,
    stack: PanelStack,
    fov_deg: float = ...,
    model: str | Path = ...,
    eye_sigma_mm: float = ...,
    progress: bool = ...,
    executor: None = None,
) -> Iterator[Result]: ...
@overload
def solve_each(
    pairs: Pairs,
    *,
    stack: PanelStack,
    fov_deg: float = ...,
    model: str | Path = ...,
    eye_sigma_mm: float = ...,
    progress: bool = ...,
    executor: Executor,
) -> Iterator[Result | ValueError]: ...
def solve_each(
    pairs: Pairs,
    *,
    stack: PanelStack,
    fov_deg: float = 40.0,
    model: str | Path = "balanced",
    eye_sigma_mm: float = 1.0,
    progress: bool = True,
    executor: Executor | None = None,
) -> Iterator[Result | ValueError]:
    """Solve many pairs (left picture, right picture, eyes_m), and yield the results in order.

    Each pair is read only when its turn comes, so `pairs` may be a generator. The other arguments are those of `solve`;
    `progress` is shown on stderr. Raises ValueError, which names the pair and the argument, for an invalid one.

    Args:
        executor: Any `concurrent.futures.Executor`, to solve several pairs in parallel with the same results; up to 64
            pairs are read ahead. A pair that fails does not end the others: its ValueError is yielded in place of a
            result and, with `progress`, printed as one line. If a pair's process dies and breaks the executor, the
            remaining pairs are solved in new processes, one after another.
    """
    if not isinstance(pairs, Iterable):
        raise ValueError("pairs: must be an iterable of (left picture, right picture, eyes_m)")
    if not isinstance(executor, Executor | None):
        raise ValueError(f"executor: must be a concurrent.futures.Executor, not {type(executor).__name__}")
    total = len(pairs) if isinstance(pairs, Sized) else None
    solve_one = partial(_solved, stack=stack, fov_deg=fov_deg, model=model, eye_sigma_mm=eye_sigma_mm)
    stream = sys.stderr if progress else None
    shown = ShownProgress(stream) if stream is not None else None
    futures: WeakSet[Future[Result]] = WeakSet()
    begun = (_begun(executor, solve_one, pair, futures) for pair in pairs)
    try:
        for number, answer in enumerate(ahead(begun, AHEAD if executor else 1)):
            if shown is not None:
                shown("solving", number, total)
            result = _outcome(answer, number, may_fail=executor is not None)
            if stream is not None and isinstance(result, ValueError):
                print(result, file=stream, flush=True)
            yield result
    finally:
        for future in futures:
            future.cancel()
        if shown is not None:
            shown("", 0, None)


def _solved(pair: Any, **how: Any) -> Result:
    try:
        left, right, eyes_m = pair
    except (TypeError, ValueError):
        raise ValueError("must be (left picture, right picture, eyes_m)") from None
    return solve(left, right, eyes_m=eyes_m, **how)


def _begun(
    executor: Executor | None, solve_one: SolveOne, pair: Any, futures: WeakSet[Future[Result]]
) -> Callable[[], Result]:
    """Begin a pair if there is an executor, and return a function that waits for its result, or solves it."""
    if executor is None:
        return partial(solve_one, pair)

    def alone() -> Result:
        with ProcessPoolExecutor(1, get_context("spawn")) as process:
            return process.submit(solve_one, pair).result()

    def answer() -> Result:
        try:
            return future.result()
        except BrokenExecutor:
            return alone()

    try:
        future = executor.submit(solve_one, pair)
    except BrokenExecutor:
        return alone
    futures.add(future)
    return answer


def _outcome(answer: Callable[[], Result], number: int, *, may_fail: bool) -> Result | ValueError:
    """Return a pair's result or, with `may_fail`, its error, which names the pair. Raises ValueError."""
    try:
        return answer()
    except Exception as error:
        if not may_fail and not isinstance(error, ValueError):
            raise
        told = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {one_line(str(error))}"
        told = "its process died" if isinstance(error, BrokenExecutor) else told
        failure = ValueError(f"pairs[{number}]: {told}")
    if not may_fail:
        raise failure from None
    return failure
