"""The same work for many items on all cores, results in order, and a quick end when interrupted."""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")
Cancelled = Callable[[], bool]


class CancelledError(Exception):
    """Raised inside a worker that is to stop because another one failed or the user interrupted."""


def map_ordered(
    function: Callable[[Item, Cancelled], Result], items: Iterable[Item], *, threads: int
) -> Iterator[Result]:
    """Yield ``function(item, cancelled)`` for every item, in order, `threads` at a time.

    `cancelled()` tells a long-running function to give up; it should raise `CancelledError` then.
    The threads are Python's: what they run should release the GIL.
    """
    stop = threading.Event()
    pool = ThreadPoolExecutor(threads)
    waiting: deque[Future[Result]] = deque()
    try:
        for item in items:  # few are taken in advance: items may be frames of a long video
            waiting.append(pool.submit(function, item, stop.is_set))
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        stop.set()
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """OpenCV and BLAS use one thread: the workers of `map_ordered` are the parallelism.

    It also makes results the same on every machine: OpenCV's DIS flow depends on its threads.
    """
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(1):
            yield
    finally:
        cv2.setNumThreads(before)
