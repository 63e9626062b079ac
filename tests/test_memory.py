"""Large blocks of devices that are the CPU: they ask for huge pages."""

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mmmgpu.backends import get_backend
from mmmgpu.backends.launches import GPU_WORKERS
from mmmgpu.backends.memory import KEPT, use_huge_pages

WITH_HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled").exists()
LARGE = KEPT // 4 + 1024  # float32


def flags_at(address):
    """What the kernel was told about the memory at an address: see VmFlags in proc(5)."""
    inside = False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        first = line.split()[0]
        if first.endswith(":"):
            if inside and first == "VmFlags:":
                return line.split()[1:]
        else:
            begin, end = (int(n, 16) for n in first.split("-"))
            inside = begin <= address < end
    raise AssertionError("nothing is there")


@pytest.mark.skipif(not WITH_HUGE_PAGES, reason="this kernel has no huge pages")
def test_large_arrays_ask_for_huge_pages(backend):
    k = get_backend(backend)
    if k.workers == GPU_WORKERS:
        pytest.skip("results are in the memory of a GPU")
    host = k.to_host(k.empty(LARGE))
    assert "hg" in flags_at(host.ctypes.data + host.nbytes // 2)


@pytest.mark.parametrize("size", [0, 1, 5000, 1 << 22])
def test_memory_keeps_its_values(size):
    memory = np.arange(size + 3).astype(np.uint8)
    use_huge_pages(memory.ctypes.data + 3, size)
    assert_array_equal(memory, np.arange(size + 3).astype(np.uint8))
