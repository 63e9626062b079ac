"""What more threads gain over one, beside what the machine itself gains by them.

Each number of threads has a process of its own, for an OpenCL driver decides on its threads when it
is loaded. The processes take turns, and what is reported is the median of the ratios within a turn:
a machine that is busy for a while is busy for all of them. A process times what each line of its
standard input names, and answers with the seconds: ``python -m mmmgpu.bench.threads``.
"""

import os
import subprocess
import sys

import numpy as np
from threadpoolctl import threadpool_limits

from mmmgpu.backends import default_threads
from mmmgpu.bench import cases
from mmmgpu.bench.kernels import on_backend
from mmmgpu.bench.machine import COPIED, copy_of, product
from mmmgpu.bench.pictures import picture_works
from mmmgpu.bench.timing import COPY, timed
from mmmgpu.errors import InputError

COMPUTE_BOUND = (
    *("splat", "fill", "equations", "sample", "scan", "rbf", "piecewise"),
    *("synthesis", "analysis"),
)
MEMORY_BOUND = ("blend",)  # beside a copy of as many bytes
MACHINE = {"copy": lambda: copy_of(2 * COPIED, default_threads()), "product": product}


def measure_threads(backends, *, works=(*COMPUTE_BOUND, *MEMORY_BOUND), turns=9):
    """How many times faster each number of threads is than one, in all works and plain loops."""
    counts = up_to(default_threads())
    names = [*MACHINE, *(f"{key}, {COPY}" for key in works if key in MEMORY_BOUND)]
    names += [f"{key}, {name}" for key in works for name in backends]
    children = [start(n) for n in counts]
    try:
        gain = {
            name: gains([[ask(c, name) for c in children] for _ in range(turns)]) for name in names
        }
    finally:
        for child in children:
            child.kill()
            child.communicate()
    return {"counts": counts, "gain": gain}


def up_to(threads):
    """1, 2, 4, ... and so many threads."""
    return [*(1 << i for i in range(threads.bit_length()) if 1 << i < threads), threads]


def gains(seconds):
    """Medians of the ratios within a turn; seconds: (turns, counts), one thread first."""
    seconds = np.array(seconds)
    return [round(float(g), 2) for g in np.median(seconds[:, :1] / seconds, axis=0)]


def start(threads):
    """A process with so many threads."""
    return subprocess.Popen(
        [sys.executable, "-m", "mmmgpu.bench.threads"],
        env=os.environ | {"MMMGPU_THREADS": str(threads)},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def ask(child, name):
    """The seconds of one run in a process.

    Raises:
        InputError: The process ended.
    """
    try:
        print(name, file=child.stdin, flush=True)
        return float(child.stdout.readline())
    except (BrokenPipeError, ValueError):
        said = child.stderr.read().strip().splitlines()[-1]
        raise InputError(f"threads, {name}: {said}") from None


def answer():
    """Time what is asked for, once it is loaded and has run."""
    runs = {}
    with threadpool_limits(default_threads()):
        for line in sys.stdin:
            name = line.strip()
            if name not in runs:
                runs[name] = made(name)
                runs[name]()
            print(timed(runs[name])[0], flush=True)


def made(name):
    """What a name stands for, to be timed: of `MACHINE`, or a work and a backend or a copy."""
    if name in MACHINE:
        return MACHINE[name]()
    key, who = name.split(", ")
    wholes = picture_works([who], ())
    if key in wholes:
        return wholes[key]().contenders[who].load()
    case = getattr(cases, key)(np.random.default_rng(0))
    return copy_of(case.bytes, default_threads()) if who == COPY else on_backend(case, who).load()


if __name__ == "__main__":
    answer()
