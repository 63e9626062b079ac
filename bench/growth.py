"""How the time of the main work grows with pixels, prototypes, frames and corpus length.

Growth is the exponent of the power law through the median times, a straight line in logarithms: 1
is linear. All sizes of an axis take turns. The best time of a size is that of one lucky turn, which
another size may not have had; medians of as many turns scatter less. Frames begin at 8, which one
launch takes. Of fewer, two workers re-orient less than four each together: another kind of work.
"""

from functools import partial

import numpy as np

from mmmgpu.backends import get_backend
from mmmgpu.bench import cases
from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates
from mmmgpu.bench.kernels import on_backend
from mmmgpu.bench.models import FPS, gdlr_work, matching_work, training_work, trajectory_work
from mmmgpu.bench.pictures import analysis, basis_and_mouths, synthesis
from mmmgpu.bench.timing import timed


def pictures_of(name, prototypes=16, side=128, frames=4):
    """Synthesis of so many frames, to be timed."""
    coordinates = drawn_coordinates(prototypes, frames)
    return synthesis(drawn_basis(prototypes, side), coordinates, name).load()


def analyses_of(name, prototypes=16, side=128, frames=2):
    """Analysis of so many frames, to be timed."""
    return analysis(*basis_and_mouths(prototypes, side, frames), get_backend(name, 1)).load()


def matching_of(name, frames):
    """The matching scan of so many frames, to be timed."""
    work = matching_work([name], prototypes=16, frames=frames, side=64)
    return work.contenders[name].load()


def solves(make, who):
    """Makes one of `bench.models` on the host to be timed, of so many frames."""

    def of(_, frames):
        return make(seconds=frames // FPS).contenders[who].load()

    return of


def operation(make, *sizes, **fixed):
    """Makes an operation to be timed: a case of which the arguments `sizes` are what grows."""

    def of(name, n):
        case = make(np.random.default_rng(0), **dict.fromkeys(sizes, n), **fixed)
        return on_backend(case, name).load()

    return of


def square(n):
    """Pixels of a picture of that side."""
    return n * n


SIDES, NUMBERS = (128, 256, 512), (8, 16, 32)
LONG = (750, 1500, 3000)  # frames
SIDE = "height", "width"
AXES = {  # what grows, of which work: sizes, what is timed, what is counted
    "pixels, synthesis": (SIDES, lambda name, n: pictures_of(name, side=n), square),
    "prototypes, synthesis": (NUMBERS, lambda name, n: pictures_of(name, prototypes=n), int),
    "frames, synthesis": (
        (8, 32, 64),
        lambda name, n: pictures_of(name, frames=n, side=96),
        int,
    ),
    "pixels, analysis": (SIDES, lambda name, n: analyses_of(name, side=n), square),
    "frames, analysis": (
        (4, 8, 16),
        lambda name, n: analyses_of(name, frames=n, side=96),
        int,
    ),
    "prototypes, analysis": (NUMBERS, lambda name, n: analyses_of(name, prototypes=n), int),
    "pixels, forward_warp": (SIDES, operation(cases.splat, *SIDE, batch=16), square),
    "pixels, fill_holes": (SIDES, operation(cases.fill, *SIDE, batch=16), square),
    "pixels, blend": (SIDES, operation(cases.blend, *SIDE), square),
    "pixels, normal_equations": (SIDES, operation(cases.equations, *SIDE), square),
    "images, normal_equations": (
        NUMBERS,
        operation(cases.equations, "number"),
        int,
    ),
    "pixels, sample": ((256, 512, 1024), operation(cases.sample, *SIDE), square),
    "corpus rows, distance_scan": (
        (128, 512, 2048),
        operation(cases.scan, "corpus", queries=16, points=4096),
        int,
    ),
    "pixels, evaluate_rbf": (SIDES, operation(cases.rbf, *SIDE), square),
    "pictures, piecewise_warp": ((4, 16, 64), operation(cases.piecewise, "batch"), int),
    "frames, matching scan": ((200, 400, 800), matching_of, int),
}
HOST = {  # the same of what no backend does
    "frames, trajectory": (LONG, solves(partial(trajectory_work, ()), "ours"), int),
    "frames, GDLR gradient": (LONG, solves(gdlr_work, "adjoint"), int),
    "frames, training gradient": (LONG, solves(training_work, "adjoint"), int),
}
LINEAR = ("pixels", "frames", "pictures", "corpus rows")  # with what the time is to grow so


def measure_growth(backends, turns):
    """For every axis and backend: sizes, median times [ms] and the exponent."""
    found = {axis: {n: grown(*AXES[axis], n, turns) for n in backends} for axis in AXES}
    return found | {axis: {"ours": grown(*HOST[axis], "ours", turns)} for axis in HOST}


def grown(sizes, make, count, name, turns):
    """Sizes in turns, so that all of them see the same load."""
    runs = [make(name, size) for size in sizes]
    for run in runs:
        run()
    typical = np.median([[timed(run)[0] for run in runs] for _ in range(turns)], axis=0)
    counts = [count(size) for size in sizes]
    exponent = float(np.polyfit(np.log(counts), np.log(typical), 1)[0])
    ms = [float(f"{1e3 * t:.4g}") for t in typical]
    return {"counts": counts, "median_ms": ms, "exponent": round(exponent, 3)}
