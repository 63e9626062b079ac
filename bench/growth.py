"""How the time of the main work grows with pixels, prototypes, frames and corpus length.

Growth is the exponent of the power law through the median times, a straight line in logarithms: 1
is linear. All sizes of an axis take turns. The best time of a size is that of one lucky turn, which
another size may not have had; medians of as many turns scatter less. Frames begin at 8, which one
launch takes. Of fewer, two workers re-orient less than four each together: another kind of work.
"""

import numpy as np

from mmmgpu.bench.cases import scan
from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates
from mmmgpu.bench.kernels import on_backend
from mmmgpu.bench.pictures import synthesis
from mmmgpu.bench.timing import timed


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
    "frames": ((8, 16, 32, 64), lambda name, n: pictures_of(name, frames=n, side=96), int),
    "corpus rows": ((128, 512, 2048), scan_of, int),
}


def measure_growth(backends, *, turns=15):
    """For every axis and backend: sizes, median times [ms] and the exponent."""
    return {axis: {name: grown(axis, name, turns) for name in backends} for axis in AXES}


def grown(axis, name, turns):
    """Sizes in turns, so that all of them see the same load."""
    sizes, make, count = AXES[axis]
    runs = [make(name, size) for size in sizes]
    for run in runs:
        run()
    typical = np.median([[timed(run)[0] for run in runs] for _ in range(turns)], axis=0)
    counts = [count(size) for size in sizes]
    exponent = float(np.polyfit(np.log(counts), np.log(typical), 1)[0])
    ms = [float(f"{1e3 * t:.4g}") for t in typical]
    return {"counts": counts, "median_ms": ms, "exponent": round(exponent, 3)}
