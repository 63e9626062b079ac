"""Memory of devices that are the CPU: it comes from the C library, which has no pool of its own."""

import ctypes
import sys

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of glibc's malloc.h


def keep_freed_memory() -> None:
    """Let the C library reuse large blocks.

    Otherwise the arrays of every frame are fresh pages, a quarter of a frame's time. Blocks above
    32 MiB still go back at once, and so does what is free beyond 256 MiB.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(M_MMAP_THRESHOLD, 32 << 20)
        mallopt(M_TRIM_THRESHOLD, 256 << 20)
