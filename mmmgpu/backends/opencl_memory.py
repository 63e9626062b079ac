"""Arrays of an OpenCL device: of a CPU they share the host's memory, of others they are copied."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray
from pyopencl.tools import ImmediateAllocator, MemoryPool

from mmmgpu.backends.memory import KEPT, use_huge_pages


@dataclass(frozen=True)
class Array:
    """An array on a device, in C order.

    data: Its buffer, None where nothing is in it: there are no empty buffers.
    host: The array of the host that it is; a view of the buffer would not keep that alive.

    `pyopencl.array.Array` takes longer to make than a small launch.
    """

    data: Any
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    host: NDArray[Any] | None = None

    @property
    def size(self) -> int:
        return math.prod(self.shape)


@dataclass(frozen=True)
class SharedMemory:
    """The host's, of which nothing need be copied; the C library keeps what is freed."""

    queue: Any

    def allocate(self, size: int) -> Any:
        """A buffer. One of more than `KEPT` bytes is mapped, which waits for what is queued."""
        data = cl.Buffer(self.queue.context, cl.mem_flags.READ_WRITE, size)
        if size > KEPT:
            use_huge_pages(self._mapped(data, (size,), np.dtype(np.uint8)).ctypes.data, size)
        return data

    def bring(self, array: NDArray[Any]) -> Array:
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
        data = cl.Buffer(self.queue.context, flags, hostbuf=array)
        return Array(data, array.shape, array.dtype, array)

    def fetch(self, array: Array) -> NDArray[Any]:
        if array.host is not None:
            return array.host
        return self._mapped(array.data, array.shape, array.dtype)

    def _mapped(self, data: Any, shape: tuple[int, ...], dtype: np.dtype[Any]) -> NDArray[Any]:
        host, _ = cl.enqueue_map_buffer(self.queue, data, cl.map_flags.READ, 0, shape, dtype)
        return np.asarray(host)


class OwnMemory:
    """The device's. Allocation is slow there: what a frame has used is kept for the next."""

    def __init__(self, queue: Any):
        self._queue, self._pool = queue, MemoryPool(ImmediateAllocator(queue))

    def allocate(self, size: int) -> Any:
        """A buffer that goes back to the pool, to be used by what is queued later."""
        return self._pool.allocate(size)

    def bring(self, array: NDArray[Any]) -> Array:
        made = Array(self.allocate(array.nbytes), array.shape, array.dtype)
        cl.enqueue_copy(self._queue, made.data, array)
        return made

    def fetch(self, array: Array) -> NDArray[Any]:
        host = np.empty(array.shape, array.dtype)
        cl.enqueue_copy(self._queue, host, array.data)
        return host

    @property
    def allocated(self) -> int:
        """Bytes, in use or kept."""
        return int(self._pool.managed_bytes)
