"""The benchmarks: right answers before times, honest counts, and what a comparison calls slower."""

import importlib
import json
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import partial
from itertools import groupby

import cv2
import numpy as np
import pytest
from commands import assert_refused, run_command
from threadpoolctl import threadpool_info

from mmmgpu.backends import BACKENDS, default_threads, get_backend
from mmmgpu.backends.opencl_memory import OwnMemory
from mmmgpu.bench import cases, growth, machine, peers, pipeline, runs, startup, threads
from mmmgpu.bench.charts import draw_growth
from mmmgpu.bench.comparison import compare_runs
from mmmgpu.bench.endurance import measure_endurance
from mmmgpu.bench.kernels import kernel_work, on_backend
from mmmgpu.bench.models import gdlr_work, matching_work, training_work, trajectory_work
from mmmgpu.bench.pictures import analysis_work, mouths_work, synthesis_work
from mmmgpu.bench.tables import other_tables, work_tables
from mmmgpu.bench.targets import judge_targets
from mmmgpu.bench.timing import (
    LEAST,
    SLOW,
    Contender,
    Effort,
    Work,
    as_tuple,
    measure,
    take_turns,
    timed,
)
from mmmgpu.errors import InputError
from mmmgpu.progress import progress

ONCE = Effort(turns=1, seconds=0.0)
OURS = ("opencl", "warp")
PEERS, _ = peers.split_by_presence(peers.LIBRARIES)
SMALL = {
    "splat": {"batch": 2, "height": 24, "width": 20, "channels": 3},
    "fill": {"batch": 2, "height": 15, "width": 18},
    "blend": {"number": 3, "height": 9, "width": 7},
    "blend_large": {"number": 3, "height": 9, "width": 7},
    "equations": {"number": 5, "height": 9, "width": 7},
    "sample": {"height": 12, "width": 17},
    "sample_at_random": {"height": 12, "width": 17},
    "scan": {"queries": 3, "corpus": 7, "points": 40},
    "rbf": {"height": 12, "width": 9, "number": 8},
    "piecewise": {"batch": 2},
}


def small(make):
    return partial(make, **SMALL[make.__name__])


@pytest.mark.parametrize("make", cases.CASES, ids=lambda f: f.__name__)
def test_all_contenders_of_a_kernel_give_the_answer_of_the_reference(make):
    measured = measure(kernel_work(small(make), OURS, PEERS), ONCE)
    found = json.loads(json.dumps(measured))["contenders"]
    assert {*OURS, "reference", "copy"} <= found.keys()
    differences = [row["difference"] for row in found.values() if "difference" in row]
    assert len(differences) == len(found) - 2
    assert max(differences) < 1e-4


@pytest.mark.parametrize("make", cases.CASES, ids=lambda f: f.__name__)
def test_bytes_are_those_of_the_arguments_and_the_answer(make):
    case = small(make)(np.random.default_rng(0))
    answer = kernel_work(small(make), ["numpy"], []).contenders["numpy"].load()()
    arrays = answer if isinstance(answer, tuple) else (answer,)
    first = 4 * case.touched if case.touched else case.arrays[0].nbytes
    assert case.bytes == first + sum(a.nbytes for a in (*case.arrays[1:], *arrays))
    assert case.operations > 0


def test_a_piecewise_warp_reads_the_pixels_around_its_places_alone():
    case = small(cases.piecewise)(np.random.default_rng(0))
    field, vertices, triangles, index, barycentric = case.arrays
    corners = vertices[:, triangles[index]]
    places = (barycentric[..., None] * corners).sum(axis=2).reshape(-1, 2)
    number = len(index)
    near = {
        (n // number, int(y) + i, int(x) + j)
        for n, (x, y) in enumerate(places)
        for i in (0, 1)
        for j in (0, 1)
    }
    assert case.touched == 3 * len(near) < field.size / 4
    blank = np.zeros_like(field)
    blank[tuple(np.transpose([*near]))] = field[tuple(np.transpose([*near]))]
    k = get_backend("numpy")
    np.testing.assert_array_equal(
        k.piecewise_warp(blank, *case.arrays[1:]), k.piecewise_warp(*case.arrays)
    )


@pytest.mark.parametrize(
    "work",
    [
        partial(synthesis_work, OURS, ["opencv"], prototypes=4, side=48, frames=2),
        partial(mouths_work, OURS, prototypes=4, side=48, frames=2),
        partial(analysis_work, OURS, prototypes=6, side=48, frames=2),
        partial(matching_work, OURS, prototypes=4, frames=6, side=32),
        partial(trajectory_work, ["scipy"], seconds=1),
        partial(gdlr_work, seconds=1),
        partial(training_work, seconds=2, dimensions=2, checked=1),
    ],
    ids=lambda work: work.func.__name__,
)
def test_all_contenders_of_a_whole_give_the_answer_of_the_reference(work):
    made = work()
    found = measure(made, ONCE)["contenders"]
    assert found.keys() == {*made.contenders, "reference"}
    ours = [who for who, contender in made.contenders.items() if contender.tolerance is not None]
    assert all(found[who]["difference"] <= made.contenders[who].tolerance for who in ours)
    assert ours


@pytest.mark.parametrize("name", BACKENDS)
def test_what_is_timed_waits_for_the_device(monkeypatch, name):
    """A launch on a GPU returns at once."""
    waited = []

    def wait(k):
        waited.append(k)

    monkeypatch.setattr(type(get_backend(name)), "wait", wait)
    run = on_backend(small(cases.rbf)(np.random.default_rng(0)), name).load()
    waited.clear()
    run()
    assert waited[-1:] == [get_backend(name)]


def test_a_device_with_memory_of_its_own_has_no_share_of_the_processor_s(monkeypatch):
    shared = get_backend("opencl")
    own = replace(shared, memory=OwnMemory(shared.queue))
    monkeypatch.setattr(runs, "get_backend", {"opencl": own, "warp": get_backend("warp")}.get)
    rows = with_shares(run_of(warp=4, opencl=4, numba=5), backends=["warp", "opencl"])
    assert (rows["warp"]["bandwidth"], rows["numba"]["bandwidth"]) == (0.25, 0.2)
    assert not {"bandwidth", "arithmetic"} & rows["opencl"].keys()


def with_shares(results, backends=("warp",), precision="float32"):
    """The rows of a record whose work moves 1 MB and takes 10^6 operations, with their shares."""
    work = results["works"]["blend"]
    work |= {"bytes": 1e6, "operations": 1e6, "precision": precision}
    peaks = {"float32_gflops": 1.0, "float64_gflops": 0.5}
    results |= {"plan": {"backends": backends}}
    results["machine"] |= {"copy_gb_per_s": 1.0} | peaks
    runs.add_shares(results)
    return work["contenders"]


@pytest.mark.parametrize(("precision", "share"), [("float32", 0.25), ("float64", 0.5)])
def test_arithmetic_is_judged_by_the_peak_of_its_precision(precision, share):
    assert with_shares(run_of(warp=4), precision=precision)["warp"]["arithmetic"] == share


def test_a_copy_has_a_share_of_the_bandwidth_alone():
    copied = with_shares(run_of(warp=4, copy=2))["copy"]
    assert copied["bandwidth"] == 0.5
    assert "arithmetic" not in copied


def test_a_wrong_answer_is_not_timed():
    right, wrong = np.array([1.0, 2.0]), np.array([1.0, 2.1])
    contenders = {"fast": Contender(lambda: lambda: wrong, tolerance=1e-3)}
    with pytest.raises(InputError, match=r"sums, fast: differs .* by 5.0e-02"):
        measure(Work("sums", lambda: right, contenders), ONCE)


@pytest.mark.parametrize(
    "make",
    [
        partial(kernel_work, small(cases.scan), ["opencl"], []),
        partial(synthesis_work, ["opencl"], [], prototypes=4, side=48, frames=9),
        partial(mouths_work, ["opencl"], prototypes=4, side=48, frames=9),
        partial(analysis_work, ["opencl"], prototypes=6, side=48, frames=3),
        partial(matching_work, ["opencl"], prototypes=4, frames=6, side=32),
    ],
    ids=["scan", "synthesis", "mouths", "analysis", "matching"],
)
def test_of_every_query_prototype_and_frame_a_wrong_answer_is_not_timed(make):
    work = make()
    right = work.contenders["opencl"]

    def fetch(answer):
        arrays = [np.array(a) for a in as_tuple(right.fetch(answer))]
        for a in arrays:
            a[-1] += 1
        return tuple(arrays)

    wrong = replace(work, contenders={"opencl": replace(right, fetch=fetch)})
    with pytest.raises(InputError, match="differs from the reference"):
        measure(wrong, ONCE)


def test_an_answer_that_is_no_number_is_not_timed():
    contenders = {"fast": Contender(lambda: lambda: np.array([np.nan]), tolerance=1e-3)}
    with pytest.raises(InputError, match="differs"):
        measure(Work("sums", lambda: np.ones(1), contenders), ONCE)


def test_contenders_take_turns():
    order = []
    runs = {name: partial(order.append, name) for name in "ab"}
    seconds = take_turns(runs, Effort(turns=3, seconds=0.0))
    assert [name for name, _ in groupby(order)] == list("ab" * 4)  # the first round is not counted
    assert [s.shape for s in seconds.values()] == [(2, 3), (2, 3)]


@pytest.mark.parametrize(("pause", "once"), [(0, False), (2 * LEAST, True)])
def test_only_a_short_run_is_repeated_within_its_turn(pause, once):
    done = []
    timed(lambda: time.sleep(pause) or done.append(1))
    assert (len(done) == 1) is once


def test_the_processor_s_time_is_that_of_all_threads():
    def spin():
        end = time.thread_time() + 0.05
        while time.thread_time() < end:
            pass

    def three():
        threads = [threading.Thread(target=spin) for _ in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return np.ones(1)

    work = Work("w", lambda: np.ones(1), {"a": Contender(lambda: three)})
    assert measure(work, ONCE)["contenders"]["a"]["cpu_ms"] > 149


@pytest.mark.parametrize(("pause", "turns"), [(0.0, 3), (SLOW + 0.1, 1)])
def test_a_quick_reference_takes_turns(pause, turns):
    """So that an hour which gives little is one for both."""
    runs = {"a": Contender(lambda: lambda: np.ones(1), tolerance=0)}
    work = Work("ones", lambda: time.sleep(pause) or np.ones(1), runs)
    found = measure(work, Effort(turns=3, seconds=0.0, most=3))["contenders"]
    assert len(found["a"]["turns_ms"]) == 3
    assert len(found["reference"]["turns_ms"]) == turns


def test_the_reference_s_part_counts_for_the_whole():
    runs = {"a": Contender(lambda: lambda: np.ones(4))}
    work = Work("w", lambda: np.ones(2), runs, part=1e-6, checked=np.s_[:2])
    found = measure(work, ONCE)["contenders"]
    assert found["reference"]["median_ms"] > 100 * found["a"]["median_ms"]


def test_a_library_that_is_missing_is_named(monkeypatch):
    monkeypatch.setitem(peers.LIBRARIES, "fortran", "peers_fortran")
    present, absent = peers.split_by_presence(peers.LIBRARIES)
    assert absent[-1] == "fortran"
    assert {"numpy", "opencv", "scipy"} <= set(present)


@pytest.fixture
def small_machine(monkeypatch):
    """Its bandwidth and peaks are those of little data: what they are is not the question."""
    monkeypatch.setattr(machine, "COPIED", 1 << 20)
    monkeypatch.setattr(machine, "SIDE", 64)


@pytest.fixture
def one_thread(monkeypatch):
    monkeypatch.setenv("MMMGPU_THREADS", "1")
    yield
    monkeypatch.delenv("MMMGPU_THREADS")
    peers.use_threads(default_threads(), PEERS)


@pytest.mark.usefixtures("one_thread", "small_machine")
def test_libraries_use_the_threads_that_ours_do(monkeypatch):
    used = {}

    def ask(*_):
        used.update(opencv=cv2.getNumThreads())
        used.update({pool["filepath"]: pool["num_threads"] for pool in threadpool_info()})
        if "numba" in PEERS:
            used["numba"] = importlib.import_module("numba").get_num_threads()
        return {}

    monkeypatch.setattr(runs, "measure_startup", ask)
    runs.run_benchmarks(runs.Plan(parts=["startup"], peers=True))
    assert {*used.values()} == {1}


def test_the_reference_in_another_form_is_no_peer():
    rows = run_of(adjoint=4, scipy=8, copy=1, **{"reference": 50, "reference, factor kept": 2})
    rows["works"]["blend"] |= {"items": 1, "unit": "run"}
    for row in rows["works"]["blend"]["contenders"].values():
        row["cpu_ms"] = 1
    ((_, lines),) = work_tables(rows)
    assert lines[0].split()[6:8] == ["12.5", "2.00"]


def run_of(**medians):
    """A record with works of one contender a name, quartiles 2 % around the medians."""
    rows = {
        who: {"median_ms": ms, "quartiles_ms": [0.98 * ms, 1.02 * ms], "turns_ms": [ms]}
        for who, ms in medians.items()
    }
    works = {"blend": {"name": "blend", "contenders": rows}}
    return {"machine": {"cpu": "x", "threads": 2, "commit": "a"}, "works": works}


@pytest.mark.parametrize(
    ("new", "verdict", "times"),
    [
        ({"warp": 10, "numba": 5, "reference": 50}, "-", 1),
        ({"warp": 20, "numba": 10, "reference": 100}, "-", 1),  # so has everything else
        ({"warp": 12, "numba": 5, "reference": 50}, "slower", 1.2),
        ({"warp": 12, "numba": 10, "reference": 100}, "faster", 0.6),
        ({"warp": 10.3, "numba": 5, "reference": 50}, "-", 1.03),
    ],
)
def test_slower_is_judged_beyond_noise_and_drift(new, verdict, times):
    (row,) = compare_runs(run_of(warp=10, numba=5, reference=50), run_of(**new))["rows"]
    assert (row["verdict"], row["times"]) == (verdict, pytest.approx(times, abs=1e-3))


def test_overlapping_quartiles_are_noise():
    old, new = run_of(warp=10, numba=5), run_of(warp=14, numba=5)
    new["works"]["blend"]["contenders"]["warp"]["quartiles_ms"] = [10.1, 15]
    assert compare_runs(old, new)["rows"][0]["verdict"] == "-"


def test_works_of_other_sizes_are_not_compared():
    other = run_of(warp=10)
    other["works"]["blend"]["name"] = "a larger blend"
    with pytest.raises(InputError, match="nothing in common"):
        compare_runs(run_of(warp=10), other)


OTHERS = {
    "growth": lambda value: {"growth": {"pixels": {"warp": {"exponent": value}}}},
    "threads": lambda value: {"threads": {"gain": {"scan, warp": [1, value]}}},
    "startup": lambda value: {"startup": {"warp": {"empty_cache_s": value, "full_cache_s": value}}},
    "pipeline": lambda value: {"pipeline": {"steps": {"train": {"seconds": value}}}},
}


@pytest.mark.parametrize(
    ("part", "old", "new", "verdict"),
    [
        ("growth", 1.0, 1.2, "slower"),
        ("growth", 1.0, 1.05, "-"),
        ("growth", 0.2, 0.05, "faster"),
        ("threads", 2.0, 1.5, "slower"),
        ("threads", 1.5, 2.0, "faster"),
        ("threads", 2.0, 1.9, "-"),
        ("startup", 1.0, 1.4, "slower"),
        ("startup", 1.0, 1.2, "-"),
        ("pipeline", 9.0, 5.0, "faster"),
    ],
)
def test_what_has_one_value_in_a_run_is_compared_plainly(part, old, new, verdict):
    runs = [{**run_of(), **OTHERS[part](value)} for value in (old, new)]
    found = compare_runs(*runs)["others"]
    assert len(found) == (2 if part == "startup" else 1)
    for row in found:
        assert (row["old"], row["new"], row["verdict"]) == (old, new, verdict)


def test_a_target_is_met_or_not_by_the_best_backend():
    results = run_of(warp=4, opencl=9, numba=5, copy=3.6, **{"numpy peer": 14})
    results["works"]["blend"]["items"] = 1
    results["works"]["splat"] = results["works"]["rbf"] = results["works"]["blend"]
    found = judge_targets(results)
    values = {name: (t["value"], t["met"]) for name, t in found.items()}
    assert values["forward_warp over numba"] == (1.25, False)
    assert values["dense RBF over NumPy"] == (3.5, True)
    assert values["blend, passes over its bytes"] == (1.11, True)
    assert values["backends apart by at most"] == (2.25, False)
    assert "analysis [frames/s]" not in found  # nothing was measured
    results["threads"] = {
        "gain": {"blend, copy": [1, 2], "blend, warp": [1, 1.9], "sample, warp": [1, 3]}
    }
    values = {name: (t["value"], t["met"]) for name, t in judge_targets(results).items()}
    assert values["threads, blend, of a copy's gain"] == (0.95, True)
    assert values["threads, sample"] == (3, True)


def test_a_pass_of_a_large_copy_is_shown_and_not_judged():
    results = run_of(warp=4, opencl=2, copy=2)
    with_shares(results, backends=["warp", "opencl"])
    found = judge_targets({"works": {"blend": results["works"]["blend"] | {"items": 1}}})
    assert found["blend, passes over its bytes"]["value"] == 1
    long = found["blend, passes of a large copy"]
    assert long == {"bound": None, "value": 2, "met": None}  # 1 MB in 2 ms, at 1 GB/s 1 ms
    ((_, _, rows),) = other_tables({"targets": {"long": long}})
    assert rows == [("long", "", 2, "not judged")]


def test_every_work_that_is_timed_with_more_threads_has_a_target():
    gained = {f"{work}, warp": [1, 2] for work in (*threads.COMPUTE_BOUND, *threads.MEMORY_BOUND)}
    gained |= {f"{work}, copy": [1, 2] for work in threads.MEMORY_BOUND}
    found = judge_targets({"works": {}, "threads": {"gain": gained}})
    bounds = [t["bound"] for name, t in found.items() if name.startswith("threads, ")]
    assert bounds.count(">= 1.7") == len(threads.COMPUTE_BOUND)
    assert bounds.count(">= 0.9") == len(threads.MEMORY_BOUND)


def test_the_gain_of_threads_is_that_of_the_faster_backend():
    """The other may gain more because one thread had the worse turns."""
    results = run_of(warp=9, opencl=4)
    results["works"]["scan"] = results["works"]["blend"] | {"items": 1}
    results["threads"] = {"gain": {"scan, warp": [1, 2.5], "scan, opencl": [1, 1.8]}}
    assert judge_targets(results)["threads, distance_scan"]["value"] == 1.8
    del results["works"]["scan"]
    assert judge_targets(results)["threads, distance_scan"]["value"] == 2.5


@pytest.mark.parametrize(
    ("theirs", "value"), [([5, 4.4, 11], 1.1), ([5], 1.25)], ids=["in turns", "one turn"]
)
def test_ratios_are_those_within_a_turn(theirs, value):
    results = run_of(warp=4, numba=5)
    rows = results["works"]["blend"]["contenders"]
    rows["warp"]["turns_ms"], rows["numba"]["turns_ms"] = [1, 4, 10], theirs
    results["works"]["splat"] = results["works"]["blend"] | {"items": 1}
    assert judge_targets(results)["forward_warp over numba"]["value"] == value


@pytest.mark.parametrize("power", [0.5, 1, 2])
def test_the_exponent_of_growth_is_that_of_the_power_law(monkeypatch, power):
    axis = (2, 4, 8), lambda name, n: lambda: n, int
    monkeypatch.setattr(growth, "timed", lambda run: (0.1 * run() ** power, 0))
    assert growth.grown(*axis, "warp", 2)["exponent"] == pytest.approx(power)


def test_a_turn_that_is_lucky_for_one_size_is_not_growth(monkeypatch):
    axis = (2, 4, 8), lambda name, n: lambda: n, int
    lucky = iter([2, 1, *[1] * 100])
    monkeypatch.setattr(growth, "timed", lambda run: (run() / next(lucky), 0))
    assert growth.grown(*axis, "warp", 5)["exponent"] == pytest.approx(1)


SMALL_AXES = {"pages": ((1, 2), lambda name, n: lambda: n, int)}


def test_what_no_backend_does_is_measured_once(monkeypatch):
    monkeypatch.setattr(growth, "AXES", SMALL_AXES)
    monkeypatch.setattr(growth, "HOST", {"frames": SMALL_AXES["pages"]})
    monkeypatch.setattr(growth, "timed", lambda run: (run(), 0))
    found = growth.measure_growth(OURS, 1)
    assert {axis: [*names] for axis, names in found.items()} == {
        "pages": [*OURS],
        "frames": ["ours"],
    }


LENGTHS = {  # of what a work gives for its frames
    "frames, synthesis": len,
    "frames, analysis": lambda answer: len(answer[0]),
    "frames, matching scan": lambda answer: answer.shape[1],
    "frames, trajectory": len,
}


@pytest.mark.parametrize("axis", LENGTHS)
def test_frames_that_grow_are_frames_that_are_made(axis):
    _, make, _ = (growth.AXES | growth.HOST)[axis]
    assert [LENGTHS[axis](make("opencl", n)()) for n in (25, 50)] == [25, 50]


@pytest.mark.usefixtures("small_machine")
@pytest.mark.parametrize(("quick", "turns"), [(True, 3), (False, 11)])
def test_growth_takes_as_many_turns_as_single_works(monkeypatch, quick, turns):
    taken = []
    monkeypatch.setattr(growth, "AXES", SMALL_AXES)
    monkeypatch.setattr(growth, "HOST", {})
    monkeypatch.setattr(growth, "timed", lambda run: (taken.append(run()) or run(), 0))
    monkeypatch.setattr(runs, "measure_threads", lambda *_, **__: {})
    runs.run_benchmarks(runs.Plan(backends=["warp"], parts=["growth"], quick=quick))
    assert taken == turns * [1, 2]


def test_a_copy_reads_and_writes_as_many_bytes_as_it_says(monkeypatch):
    moved = []
    monkeypatch.setattr(machine.np, "copyto", lambda *pair: moved.append([a.nbytes for a in pair]))
    machine.copy_of(2400, threads=3)()
    assert moved == 3 * [[400, 400]]


def test_the_gain_of_threads_is_the_median_of_turns():
    assert threads.gains([[8, 4], [80, 10], [9, 3]]) == [1, 3]


def test_more_threads_take_turns_with_one(monkeypatch):
    monkeypatch.setenv("MMMGPU_THREADS", "2")
    found = threads.measure_threads(["opencl"], works=["blend"], turns=1)
    assert found["counts"] == [1, 2]
    assert found["gain"].keys() == {"copy", "product", "blend, copy", "blend, opencl"}
    assert all(one == 1 < 10 * more for one, more in found["gain"].values())


def test_threads_of_a_work_that_fails_say_why():
    with pytest.raises(InputError, match=r"threads, blend, abacus: .*unknown backend 'abacus'"):
        threads.measure_threads(["abacus"], works=["blend"], turns=1)


def test_charts_say_the_exponents_and_the_gain_of_threads(tmp_path):
    found = {"counts": [1, 2000], "median_ms": [1.0, 2.0], "exponent": 0.125}
    chart = tmp_path / "growth.svg"
    gained = {"counts": [1, 2, 3], "gain": {"scan, warp": [1.0, 1.9, 2.75]}}
    draw_growth({"pixels": {"warp": found}, "frames": {"opencl": found}}, gained, chart)
    drawn = chart.read_text()
    assert "warp: 0.12" in drawn
    assert "scan, warp: 2.75" in drawn
    with pytest.raises(InputError, match=r"must be named \.svg"):
        draw_growth({}, {}, tmp_path / "growth.png")


@pytest.mark.parametrize(
    ("number", "counts"), [(1, [1]), (2, [1, 2]), (6, [1, 2, 4, 6]), (8, [1, 2, 4, 8])]
)
def test_threads_are_tried_in_powers_of_two_and_all(number, counts):
    assert threads.up_to(number) == counts


def test_many_frames_leave_nothing_behind(backend):
    found = measure_endurance([backend], 400, side=32)[backend]
    memory, files = found["resident_mb"], found["open_files"]
    assert len(memory) == 50
    assert max(memory[-10:]) - max(memory[15:25]) < 2
    assert files[-1] == files[10]


def test_a_start_is_the_median_of_those_with_a_full_cache(monkeypatch):
    taken = iter([9.0, 1.0, 3.0, 2.0])
    monkeypatch.setattr(startup, "first_frame", lambda *_: next(taken))
    monkeypatch.setattr(startup, "run_new", lambda *_, **__: '{"blend": 0.5}')
    found = {"empty_cache_s": 9, "full_cache_s": 2, "compiled_s": {"blend": 0.5}}
    assert startup.measure_startup(["warp"], turns=3) == {"warp": found}


@pytest.mark.parametrize(("taken", "compiled"), [([0.3, 0.1], 0.2), ([0.1, 0.11], 0)])
def test_to_compile_is_what_the_first_run_takes_longer(monkeypatch, taken, compiled):
    left = iter(taken)
    monkeypatch.setattr(startup, "seconds", lambda _: next(left))
    assert startup.compiled(None) == compiled


def test_all_operations_are_compiled_in_a_new_process(monkeypatch):
    monkeypatch.setattr(startup, "CASES", [small(make) for make in cases.CASES])
    found = startup.compile_all("numpy")
    operations = {make(np.random.default_rng(0)).operation for make in startup.CASES}
    assert found.keys() == {*operations, "mix_prototypes"}


def test_a_first_frame_is_there_before_its_process_ends(monkeypatch, tmp_path):
    lasting = "import time\nprint(1, flush=True)\ntime.sleep(3)"
    monkeypatch.setattr(startup, "FIRST_FRAME", lasting)
    start = time.perf_counter()
    assert startup.first_frame("numpy", str(tmp_path)) < time.perf_counter() - start - 2


def test_a_first_frame_that_fails_says_why(tmp_path):
    assert startup.first_frame("numpy", str(tmp_path)) > 0.1
    with pytest.raises(InputError, match=r"no first frame on warp:cuda:99: .*there is no device"):
        startup.first_frame("warp:cuda:99", str(tmp_path))


def test_a_profile_names_the_innermost_function_of_ours():
    places = []

    def items():
        places.append(pipeline.place(sys._getframe()))
        yield 1

    assert list(progress(items(), "x", quiet=True)) == [1]
    assert places == ["progress.progress"]
    growth.timed(lambda: next(items()))
    assert places[1] is None  # the benchmarks themselves do not count


def test_a_thread_that_waits_is_not_in_the_profile():
    event = threading.Event()

    def items():
        event.wait()
        yield 1

    thread = threading.Thread(target=lambda: list(progress(items(), "x", quiet=True)), daemon=True)
    thread.start()
    while sys._current_frames()[thread.ident].f_code.co_name != "wait":
        time.sleep(0.001)
    assert pipeline.place(sys._current_frames()[thread.ident]) is None
    event.set()
    thread.join()


@pytest.mark.usefixtures("small_machine")
def test_the_command_writes_a_record_and_compares_it(tmp_path, capfd):
    mmmgpu, out = partial(run_command, capfd), tmp_path / "one.json"
    ended = mmmgpu("bench", "--quick", "--part", "kernels", "--only", "blend", "--json", out)
    assert ended.status == 0
    assert all(f"\n  {name} " in ended.out for name in ("warp", "opencl", "reference"))
    results = json.loads(out.read_text())
    row = results["works"]["blend"]["contenders"]["warp"]
    assert {"median_ms", "quartiles_ms", "first_ms", "transfer_ms", "bandwidth"} <= row.keys()
    assert {"commit", "cpu", "threads", "versions", "copy_gb_per_s"} <= results["machine"].keys()
    ended = mmmgpu("bench", "compare", out, out)
    assert ended.status == 0
    assert "drift of the machine 1" in ended.out
    out.write_text(json.dumps(results | OTHERS["pipeline"](7)))
    ended = mmmgpu("bench", "compare", out, out)
    assert "pipeline [s]" in ended.out


@pytest.mark.usefixtures("small_machine")
def test_a_pipeline_without_a_voice_is_said_and_left_out(monkeypatch):
    monkeypatch.setattr(runs, "is_installed", lambda: False)
    found = runs.run_benchmarks(runs.Plan(parts=["pipeline"]))
    assert "pipeline" not in found
    assert found["absent"] == ["a voice for the pipeline (mmmgpu[tts])"]


def test_the_commit_is_not_that_of_another_project_around(monkeypatch, tmp_path):
    author = ["-c", "user.name=a", "-c", "user.email=a@b.c"]
    for call in (["init", "-q"], [*author, "commit", "-q", "--allow-empty", "-m", "other"]):
        subprocess.run(["git", "-C", tmp_path, *call], check=True, capture_output=True)
    monkeypatch.setattr(machine, "__file__", str(tmp_path / "machine.py"))
    assert machine.commit() is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--part", "poetry"], ["no part 'poetry'", "kernels"]),
        (["--part", "kernels", "--only", "waltz"], ["no work 'waltz'", "splat"]),
        (["--backend", "abacus"], ["unknown backend 'abacus'"]),
    ],
)
def test_what_is_not_there_is_refused_with_what_is(capfd, arguments, words):
    assert_refused(run_command(capfd, "bench", "--quick", *arguments), *words)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"version": 99}'])
def test_a_file_that_is_no_record_is_refused(tmp_path, capfd, text):
    path = tmp_path / "results.json"
    path.write_text(text)
    assert_refused(run_command(capfd, "bench", "compare", path, path), path.name)


def test_every_backend_but_the_reference_has_targets():
    assert {*OURS} == BACKENDS.keys() - {"numpy"}
