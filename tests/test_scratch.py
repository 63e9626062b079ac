"""Scratch of many threads of the host, any of which may take that of the others."""

import sys
import threading

import pytest

from mmmgpu.backends.scratch import Scratch


@pytest.fixture
def restless():
    """Threads change between any two lines."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def test_what_a_thread_keeps_is_its_own_until_given_up():
    scratch = Scratch()
    kept = scratch.of_this_thread()
    assert scratch.of_this_thread() is kept
    assert not scratch.give_up()
    kept.arrays["sums"] = 1, [], []
    assert scratch.give_up()
    assert kept.arrays == {}
    assert not scratch.give_up()


def test_threads_may_begin_while_another_takes_what_is_kept(restless):
    scratch, over = Scratch(), threading.Event()
    started = []

    def begin():
        for _ in range(300):
            thread = threading.Thread(target=lambda: started.append(scratch.of_this_thread()))
            thread.start()
            thread.join()
        over.set()

    beginner = threading.Thread(target=begin)
    beginner.start()
    while not over.is_set():
        scratch.give_up()
    beginner.join()
    assert len(set(started)) == 300
