"""Other libraries, one module each, with the operations that they can do by the same names.

A peer takes the arrays of a case as our operation does, and returns the answer: what it packs or
prepares is timed, as ours is. It gives its best form of the work: its own layout, all threads.
"""

import importlib

from threadpoolctl import threadpool_limits

LIBRARIES = {
    "numpy": "peers_numpy",
    "numba": "peers_numba",
    "opencv": "peers_opencv",
    "scipy": "peers_scipy",
    "skimage": "peers_skimage",
    "torch": "peers_torch",
}


def find_peers(operation, libraries):
    """Functions of that name in those libraries."""
    modules = {
        name: importlib.import_module(f"mmmgpu.bench.{LIBRARIES[name]}") for name in libraries
    }
    return {
        f"{name} peer" if name == "numpy" else name: getattr(module, operation)
        for name, module in modules.items()
        if hasattr(module, operation)
    }


def split_by_presence(libraries):
    """Those that can be imported, and those that cannot."""
    present, absent = [], []
    for name in libraries:
        try:
            importlib.import_module(f"mmmgpu.bench.{LIBRARIES[name]}")
        except ImportError:
            absent.append(name)
        else:
            present.append(name)
    return present, absent


def use_threads(number, libraries):
    """Let BLAS, and those libraries that have threads of their own, use so many from now on."""
    threadpool_limits(number)
    for name in libraries:
        module = importlib.import_module(f"mmmgpu.bench.{LIBRARIES[name]}")
        if hasattr(module, "use_threads"):
            module.use_threads(number)
