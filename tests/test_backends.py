"""Names, devices, threads, damaged caches, and chains that stay on the device."""

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mmmgpu import backends
from mmmgpu.backends import BACKENDS, default_threads, get_backend, list_devices, opencl
from mmmgpu.errors import InputError

EVERYTHING = """
import hashlib, sys
import numpy as np
from mmmgpu import operations as o
rng = np.random.default_rng(0)
field = rng.normal(0, 1, (5, 33, 40, 6)).astype(np.float32)
flow = rng.normal(0, 3, (5, 33, 40, 2)).astype(np.float32)
backend = sys.argv[1]
warped, weight = o.forward_warp(field, flow, backend=backend)
alone, _ = o.forward_warp(field[0], flow[0], backend=backend)
filled = o.fill_holes(warped, weight, threshold=0.3, backend=backend)
blended = o.blend(filled, rng.random((3, 5)), backend=backend)
products = o.normal_equations(filled, field[0], backend=backend)
sampled = o.sample(filled, flow * 9, backend=backend)
rows = field.reshape(5, -1, 6)
scanned = o.distance_scan(rows, np.tile(rows, (9, 1, 1)), rng.random(1320), backend=backend)
plane = [[1, 2, 3], [4, 5, 6]]
mapped = o.evaluate_rbf(flow * 9, rows[0, :7, :2], rows[1, :7, :2], plane, 0.3, backend=backend)
results = warped, weight, alone, filled, blended, *products, sampled, scanned, mapped
print(hashlib.sha256(b"".join(r.tobytes() for r in results)).hexdigest())
"""


ONE_OPERATION = """
import sys
import numpy as np
from mmmgpu import operations as o
field = np.arange(60).reshape(3, 4, 5)
print(o.sample(field, np.random.default_rng(0).normal(2, 2, (9, 2)), backend=sys.argv[1]).tobytes())
"""


def run(program, *arguments, **environment):
    """Standard output of a Python program in a process of its own, which must succeed."""
    done = subprocess.run(
        [sys.executable, "-c", program, *map(str, arguments)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@cache
def with_all_threads(backend):
    """What `EVERYTHING` says with the threads that there are."""
    return run(EVERYTHING, backend)


def on_device(k, *arrays):
    return [k.to_device(np.ascontiguousarray(a, np.float32)) for a in arrays]


def test_an_unknown_backend_lists_the_known_ones():
    with pytest.raises(InputError, match=r"'cuda'; choose one of \['numpy', 'opencl', 'warp'\]"):
        get_backend("cuda")


@pytest.mark.parametrize("name", BACKENDS)
def test_an_unknown_device_is_an_error_that_names_it(name):
    with pytest.raises(InputError, match=f"{name}.*no.such"):
        get_backend(f"{name}:no:such")


@pytest.mark.parametrize("device", ["cuda", "cuda:0"])
def test_a_cuda_device_where_there_is_none_is_an_error_that_lists_those_present(device):
    program = """
import sys
from mmmgpu.backends import get_backend
from mmmgpu.errors import InputError
try:
    get_backend(sys.argv[1])
except InputError as error:
    print(error)
"""
    said = run(program, f"warp:{device}", CUDA_VISIBLE_DEVICES="")
    assert said == f"there is no device 'warp:{device}'; present: warp:cpu\n"


@pytest.mark.parametrize(("name", "explicit"), [("warp", "warp:cpu"), ("opencl", "opencl:0:0")])
def test_a_device_may_be_named(name, explicit):
    k = get_backend(explicit)
    (array,) = on_device(k, np.arange(6).reshape(1, 2, 3))
    assert_array_equal(k.to_host(array), np.arange(6).reshape(1, 2, 3))
    assert type(k) is type(get_backend(name))


@pytest.mark.parametrize("name", BACKENDS)
@pytest.mark.parametrize("part", [np.s_[:, :, ::2], np.s_[::2], np.s_[:, ::-1], np.s_[..., :1]])
def test_a_strided_array_is_read_as_it_is(name, part):
    """As fancy indexing of a reshaped picture gives it, too."""
    k = get_backend(name)
    whole = np.random.default_rng(0).random((4, 6, 8, 3)).astype(np.float32)
    weights = np.eye(len(whole[part]), dtype=np.float32)
    blended = k.blend(k.to_device(whole[part]), k.to_device(weights))
    assert_allclose(k.to_host(blended), whole[part], rtol=0, atol=1e-6)
    some = whole.reshape(4, -1, 3)[:, np.array([3, 1, 40])]
    one = np.ones(3, np.float32)
    apart = k.distance_scan(k.to_device(some), k.to_device(some.copy()), k.to_device(one))
    assert_allclose(np.diag(k.to_host(apart)), 0, rtol=0, atol=1e-6)


def test_garbage_is_looked_for_again_once_a_backend_is_imported(monkeypatch, tmp_path):
    source = (
        "import gc\nseen = gc.isenabled()\ndef list_devices():\n    return {'seen': str(seen)}\n"
    )
    (tmp_path / "backend_that_looks.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(BACKENDS, "looking", "backend_that_looks")
    assert gc.isenabled()
    assert list_devices("looking") == {"seen": "False"}
    assert gc.isenabled()


def test_what_a_backend_imports_is_old(monkeypatch, tmp_path):
    """The next searches for garbage pass it by, and what others froze stays frozen."""
    source = "made = [[] for _ in range(1000)]\ndef list_devices():\n    return {}\n"
    monkeypatch.syspath_prepend(tmp_path)
    for name in ("old_backend", "old_backend_where_something_is_frozen"):
        (tmp_path / f"{name}.py").write_text(source)
        monkeypatch.setitem(BACKENDS, name, name)
    list_devices("old_backend")
    young = [*gc.get_objects(generation=0), *gc.get_objects(generation=1)]
    assert not any(known is sys.modules["old_backend"].made for known in young)
    assert gc.get_freeze_count() == 0
    gc.freeze()
    try:
        frozen = gc.get_freeze_count()
        list_devices("old_backend_where_something_is_frozen")
        assert gc.get_freeze_count() > frozen / 2
    finally:
        gc.unfreeze()


def test_no_part_of_a_launch_outlives_one_that_is_interrupted():
    """It would write to arrays that are freed by then."""
    begun, over = threading.Event(), []

    def work(first, _):
        if first == 0:
            begun.wait()
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.3)
        over.append(first)

    with pytest.raises(KeyboardInterrupt):
        get_backend("warp", 2).split(2, work)
    assert over == [1]


def test_a_library_that_is_missing_says_what_to_install(monkeypatch):
    monkeypatch.setitem(backends.BACKENDS, "absent", "mmmgpu_no_such_module")
    with pytest.raises(InputError, match=r"needs 'mmmgpu_no_such_module'.*pip install"):
        get_backend("absent")


@pytest.mark.parametrize("bad", ["0", "-1", "two"])
def test_a_bad_number_of_threads_in_the_environment_is_an_error(monkeypatch, bad):
    monkeypatch.setenv("MMMGPU_THREADS", bad)
    with pytest.raises(InputError, match=f"MMMGPU_THREADS .* got '{bad}'"):
        default_threads()


def test_the_environment_sets_the_threads(monkeypatch):
    monkeypatch.setenv("MMMGPU_THREADS", "3")
    assert default_threads() == 3
    with pytest.raises(InputError, match="threads must be at least 1, got 0"):
        get_backend("warp", 0)


@pytest.mark.parametrize("variable", ["MMMGPU_THREADS", "POCL_MAX_PTHREAD_COUNT"])
def test_the_opencl_driver_obeys_too(variable):
    get_backend("opencl")  # whose driver has read its environment: a child must not inherit that
    program = "from mmmgpu.backends import get_backend; print(get_backend('opencl').workers)"
    assert run(program, **{variable: "1"}) == "1\n"


@pytest.mark.parametrize(
    ("cores", "of", "threads", "pinned"),
    [({0, 1}, 2, 2, True), ({0, 1}, 2, 1, False), ({1, 2}, 2, 2, False), ({0, 1}, 4, 2, False)],
)
def test_threads_of_opencl_are_pinned_where_they_have_the_whole_machine(
    monkeypatch, cores, of, threads, pinned
):
    monkeypatch.setattr(opencl.sys, "platform", "linux")
    monkeypatch.setattr(opencl.os, "sched_getaffinity", lambda _: cores, raising=False)
    monkeypatch.setattr(opencl.os, "cpu_count", lambda: of)
    assert bool(opencl._pinned(threads)) is pinned
    monkeypatch.setenv("POCL_MAX_PTHREAD_COUNT", str(threads))
    assert not opencl._pinned(threads)


@pytest.mark.skipif(not opencl._pinned(default_threads()), reason="not all cores, or not Linux")
def test_a_pinned_thread_of_opencl_has_one_core():
    program = """
import os
from mmmgpu.backends import get_backend
get_backend("opencl")
cores = [os.sched_getaffinity(int(thread)) for thread in os.listdir("/proc/self/task")]
print(sorted(core for own in cores if len(own) == 1 for core in own))
"""
    assert run(program) == f"{[*range(default_threads())]}\n"


@pytest.mark.parametrize("variable", ["MMMGPU_THREADS", "POCL_MAX_PTHREAD_COUNT"])
def test_the_same_bits_with_any_number_of_threads(backend, variable):
    with ThreadPoolExecutor(2) as pool:
        answers = pool.map(lambda n: run(EVERYTHING, backend, **{variable: n}), "125")
        assert {*answers} == {with_all_threads(backend)}


def test_nothing_but_results_on_standard_output(backend):
    assert len(with_all_threads(backend).split()) == 1


def test_a_chain_of_operations_stays_on_the_device(backend):
    rng = np.random.default_rng(0)
    residual, flow, points = rng.normal(0, 2, (3, 6, 20, 30, 2))
    images, weights = rng.random((6, 20, 30, 3)), rng.random((1, 6))

    def chain(name):
        k = get_backend(name)
        r, f, i, w, p = on_device(k, residual, flow, images, weights, points.reshape(6, -1, 2))
        moved = k.fill_holes(*k.forward_warp(r, f), 0.01)
        warped = k.fill_holes(*k.forward_warp(i, moved), 0.01)
        return k.to_host(k.blend(warped, w)), k.to_host(k.sample(warped, p))

    for actual, desired in zip(chain(backend), chain("numpy"), strict=True):
        assert_allclose(actual, desired, rtol=0, atol=1e-5 * np.abs(desired).max())


def test_every_output_is_written_and_no_scratch_is_read_before(backend, monkeypatch):
    k = get_backend(backend)
    rng = np.random.default_rng(0)
    field, flow = on_device(k, rng.normal(0, 1, (9, 7, 6, 5)), rng.normal(0, 3, (9, 7, 6, 2)))
    weights, rows, shares = on_device(
        k, rng.random((2, 9)), rng.normal(0, 1, (9, 42, 5)), rng.random(42)
    )
    centres, plane = on_device(k, rng.normal(0, 1, (19, 2)), rng.normal(0, 1, (2, 3)))
    (one,) = on_device(k, rng.normal(0, 1, (42, 5)))

    def everything():
        warped, weight = k.forward_warp(field, flow)
        filled = k.fill_holes(warped, weight, 0.4)
        rest = k.blend(filled, weights), k.distance_scan(rows, rows, shares)
        products = k.normal_equations(rows, one)
        mapped = k.evaluate_rbf(centres, centres, centres, plane, 0.1)
        return [k.to_host(a).copy() for a in (warped, weight, filled, *rest, products, mapped)]

    clean = everything()
    empty = type(k).empty

    def poisoned(self, *shape, dtype=np.float32):
        array = empty(self, *shape, dtype=dtype)
        if hasattr(array, "fill_"):
            array.fill_(-77777)
        else:
            cl.enqueue_fill_buffer(
                k.queue, array.data, dtype(-77777), 0, array.size * np.dtype(dtype).itemsize
            )
        return array

    monkeypatch.setattr(type(k), "empty", poisoned)
    for actual, desired in zip(everything(), clean, strict=True):
        assert_array_equal(actual, desired)


def test_what_is_fetched_keeps_what_it_shows_alive(backend):
    """An operation may return its input, whose memory may be that of an array nobody holds."""
    k, given = get_backend(backend), np.full((3, 20), 7, np.float32)
    fetched, alive = k.to_host(k.to_device(given)), weakref.ref(given)
    shared = np.shares_memory(fetched, given)
    del given
    gc.collect()
    assert not shared or alive() is not None
    assert_array_equal(fetched, np.full((3, 20), 7))


def test_device_operations_may_be_called_from_many_threads(backend):
    k = get_backend(backend)
    rng = np.random.default_rng(0)
    given = [on_device(k, rng.random((2, n, n, 3)), np.ones((1, n, n, 2))) for n in range(3, 11)]

    def warp(i):
        return k.to_host(k.forward_warp(*given[i % len(given)])[0])

    alone = [warp(i) for i in range(len(given))]
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)  # threads change between any two lines
    try:
        with ThreadPoolExecutor(4) as pool:
            results = list(pool.map(warp, range(400)))
    finally:
        sys.setswitchinterval(interval)
    for i, result in enumerate(results):
        assert_array_equal(result, alone[i % len(given)])


def test_a_field_without_holes_is_returned_as_it_is(backend):
    k = get_backend(backend)
    field, weight = on_device(k, np.ones((2, 3, 4, 2)), np.ones((2, 3, 4)))
    assert k.fill_holes(field, weight, 0.5) is field


WARP_CACHE = """
import sys, warp
warp.config.kernel_cache_dir = sys.argv[2]
"""


def test_a_damaged_pocl_cache_is_not_read(tmp_path):
    whole = run(ONE_OPERATION, "opencl", POCL_CACHE_DIR=str(tmp_path), POCL_KERNEL_CACHE="1")
    damaged = list(tmp_path.rglob("*.so"))
    assert damaged
    for path in damaged:
        path.write_bytes(b"\xff" * 50)
    assert run(ONE_OPERATION, "opencl", POCL_CACHE_DIR=str(tmp_path)) == whole


def test_first_use_by_four_processes_at_once_with_an_empty_cache(backend, family, tmp_path):
    setup = WARP_CACHE if family == "warp" else ""
    with ThreadPoolExecutor(4) as pool:
        place = {"XDG_CACHE_HOME": str(tmp_path)}
        program = setup + ONE_OPERATION
        answers = set(pool.map(lambda _: run(program, backend, tmp_path, **place), range(4)))
    assert len(answers) == 1


def test_no_kernel_leaves_its_arrays(tmp_path):
    """Warp checks every index in its debug mode, and aborts.

    On one thread: in debug mode only, Warp's own tile storage is shared by all threads.
    """
    debug = WARP_CACHE + "warp.config.mode = 'debug'\n"
    assert run(debug + EVERYTHING, "warp", tmp_path, MMMGPU_THREADS="1") == with_all_threads("warp")


def test_a_forked_child_has_threads_of_its_own():
    fork = """
import os
get = "import numpy as np; from mmmgpu import operations as o; "
get += "o.blend(np.ones((3, 64, 64, 3)), np.ones(3), backend='warp')"
exec(get)
child = os.fork()
if child == 0:
    exec(get)
    os._exit(5)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
    assert run(fork, MMMGPU_THREADS="2") == "5\n"


def test_a_backend_that_cannot_load_fails_the_tests(tmp_path):
    """A machine without the library must not pass by testing nothing."""
    for name in ("conftest.py", "test_kernel_twins.py"):
        (tmp_path / name).write_text((Path(__file__).parent / name).read_text())
    (tmp_path / "test_one.py").write_text("def test_one(backend):\n    assert backend\n")
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_one.py"]
    done = subprocess.run(
        [*tests, "--backend", "opencl:9:9"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent)},
        capture_output=True,
        check=False,
    )
    assert done.returncode == 1
    assert b"there is no device 'opencl:9:9'" in done.stdout
