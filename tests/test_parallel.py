import signal
import threading
import time

import cv2
import pytest
from threadpoolctl import threadpool_info

from mmmgpu.parallel import CancelledError, map_ordered, one_thread_each


def test_results_come_in_order_however_long_they_take():
    def slow_first(item, cancelled):
        time.sleep(0.01 * (10 - item) / 10)
        return item * item

    assert list(map_ordered(slow_first, range(10), threads=4)) == [i * i for i in range(10)]


def test_all_threads_work_at_once_and_no_more():
    both = threading.Barrier(2, timeout=10)  # passed only by two workers at a time
    running, most = 0, 0
    lock = threading.Lock()

    def meet(item, cancelled):
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        both.wait()
        with lock:
            running -= 1
        return item

    assert list(map_ordered(meet, range(8), threads=2)) == list(range(8))
    assert most == 2


def test_items_are_taken_few_at_a_time():
    taken = []

    def frames():
        for i in range(1000):
            taken.append(i)
            yield i

    results = map_ordered(lambda item, cancelled: item, frames(), threads=2)
    assert next(results) == 0
    assert len(taken) < 10
    results.close()
    assert len(taken) < 10


def until_cancelled(ended):
    """A worker that goes on until it is told to stop."""

    def work(item, cancelled):
        deadline = time.monotonic() + 20
        while not cancelled() and time.monotonic() < deadline:
            time.sleep(0.002)
        if cancelled():
            ended.append(item)
            raise CancelledError
        return item

    return work


def test_a_failure_reaches_the_caller_and_stops_the_others():
    ended, second_began = [], threading.Event()
    endless = until_cancelled(ended)

    def work(item, cancelled):
        if item == 0:
            assert second_began.wait(10)
            raise ZeroDivisionError("item 0")
        second_began.set()
        return endless(item, cancelled)

    with pytest.raises(ZeroDivisionError, match="item 0"):
        list(map_ordered(work, range(50), threads=3))
    assert ended
    assert set(ended) <= {1, 2, 3}  # the others never began


def test_a_caller_who_leaves_stops_the_workers():
    ended = []
    endless = until_cancelled(ended)

    def work(item, cancelled):
        return item if item == 0 else endless(item, cancelled)

    results = map_ordered(work, range(20), threads=2)
    assert next(results) == 0
    results.close()  # as a loop that is left does
    assert set(ended) <= {1, 2, 3}
    assert 1 in ended


def test_ctrl_c_stops_the_workers():
    ended = []
    main = threading.main_thread().ident
    timer = threading.Timer(0.2, signal.pthread_kill, [main, signal.SIGINT])
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        list(map_ordered(until_cancelled(ended), range(20), threads=2))
    timer.join()
    assert sorted(ended) == [0, 1]


def test_one_thread_each_holds_inside_and_is_undone():
    def limits():
        return {cv2.getNumThreads(), *(pool["num_threads"] for pool in threadpool_info())}

    def fail_inside():
        with one_thread_each():
            seen.append(limits())
            raise ZeroDivisionError

    seen = []
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        with pytest.raises(ZeroDivisionError):
            fail_inside()
        assert seen == [{1}]
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
