"""How the time of the main work grows with pixels, prototypes, frames, corpus length and threads.

Growth is the exponent of the power law through the best times, a straight line in logarithms: 1 is
linear. Threads are tried in processes of their own, for an OpenCL driver decides on its threads
when it is loaded.
"""

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from mmmgpu.backends import default_threads
from mmmgpu.bench.cases import scan
from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates
from mmmgpu.bench.kernels import on_backend
from mmmgpu.bench.pictures import synthesis
from mmmgpu.bench.timing import timed
from mmmgpu.errors import InputError

TURNS = 5
COMPUTE_BOUND = ("splat", "scan", "rbf")
PARALLEL = (*COMPUTE_BOUND, "blend", "sample")


def pictures_of(name, prototypes=16, side=128, frames=4):
    """Synthesis of so many frames, to be timed."""
    coordinates = drawn_coordinates(prototypes, frames)
    return synthesis(drawn_basis(prototypes, side), coordinates, name).load()


def scan_of(name, rows):
    """A distance scan of so many rows of the corpus, to be timed."""
    case = scan(np.random.default_rng(0), queries=16, corpus=rows, points=4096)
    return on_backend(case, name).load()


AXES = {  # what grows: sizes, what is timed, what is counted
    "pixels": ((64, 128, 256), lambda name, n: pictures_of(name, side=n), lambda n: n * n),
    "prototypes": ((8, 16, 32), lambda name, n: pictures_of(name, prototypes=n), int),
    "frames": ((4, 8, 16, 32), lambda name, n: pictures_of(name, frames=n, side=96), int),
    "corpus rows": ((128, 512, 2048), scan_of, int),
}


def measure_growth(backends):
    """For every axis and backend: sizes, best times [ms] and the exponent."""
    return {axis: {name: grown(axis, name) for name in backends} for axis in AXES}


def grown(axis, name):
    """Sizes in turns, so that all of them see the same load."""
    sizes, make, count = AXES[axis]
    runs = [make(name, size) for size in sizes]
    for run in runs:
        run()
    best = np.min([[timed(run)[0] for run in runs] for _ in range(TURNS)], axis=0)
    counts = [count(size) for size in sizes]
    exponent = float(np.polyfit(np.log(counts), np.log(best), 1)[0])
    ms = [float(f"{1e3 * t:.4g}") for t in best]
    return {"counts": counts, "best_ms": ms, "exponent": round(exponent, 3)}


def measure_threads(backends, *, rounds=2):
    """How many times faster more threads are than one: the best times of each, and of a copy."""
    counts = up_to(default_threads())
    made = {n: [] for n in counts}
    for _ in range(rounds):
        for n in counts:
            made[n].append(in_a_process(backends, n))
    best = {n: best_of(results) for n, results in made.items()}
    gains = {key: [round(best[1][key] / best[n][key], 2) for n in counts] for key in best[1]}
    return {"counts": counts, "gain": gains}


def up_to(threads):
    """1, 2, 4, ... and so many threads."""
    return [*(1 << i for i in range(threads.bit_length()) if 1 << i < threads), threads]


def in_a_process(backends, threads):
    """The results of some kernels with so many threads."""
    call = [sys.executable, "-m", "mmmgpu", "bench", "--quick", "--part", "kernels"]
    call += [f"--only={key}" for key in PARALLEL] + [f"--backend={name}" for name in backends]
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "results.json"
        environment = os.environ | {"MMMGPU_THREADS": str(threads)}
        call += ["--json", str(out)]
        done = subprocess.run(call, env=environment, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InputError(f"with {threads} threads: {done.stderr.strip()}")
        return json.loads(out.read_text(encoding="utf-8"))


def best_of(results):
    """The best seconds of every contender, and those of a copy of a GB."""
    found = {"copy": min(1 / r["machine"]["copy_gb_per_s"] for r in results)}
    for key in results[0]["works"]:
        for who in results[0]["works"][key]["contenders"]:
            rows = [r["works"][key]["contenders"][who] for r in results]
            if "first_ms" in rows[0]:  # the reference has one thread
                found[f"{key}, {who}"] = min(row["best_ms"] for row in rows)
    return found
