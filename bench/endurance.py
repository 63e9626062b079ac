"""Whether many frames leave anything behind: resident memory and open files along the way."""

import os
from pathlib import Path

import numpy as np

from mmmgpu.bench.drawn import drawn_basis, drawn_coordinates
from mmmgpu.progress import progress
from mmmgpu.synthesis import mouths, prepare_synthesis

SAMPLES = 50


def measure_endurance(backends, frames, *, prototypes=8, side=64):
    """Memory [MB] and open files after 1/50, 2/50, ... of `frames` synthesised frames."""
    basis = drawn_basis(prototypes, side)
    alpha, beta = drawn_coordinates(prototypes, 64)
    found = {}
    for name in backends:
        number = np.arange(frames) % len(alpha)
        given = (alpha[i] for i in number), (beta[i] for i in number)
        made = mouths(prepare_synthesis(basis, backend=name), *given)
        every, memory, files = max(1, frames // SAMPLES), [], []
        for i, _ in enumerate(progress(made, f"endurance, {name}", total=frames), start=1):
            if i % every == 0:
                memory.append(round(resident() / 1e6, 1))
                files.append(open_files())
        found[name] = {"frames": frames, "resident_mb": memory, "open_files": files}
    return found


def resident():
    """Bytes of memory that this process has; Linux only."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


def open_files():
    """Open file descriptors of this process; Linux only."""
    return len(os.listdir("/proc/self/fd"))
