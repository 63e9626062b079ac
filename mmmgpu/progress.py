"""Progress of long jobs on the standard error: a bar on a terminal, now and then a line elsewhere.

Bars go when they are done; a job of more than a few seconds leaves one line. Nothing is ever
written to the standard output, which belongs to results.
"""

import functools
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from rich.console import Console

T = TypeVar("T")
Advance = Callable[[int], None]

_LINE_EVERY_S = 5.0


def progress(
    items: Iterable[T], label: str, *, total: int | None = None, quiet: bool = False
) -> Iterator[T]:
    """Yield `items` unchanged and show how many have been dealt with, and the time left.

    Without `total` it is `len(items)` where they have one; else only the count is shown. Calls may
    be nested: every level has its bar. Exceptions, KeyboardInterrupt included, pass through.
    """
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(total, label, quiet=quiet) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def progress_bar(total: int | None, label: str, *, quiet: bool = False) -> Iterator[Advance]:
    """Yield a function `advance(n)` for jobs that are no loop over items."""
    if quiet:
        yield lambda n: None
        return
    begin = time.monotonic()
    with (_bar if sys.stderr.isatty() else _lines)(total, label) as advance:
        yield advance
    elapsed = time.monotonic() - begin
    if elapsed >= _LINE_EVERY_S:
        print(f"{label}: done in {_clock(elapsed)}", file=sys.stderr, flush=True)


@functools.cache
def _console() -> "Console":
    """Return the one console for all bars, so that nested ones do not overwrite each other."""
    from rich.console import Console

    return Console(stderr=True)


@contextmanager
def _bar(total: int | None, label: str) -> Iterator[Advance]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
    )
    with Progress(*columns, console=_console(), redirect_stdout=False, transient=True) as bars:
        task = bars.add_task(label, total=total)
        yield lambda n: bars.advance(task, n)


@contextmanager
def _lines(total: int | None, label: str) -> Iterator[Advance]:
    """Print a line at most every few seconds; a job shorter than that prints nothing."""
    begin = printed = time.monotonic()
    count = 0

    def advance(n: int) -> None:
        nonlocal count, printed
        count += n
        now = time.monotonic()
        if now - printed >= _LINE_EVERY_S and count != total:
            printed = now
            of = "" if total is None else f"/{total}"
            tail = _left(count, total, now - begin)
            print(f"{label}: {count}{of}, {tail}", file=sys.stderr, flush=True)

    yield advance


def _left(count: int, total: int | None, elapsed: float) -> str:
    if total is None or count == 0:
        return f"{_clock(elapsed)} so far"
    return f"{_clock(elapsed * (total - count) / count)} left"


def _clock(seconds: float) -> str:
    """Return a duration as h:mm:ss or m:ss."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
