"""How long a new process takes to its first frame, with an empty kernel cache and with a full one.

The process is one of its own each time: the interpreter's start and all imports count.
"""

import os
import subprocess
import sys
import tempfile
import time

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
print(next(synthesize(basis, alpha, beta, backend=sys.argv[1])).mean())
"""


def measure_startup(backends, *, turns=3):
    """Seconds to the first frame: the first process of a cache, and the best of those after it."""
    found = {}
    for name in backends:
        with tempfile.TemporaryDirectory() as cache:
            first, *later = (first_frame(name, cache) for _ in range(1 + turns))
        found[name] = {"empty_cache_s": round(first, 2), "full_cache_s": round(min(later), 2)}
    return found


def first_frame(backend, cache):
    """Seconds that a new process takes to its first frame, with kernels cached in that folder."""
    environment = os.environ | {"WARP_CACHE_PATH": cache, "XDG_CACHE_HOME": cache}
    call = [sys.executable, "-c", FIRST_FRAME, backend]
    start = time.perf_counter()
    done = subprocess.run(call, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise InputError(f"no first frame on {backend}: {done.stderr.strip().splitlines()[-1]}")
    return time.perf_counter() - start
