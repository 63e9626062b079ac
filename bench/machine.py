"""What a run was made on: commit, processor, versions, and the two ends of the roofline.

The roofline (Williams, Waterman & Patterson 2009): work that moves Q bytes and does W operations
takes at least max(Q / bandwidth, W / peak). Both are measured here, in the run that they belong to:
the bandwidth by plain copies, the peak by a product of matrices.
"""

import os
import platform
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from mmmgpu.backends import default_threads, list_devices
from mmmgpu.errors import InputError

PACKAGES = (
    *("numpy", "scipy", "warp-lang", "pyopencl", "pocl-binary-distribution"),
    *("opencv-contrib-python-headless", "numba", "scikit-image", "torch"),
)
COPIED = 1 << 28  # bytes: more than most caches hold
SIDE = 1024  # of the matrices
TURNS = 15
PRECISIONS = "float32", "float64"


def describe_machine():
    """Commit, processor, threads, load and versions; no names of hosts or folders."""
    return {
        "commit": commit(),
        "cpu": cpu_model(),
        "threads": default_threads(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: installed(name) for name in PACKAGES},
        "devices": devices(),
    }


def commit():
    """The commit of the source checkout, with a + where files have changed since; else None."""
    here = Path(__file__).parent

    def git(*arguments):
        call = ["git", "-C", str(here), *arguments]
        return subprocess.run(call, capture_output=True, text=True, check=True).stdout.strip()

    try:
        git("ls-files", "--error-unmatch", __file__)  # it may be installed below another project
        return git("rev-parse", "--short=12", "HEAD") + "+" * bool(git("status", "--short", "-uno"))
    except (OSError, subprocess.CalledProcessError):
        return None


def cpu_model():
    """The processor's name for itself."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def installed(package):
    """Version of a package, or None."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def devices():
    """What the backends run on."""
    found = {}
    for family in ("warp", "opencl"):
        try:
            found |= list_devices(family)
        except InputError as error:
            found[family] = str(error)
    return found


def measure_machine(threads=None):
    """Copy bandwidth [GB/s, read and written] and peaks [10^9 operations/s] of all threads.

    The best of several turns: what the machine can do, not what it did under load.
    """
    threads = threads or default_threads()
    return {
        "copy_gb_per_s": round(copy_bandwidth(threads) / 1e9, 2),
        **{f"{kind}_gflops": round(peak(threads, kind) / 1e9, 1) for kind in PRECISIONS},
    }


def copy_bandwidth(threads):
    """Bytes a second that `threads` plain copies read and write together."""
    return 2 * COPIED / best(copy_of(2 * COPIED, threads))


def copy_of(size, threads):
    """Copies that read and write so many bytes together, on so many threads; one is the caller."""
    source = np.ones(size // 8, np.float32)
    target = np.zeros_like(source)
    parts = zip(np.array_split(target, threads), np.array_split(source, threads), strict=True)
    own, *others = parts
    pool = ThreadPoolExecutor(threads)

    def copy():
        started = [pool.submit(np.copyto, *part) for part in others]
        np.copyto(*own)
        for part in started:
            part.result()

    return copy


def peak(threads, precision):
    """Operations a second of a product of matrices on `threads` threads."""
    with threadpool_limits(threads):
        return 2 * SIDE**3 / best(product(precision))


def product(precision="float32"):
    """A product of matrices."""
    a = np.random.default_rng(0).random((SIDE, SIDE), dtype=precision)
    return lambda: a @ a


def best(run):
    """The shortest of `TURNS` runs [s], after one that is not counted."""
    run()
    seconds = []
    for _ in range(TURNS):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)
