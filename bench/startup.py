"""How long a new process takes to its first frame, with an empty kernel cache and with a full one.

The process is one of its own each time: the interpreter's start and all imports count. Another one
with an empty cache says how long the kernels of each operation take to compile, on its standard
output: ``python -m mmmgpu.bench.startup BACKEND``.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

import numpy as np

from mmmgpu.bench.cases import CASES
from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates
from mmmgpu.bench.kernels import on_backend
from mmmgpu.bench.pictures import synthesis
from mmmgpu.errors import InputError

FIRST_FRAME = """
import sys
import numpy as np
from mmmgpu.basis import make_basis
from mmmgpu.regions import region_from_box
from mmmgpu.synthesis import synthesize
rng = np.random.default_rng(0)
images = rng.random((8, 96, 96, 3), dtype=np.float32)
flows = rng.normal(0, 1, (8, 1, 1, 2)).astype(np.float32) * np.ones((96, 96, 1), np.float32)
basis = make_basis(images, flows, 0, region_from_box((0, 0, 96, 96), (96, 96)))
alpha, beta = np.full((1, 7), 0.1), np.full((1, 8), 0.125)
print(next(synthesize(basis, alpha, beta, backend=sys.argv[1])).mean(), flush=True)
"""


def measure_startup(backends, *, turns=3):
    """Seconds to the first frame: the first process of a cache, and the median of those after it.

    And those to compile the kernels of each operation.
    """
    found = {}
    for name in backends:
        with tempfile.TemporaryDirectory() as cache:
            first, *later = (first_frame(name, cache) for _ in range(1 + turns))
        with tempfile.TemporaryDirectory() as cache:
            compiled = json.loads(run_new("-m", "mmmgpu.bench.startup", name, cache=cache))
        found[name] = {
            "empty_cache_s": round(first, 2),
            "full_cache_s": round(statistics.median(later), 2),
            "compiled_s": compiled,
        }
    return found


def first_frame(backend, cache):
    """Seconds that a new process takes to its first frame, with kernels cached in that folder."""
    start = time.perf_counter()
    with begun("-c", FIRST_FRAME, backend, cache=cache) as process:
        process.stdout.readline()
        taken = time.perf_counter() - start
        finish(process)
    return taken


def run_new(*arguments, cache):
    """What a new process prints that keeps its kernels in that folder."""
    with begun(*arguments, cache=cache) as process:
        return finish(process)


def begun(*arguments, cache):
    """A new process that keeps its kernels in that folder."""
    environment = os.environ | {"WARP_CACHE_PATH": cache, "XDG_CACHE_HOME": cache}
    call = [sys.executable, *arguments]
    return subprocess.Popen(
        call, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finish(process):
    """What else it prints.

    Raises:
        InputError: It failed.
    """
    printed, errors = process.communicate()
    if process.returncode:
        said = errors.strip().splitlines()[-1]
        raise InputError(f"no first frame on {process.args[-1]}: {said}")
    return printed


def compile_all(backend):
    """Seconds by operation: its first run in this process, less the next one.

    The first operation has the compiler's own start in it.
    """
    rng = np.random.default_rng(0)
    makers = {case.operation: on_backend(case, backend) for case in (make(rng) for make in CASES)}
    basis, coordinates = drawn_basis(8, 96), drawn_coordinates(8, 4)
    makers["mix_prototypes"] = synthesis(basis, coordinates, backend)
    return {name: compiled(contender.load()) for name, contender in makers.items()}


def compiled(run):
    """Seconds that the first run takes longer than the second."""
    first, second = (seconds(run) for _ in range(2))
    return round(max(first - second, 0.0), 2)


def seconds(run):
    """Of one run."""
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


if __name__ == "__main__":
    print(json.dumps(compile_all(sys.argv[1])))
