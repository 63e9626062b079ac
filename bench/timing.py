"""Honest times: every answer is compared with the reference, then all contenders take turns.

So does the reference, unless it takes more than a second: that has its first run only. A busy
machine is then busy for all of them. Compiling and fetching kernels (the first run),
transfer and compute are apart. What is reported is the median, with quartiles and the best.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mmmgpu.errors import InputError

REFERENCE = "reference"
COPY = "copy"  # of as many bytes
PAUSE = 0.15  # s: OpenBLAS's threads spin for 0.13 s after they have worked
LEAST = 0.01  # s: what takes less is repeated within its turn
SLOW = 1.0  # s: what takes longer has one turn only


@dataclass(frozen=True)
class Contender:
    """Who does a piece of work.

    load: brings what is needed to where it is worked on, and returns what is timed.
    fetch: brings an answer back: NumPy arrays, as the reference gives them.
    tolerance: the largest difference from the reference, as a share of its scale; None for a peer,
        whose difference is shown.
    """

    load: Callable[[], Callable[[], Any]]
    fetch: Callable[[Any], Any] = lambda answer: answer
    tolerance: float | None = None


@dataclass(frozen=True)
class Work:
    """A piece of work and who does it.

    reference: computes the answer slowly, or a part of it.
    contenders: by name.
    beside: other work that takes turns with the contenders, to compare them with.
    bytes, operations: that it takes at least, for the roofline; None where they are not counted.
    precision: that of these operations.
    items: how many things are done in one run, of the kind `unit`.
    part: the share of the work that the reference does.
    checked: what of the answer the reference gives: an index.
    whole: computes all of it in another way that is not timed, where the reference gives a part.
    """

    name: str
    reference: Callable[[], Any]
    contenders: Mapping[str, Contender]
    beside: Mapping[str, Callable[[], Any]] = field(default_factory=dict)
    bytes: float | None = None
    operations: float | None = None
    precision: str = "float32"
    items: int = 1
    unit: str = "run"
    part: float = 1.0
    checked: Any = ...
    whole: Callable[[], Any] | None = None


@dataclass(frozen=True)
class Effort:
    """How long to measure: at least `turns` of all contenders, then until `seconds` are over."""

    turns: int = 11
    seconds: float = 2.0
    most: int = 25


QUICK = Effort(turns=3, seconds=0.3)


def measure(work, effort):
    """What is known of a piece of work after `effort`, as JSON values.

    Raises:
        InputError: An answer differs from the reference by more than its tolerance.
    """
    start = time.perf_counter(), time.process_time()
    desired = [(work.checked, as_tuple(work.reference()))]
    once = np.array([[time.perf_counter() - start[0]], [time.process_time() - start[1]]])
    if work.whole is not None:
        desired.append((..., as_tuple(work.whole())))
    runs = {REFERENCE: work.reference} if once[0, 0] <= SLOW else {}
    found = {}
    for name, contender in work.contenders.items():
        runs[name], found[name] = validated(work.name, name, contender, desired)
    seconds = take_turns(runs | work.beside, effort)
    reference = seconds.pop(REFERENCE, once) / work.part
    rows = {name: statistics(*s) | found.get(name, {}) for name, s in seconds.items()}
    rows[REFERENCE] = statistics(*reference)
    size = {"bytes": work.bytes, "operations": work.operations, "precision": work.precision}
    return {"items": work.items, "unit": work.unit, **size, "contenders": rows}


def validated(work, name, contender, desired):
    """The function to time, and how its first answer came about.

    desired: indices of the answer, and what is to be there.
    """
    start = time.perf_counter()
    run = contender.load()
    loaded = time.perf_counter()
    answer = run()
    done = time.perf_counter()
    actual = as_tuple(contender.fetch(answer))
    fetched = time.perf_counter()
    error = max(difference(actual, *given) for given in desired)
    if contender.tolerance is not None and not error <= contender.tolerance:
        raise InputError(
            f"{work}, {name}: differs from the reference by {error:.1e} of its scale, more than "
            f"{contender.tolerance:.0e}: not timed; run the tests of this backend"
        )
    return run, {
        "first_ms": milliseconds(done - loaded),
        "transfer_ms": milliseconds(loaded - start + fetched - done),
        "difference": float(f"{error:.2g}"),
    }


def as_tuple(answer):
    """One array or several as a tuple."""
    return answer if isinstance(answer, tuple) else (answer,)


def difference(actual, checked, desired):
    """The largest difference of what is checked of any output, as a share of its scale."""
    pairs = ((a[checked], d) for a, d in zip(actual, desired, strict=True))
    return max(float(np.abs(a - d).max() / (np.abs(d).max() or 1)) for a, d in pairs)


def take_turns(runs, effort):
    """Seconds of every run of each of `runs`, and of the processor for it; after one to warm up."""
    warm = {name: timed(run) for name, run in runs.items()}
    seconds = {name: [once] if once[0] > SLOW else [] for name, once in warm.items()}
    quick = [name for name in runs if not seconds[name]]
    begin = time.perf_counter()
    for turn in range(effort.most):
        if turn >= effort.turns and time.perf_counter() - begin > effort.seconds:
            break
        for name in quick:
            seconds[name].append(timed(runs[name]))
    return {name: np.array(s).T for name, s in seconds.items()}


def timed(run):
    """Seconds of one run, and of the processor for it, all threads; the mean of those of a turn.

    After a pause, for the threads of the library before may still spin. A machine that has slept
    takes a while to wake its cores and to fill its caches: that is not what a short run takes.
    """
    time.sleep(PAUSE)
    start, processor, runs, clock = time.perf_counter(), time.process_time(), 0, 0.0
    while clock < LEAST:
        run()
        runs += 1
        clock = time.perf_counter() - start
    return clock / runs, (time.process_time() - processor) / runs


def statistics(seconds, processor):
    """Every turn, median, quartiles and best [ms]; the least of the processor's time.

    Other work slows that least.
    """
    low, median, high = np.percentile(seconds, [25, 50, 75])
    return {
        "median_ms": milliseconds(median),
        "quartiles_ms": [milliseconds(low), milliseconds(high)],
        "best_ms": milliseconds(seconds.min()),
        "cpu_ms": milliseconds(processor.min()),
        "turns_ms": [milliseconds(s) for s in seconds],
    }


def milliseconds(seconds):
    """Four digits of them."""
    return float(f"{1e3 * seconds:.4g}")
