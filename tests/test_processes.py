import contextlib
import os
import signal
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mmmgpu.errors import InputError
from mmmgpu.processes import kept_processes, map_out, share_out

WAIT_S = 60  # at most, for another process


@pytest.fixture(autouse=True)
def _children_find_this_file(monkeypatch):
    """What is shared out must be importable; pytest names this module from the project's root."""
    monkeypatch.syspath_prepend(Path(__file__).parents[1])


def counting(folder):
    """Leave one file an item, with as many ticks as it says."""
    prepared = Path(folder) / f"prepared {os.getpid()}"
    prepared.touch(exist_ok=False)

    def work(item, tick):
        print("this must not pass for an answer ...!")
        name, ticks = item
        (Path(folder) / name).touch(exist_ok=False)
        for _ in range(ticks):
            tick()

    return work


def failing(fail, folder):
    """The first item waits for the second to have begun, and fails; the second never ends."""

    def work(item, _):
        begun = Path(folder) / "pid"
        if item == "endless":
            begun.with_suffix(".part").write_text(str(os.getpid()))
            begun.with_suffix(".part").replace(begun)
            time.sleep(10 * WAIT_S)
        end = time.monotonic() + WAIT_S
        while not begun.exists() and time.monotonic() < end:
            time.sleep(0.01)
        fail()

    return work


def refuse():
    raise InputError("clip ü.mp4: is odd!; leave it out.")


def die():
    os._exit(7)


def break_down():
    raise ZeroDivisionError


def surroundings(folder):
    return lambda item, tick: (Path(folder) / item).write_text(os.environ["OMP_NUM_THREADS"])


@pytest.mark.parametrize(("items", "processes", "used"), [(7, 3, 3), (2, 5, 2), (1, 4, 1)])
def test_every_item_is_done_once_and_its_ticks_are_counted(tmp_path, items, processes, used):
    ticks = []
    work = [(f"item {i}", i + 1) for i in range(items)]
    share_out(counting, str(tmp_path), work, processes=processes, advance=ticks.append)
    assert len(list(tmp_path.glob("prepared *"))) == used
    assert sorted(p.name for p in tmp_path.glob("item *")) == [name for name, _ in work]
    assert sum(ticks) == items * (items + 1) // 2
    assert min(ticks) > 0


def test_many_ticks_are_all_counted(tmp_path):
    ticks = []
    share_out(counting, str(tmp_path), [("item", 9999)], processes=1, advance=ticks.append)
    assert sum(ticks) == 9999


def test_nothing_to_do_starts_nothing(tmp_path):
    share_out(counting, str(tmp_path), [], processes=2, advance=lambda n: None)
    assert list(tmp_path.iterdir()) == []


def has_ended(folder):
    """Whether the process of the endless item is gone; it is ended where it is not."""
    pid = int((folder / "pid").read_text())
    ended = gone(pid)
    with contextlib.suppress(ProcessLookupError):
        os.kill(pid, 9)
    return ended


@pytest.mark.parametrize(
    ("fail", "error", "says"),
    [
        (refuse, InputError, r"^clip ü\.mp4: is odd!; leave it out\.$"),
        (die, RuntimeError, "a worker process ended with 7"),
        (break_down, RuntimeError, "a worker process ended with 1"),
    ],
)
@pytest.mark.parametrize("order", [("failing", "endless"), ("endless", "failing")])
def test_a_failure_arrives_and_the_others_are_stopped(tmp_path, fail, error, says, order):
    with pytest.raises(error, match=says):
        share_out(partial(failing, fail), str(tmp_path), order, processes=2, advance=lambda n: None)
    assert has_ended(tmp_path)


def powers(base, exponents, tick):
    """Arrays of so many powers, and which process found them."""
    for _ in exponents:
        tick()
    return np.power(float(base), exponents), os.getpid()


@pytest.mark.parametrize(("processes", "used"), [(1, 1), (2, 2), (9, 3)])
def test_results_come_back_whole_and_in_order(processes, used):
    ticks, items = [], [(0, 1, 2), (), (0.5,)]
    found = map_out(partial(powers, 9), items, processes=processes, advance=ticks.append)
    for (values, _), expected in zip(found, [[1, 9, 81], [], [3]], strict=True):
        np.testing.assert_array_equal(values, expected)
    pids = {pid for _, pid in found}
    assert len(pids) == used
    assert os.getpid() not in pids
    assert sum(ticks) == 4


def tell(item, tick):
    return os.getpid()


def gone(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


def test_kept_processes_do_one_job_after_another():
    def pids(count):
        return map_out(tell, range(count), processes=2, advance=lambda n: None)

    with kept_processes():
        first, second, third = pids(1), pids(5), pids(2)
        assert set(first) < set(second) == set(third)
        assert not any(map(gone, second))
    assert all(map(gone, second))
    assert set(pids(2)).isdisjoint(second)
    assert len(set(pids(1) + pids(1))) == 2


def test_processes_are_kept_until_the_outermost_ends():
    with kept_processes():
        found = []
        for _ in range(2):
            with kept_processes():
                found += map_out(tell, [1, 2], processes=2, advance=lambda n: None)
        assert len(set(found)) == 2
        assert not any(map(gone, found))
    assert all(map(gone, found))


def test_a_kept_process_that_has_died_is_replaced():
    with kept_processes():
        first = map_out(tell, [1, 2], processes=2, advance=lambda n: None)
        os.kill(first[0], signal.SIGKILL)
        os.waitid(os.P_PID, first[0], os.WEXITED | os.WNOWAIT)
        second = map_out(tell, [1, 2], processes=2, advance=lambda n: None)
        assert first[1] in second
        assert first[0] not in second


def test_kept_processes_take_large_jobs():
    large = np.arange(300_000.0)
    with kept_processes():
        for i in range(3):
            found = map_out(partial(powers, i), [large % 3], processes=1, advance=lambda n: None)
            np.testing.assert_array_equal(found[0][0], float(i) ** (large % 3))


@pytest.mark.parametrize("fail", [refuse, die])
def test_a_process_that_fails_is_not_kept(tmp_path, fail):
    order = ("failing", "endless")
    with kept_processes():
        old = map_out(tell, [1, 2], processes=2, advance=lambda n: None)
        with pytest.raises((InputError, RuntimeError), match=r"odd|ended with 7"):
            share_out(
                partial(failing, fail), str(tmp_path), order, processes=2, advance=lambda n: None
            )
        assert has_ended(tmp_path)
        assert all(map(gone, old))
        new = map_out(tell, [1, 2], processes=2, advance=lambda n: None)
        assert set(new).isdisjoint(old)
    assert all(map(gone, new))


def refusing(item, tick):
    refuse()


def test_a_failure_of_one_of_many_arrives(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with pytest.raises(InputError, match="is odd!; leave it out"):
        map_out(refusing, [1, 2, 3], processes=2, advance=lambda n: None)
    assert list(tmp_path.iterdir()) == []


def test_an_error_while_preparing_arrives(tmp_path):
    missing = str(tmp_path / "none")
    with pytest.raises(RuntimeError, match="ended with 1"):
        share_out(counting, missing, [("item", 1)], processes=1, advance=lambda n: None)


def test_an_interrupt_stops_all(tmp_path):
    def interrupt(_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        share_out(ticking, str(tmp_path), ["a", "b"], processes=2, advance=interrupt)
    for pid in tmp_path.glob("pid *"):
        with pytest.raises(ProcessLookupError):
            os.kill(int(pid.name.split()[1]), 0)
    assert list(tmp_path.glob("pid *"))


def ticking(folder):
    (Path(folder) / f"pid {os.getpid()}").touch()

    def work(_, tick):
        tick()
        time.sleep(10 * WAIT_S)

    return work


def test_a_process_has_one_thread_for_each_library(tmp_path):
    share_out(surroundings, str(tmp_path), ["a"], processes=1, advance=lambda n: None)
    assert (tmp_path / "a").read_text() == "1"
