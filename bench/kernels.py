"""Time the operations on device arrays: ``python -m bench.kernels --help``.

Every answer is compared with the NumPy reference first; then one warm-up, then the repetitions of
all contenders of a case take turns, so that a busy machine is busy for all of them. Transfers are
not included. The table gives the median, the spread (quartiles) and the ratio to the best peer.
"""

import argparse
import json
import os
import platform
import sys
import time
from importlib.metadata import version

import numpy as np

from bench import cases, peers
from mmmgpu.backends import get_backend


def contenders(case, names):
    """{name: a function that computes the case and returns NumPy arrays only if asked to}."""
    runs = {name: on_backend(case, name) for name in names}
    if case.peer:
        peer = getattr(peers, case.peer)
        runs["numba"] = lambda: peer(*case.arrays)
    return runs


def on_backend(case, name):
    k = get_backend(name)
    arrays = [k.to_device(a) for a in case.arrays]
    return lambda: getattr(k, case.operation)(*arrays, *case.scalars)


def frame(chain, name):
    """One frame of synthesis without leaving the device."""
    k = get_backend(name)
    given = (chain.residual, chain.flows, chain.images, chain.weights)
    residual, flows, images, weights = (k.to_device(a) for a in given)

    def run():
        moved = k.fill_holes(*k.forward_warp(residual, flows), 0.01)
        return k.blend(k.fill_holes(*k.forward_warp(images, moved), 0.01), weights)

    return run


def difference(name, actual, desired):
    """The largest difference of any output, as a share of that output's scale."""
    to_host = np.asarray if name == "numba" else get_backend(name).to_host
    pairs = zip(as_tuple(actual), as_tuple(desired), strict=True)
    return max(float(np.abs(to_host(a) - d).max() / np.abs(d).max()) for a, d in pairs)


def as_tuple(result):
    return result if isinstance(result, tuple) else (result,)


def measure(runs, desired, repeat):
    """{contender: record} of one case; the contenders take turns."""
    errors = {name: difference(name, run(), desired) for name, run in runs.items()}
    wrong = {name: e for name, e in errors.items() if e > 1e-5 and name != "numba"}
    if wrong:
        raise SystemExit(f"not equal to the reference, so not timed: {wrong}")
    seconds = {name: [] for name in runs}
    for _ in range(repeat):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: record(1e3 * np.array(s), errors[name]) for name, s in seconds.items()}


def record(ms, error):
    low, median, high = np.percentile(ms, [25, 50, 75])
    return {
        "median_ms": round(median, 2),
        "quartiles_ms": [round(low, 2), round(high, 2)],
        "best_ms": round(ms.min(), 2),
        "error": error,
    }


def metadata():
    return {
        "cpu": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 0,
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        **{name: version(name) for name in ("numpy", "warp-lang", "pyopencl", "numba")},
    }


def report(name, records):
    for contender, r in records.items():
        low, high = r["quartiles_ms"]
        line = f"{name:32}{contender:8}{r['median_ms']:10.2f} ms   {low:.2f} .. {high:.2f}"
        if "numba" in records and contender != "numba":
            line += f"   {r['median_ms'] / records['numba']['median_ms']:.2f} x numba"
        print(line, flush=True)


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--backend", action="append", help="default: warp and opencl")
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--json", help="write the results here")
    options = parser.parse_args(arguments)
    names = options.backend or ["warp", "opencl"]

    results = {"metadata": metadata(), "repeat": options.repeat, "cases": {}}
    for make in cases.CASES:
        case = make(np.random.default_rng(0))
        desired = on_backend(case, "numpy")()
        records = measure(contenders(case, names), desired, options.repeat)
        results["cases"][case.name] = records
        report(case.name, records)
    chain = cases.chain(np.random.default_rng(0))
    runs = {name: frame(chain, name) for name in names}
    results["cases"]["frame 46x160x192"] = measure(runs, frame(chain, "numpy")(), options.repeat)
    report("frame 46x160x192", results["cases"]["frame 46x160x192"])
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(results, file, indent=1)


if __name__ == "__main__":
    main(sys.argv[1:])
