"""Memory of devices that are the CPU: it comes from the C library, which has no pool of its own."""

import ctypes
import functools
import mmap
import sys
from typing import Any

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h
KEPT = 32 << 20  # bytes: larger blocks are never kept


def keep_freed_memory() -> None:
    """Let the C library reuse large blocks.

    Otherwise the arrays of every frame are fresh pages, a quarter of a frame's time. Blocks above
    `KEPT` still go back at once, and so does what is free beyond 256 MiB.
    """
    mallopt = _of_c_library("mallopt")
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, KEPT)
        mallopt(M_TRIM_THRESHOLD, 256 << 20)


def use_huge_pages(address: int, size: int) -> None:
    """Ask for pages of 2 MiB within a block that is not yet written to, as NumPy does for its own.

    A block that is not kept is fresh pages each time: of 4 KiB, they take a quarter of a warp.
    """
    madvise = _of_c_library("madvise")
    if madvise is not None:
        begin = -(-address // mmap.PAGESIZE) * mmap.PAGESIZE
        length = ctypes.c_size_t(max(address + size - begin, 0))
        madvise(ctypes.c_void_p(begin), length, mmap.MADV_HUGEPAGE)


@functools.cache
def _of_c_library(name: str) -> Any:
    """A function of the C library; None where there is none of that name, or no Linux."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
