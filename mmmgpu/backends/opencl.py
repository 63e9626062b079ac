"""OpenCL runtime (kernels/*.cl), with PoCL from the wheel where there is no other driver.

Buffers only: no images, no local memory, no barriers; every kernel tests its own bounds. Local
sizes are fixed, for PoCL compiles a kernel anew for each.
"""

import functools
import os
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
from numpy.typing import NDArray

from mmmgpu.arrays import F32
from mmmgpu.backends.launches import GPU_WORKERS, Launches
from mmmgpu.backends.memory import keep_freed_memory
from mmmgpu.backends.pocl_cpu import name_unknown_cpu
from mmmgpu.errors import InputError

LOCAL = 16  # work-items of a group; 1 where there are too few to go round
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")  # PoCL before and after 4.0
INCLUDED = re.compile(r'^#include "(\w+\.cl)"$', re.MULTILINE)
NO_CACHE = {"POCL_KERNEL_CACHE": "0"}  # a damaged entry would abort the process


def open_backend(device: str, threads: int) -> "OpenCL":
    """The backend on an OpenCL device: "" for the first CPU (else the first of all), or "0:0"."""
    name_unknown_cpu()
    with _defaults(dict.fromkeys(THREADS, str(threads)) | NO_CACHE):  # read when a driver loads
        platforms = [p.get_devices() for p in cl.get_platforms()]
    present = {f"{i}:{j}": d for i, found in enumerate(platforms) for j, d in enumerate(found)}
    cpus = [name for name, d in present.items() if d.type & cl.device_type.CPU]
    chosen = device or next(iter([*cpus, *present]), "")
    if chosen not in present:
        known = ", ".join(f"opencl:{name} ({d.name})" for name, d in present.items()) or "none"
        raise InputError(f"there is no device 'opencl:{device}'; present: {known}")
    found = present[chosen]
    if not found.double_fp_config:
        raise InputError(f"device 'opencl:{chosen}' has no float64; choose another")
    queue = cl.CommandQueue(cl.Context([found]))
    on_cpu = bool(found.type & cl.device_type.CPU)
    if on_cpu:
        keep_freed_memory()
    return OpenCL(found.max_compute_units if on_cpu else GPU_WORKERS, queue)


@contextmanager
def _defaults(variables: dict[str, str]) -> Iterator[None]:
    """Set those environment variables that are not set, for a while: children inherit nothing."""
    added = {name: value for name, value in variables.items() if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def list_devices() -> dict[str, str]:
    """Names for `get_backend` and what they stand for."""
    return {f"opencl:{name}": f"{d.name}, {d.version}" for name, d in _present().items()}


def _present() -> dict[str, Any]:
    """OpenCL devices by platform and device number. The first call loads the drivers."""
    os.environ.setdefault("POCL_KERNEL_CACHE", "0")  # a damaged entry would abort the process
    name_unknown_cpu()
    return {
        f"{i}:{j}": device
        for i, platform in enumerate(cl.get_platforms())
        for j, device in enumerate(platform.get_devices())
    }


@dataclass(frozen=True)
class OpenCL(Launches):
    """Device arrays are `pyopencl.array.Array`."""

    queue: Any

    def to_device(self, array: NDArray[Any]) -> Any:
        if not array.size:  # there are no empty buffers
            return self.empty(*array.shape, dtype=array.dtype)
        flags = cl.mem_flags.READ_ONLY | cl.mem_flags.USE_HOST_PTR
        data = cl.Buffer(self.queue.context, flags, hostbuf=np.ascontiguousarray(array))
        return cl.array.Array(self.queue, array.shape, array.dtype, data=data)

    def to_host(self, array: Any) -> F32:
        if not array.size:
            return np.empty(array.shape, array.dtype)
        flags, shape = cl.map_flags.READ, array.shape
        host, _ = cl.enqueue_map_buffer(self.queue, array.data, flags, 0, shape, array.dtype)
        return np.asarray(host)

    def empty(self, *shape: int, dtype: Any = np.float32) -> Any:
        return cl.array.empty(self.queue, shape, dtype)

    def copy(self, target: Any, source: Any, first: int, count: int) -> None:
        row = source.strides[0]
        span = {"src_offset": first * row, "dst_offset": first * row, "byte_count": count * row}
        cl.enqueue_copy(self.queue, target.data, source.data, **span)

    def launch(
        self, kernel: str, first: int, count: int, inputs: list[Any], outputs: list[Any]
    ) -> None:
        local = LOCAL if count >= LOCAL * self.queue.device.max_compute_units else 1
        padded = -(-count // local) * local
        arguments = [_argument(a) for a in (*inputs, first, count, *outputs)]
        with _launching:
            _kernel(self.queue.context, kernel)(self.queue, (padded,), (local,), *arguments)

    def split(self, count: int, work: Callable[[int, int], None]) -> None:
        """The driver has the threads. Wait for it: the memory of an input may be NumPy's."""
        if count:
            work(0, count)
            self.queue.finish()


_launching = threading.Lock()  # a kernel object holds the arguments of one launch


@functools.cache
def _kernel(context: Any, kernel: str) -> Any:
    """The kernel ``stem.name``, built on first use."""
    stem, _, name = kernel.partition(".")
    return cl.Kernel(_program(context, stem), name)


@functools.cache
def _program(context: Any, stem: str) -> Any:
    source = files("mmmgpu.kernels").joinpath(f"{stem}.cl").read_text()
    program: Any = cl.Program(context, INCLUDED.sub(_included, source))
    return program.build(cache_dir=False)  # nor pyopencl's cache: it has stale locks


def _included(line: re.Match[str]) -> str:
    """The file that an include names: drivers take no folder with a blank in its name."""
    return files("mmmgpu.kernels").joinpath(line[1]).read_text()


def _argument(argument: Any) -> Any:
    if isinstance(argument, int):
        return np.int32(argument)
    if isinstance(argument, float):
        return np.float32(argument)
    return argument.data
