"""OpenCL runtime (kernels/*.cl), with PoCL from the wheel where there is no other driver.

Buffers only: no images, no local memory, no barriers; every kernel tests its own bounds. Local
sizes are fixed, for PoCL compiles a kernel anew for each.
"""

import functools
import math
import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from mmmgpu.arrays import F32
from mmmgpu.backends import default_threads
from mmmgpu.backends.faults import device_failed, not_built, out_of_memory, out_of_resources
from mmmgpu.backends.launches import GPU_WORKERS
from mmmgpu.backends.memory import keep_freed_memory
from mmmgpu.backends.opencl_memory import Array, OwnMemory, SharedMemory
from mmmgpu.backends.pocl_cache import cache_variables
from mmmgpu.backends.pocl_cpu import name_unknown_cpu
from mmmgpu.backends.prototype_launches import PrototypeLaunches
from mmmgpu.errors import InputError

LOCAL = 16  # work-items of a group; 1 where there are fewer than `GROUPS` for each thread
GROUPS = 32
THREADS = ("POCL_MAX_PTHREAD_COUNT", "POCL_CPU_MAX_CU_COUNT")  # PoCL before and after 4.0
NO_PLATFORM = (
    "there is no OpenCL driver; pip install 'pyopencl[pocl]' brings one for the CPU, "
    "or use --backend warp"
)
NO_MEMORY = {
    cl.status_code.MAP_FAILURE,
    cl.status_code.MEM_OBJECT_ALLOCATION_FAILURE,
    cl.status_code.OUT_OF_HOST_MEMORY,
    cl.status_code.INVALID_BUFFER_SIZE,
}
GONE = {
    cl.status_code.DEVICE_NOT_AVAILABLE,
    cl.status_code.DEVICE_NOT_FOUND,
    cl.status_code.EXEC_STATUS_ERROR_FOR_EVENTS_IN_WAIT_LIST,
    cl.status_code.INVALID_COMMAND_QUEUE,
    cl.status_code.INVALID_CONTEXT,
    cl.status_code.INVALID_DEVICE,
}
INCLUDED = re.compile(r'^#include "(\w+\.cl)"$', re.MULTILINE)


def open_backend(device: str, threads: int) -> "OpenCL":
    """The backend on an OpenCL device: "" for the first CPU (else the first of all), or "0:0"."""
    present = _present(threads)
    cpus = [name for name, d in present.items() if d.type & cl.device_type.CPU]
    chosen = device or next(iter([*cpus, *present]), "")
    if chosen not in present:
        known = ", ".join(f"opencl:{name} ({d.name})" for name, d in present.items()) or "none"
        raise InputError(f"there is no device 'opencl:{device}'; present: {known}")
    found = present[chosen]
    if not found.double_fp_config:
        raise InputError(f"device 'opencl:{chosen}' has no float64; choose another")
    name = f"opencl:{chosen}"
    with _faults_of(name):
        queue = cl.CommandQueue(cl.Context([found]))
    if not found.type & cl.device_type.CPU:
        return OpenCL(GPU_WORKERS, name, queue, OwnMemory(queue))
    keep_freed_memory()
    return OpenCL(found.max_compute_units, name, queue, SharedMemory(queue))


def list_devices() -> dict[str, str]:
    """Names for `get_backend` and what they stand for."""
    present = _present(default_threads())
    return {f"opencl:{name}": f"{d.name}, {d.version}" for name, d in present.items()}


def _present(threads: int) -> dict[str, Any]:
    """OpenCL devices by platform and device number. The first call loads the drivers.

    Raises:
        InputError: There is no driver.
    """
    name_unknown_cpu()
    variables = dict.fromkeys(THREADS, str(threads)) | _pinned(threads) | _cache()
    with _defaults(variables):  # read when a driver loads
        try:
            platforms = cl.get_platforms()
        except cl.LogicError:
            raise InputError(NO_PLATFORM) from None
        found = [_devices(platform) for platform in platforms]
    return {f"{i}:{j}": d for i, devices in enumerate(found) for j, d in enumerate(devices)}


_cache = functools.cache(cache_variables)


def _pinned(threads: int) -> dict[str, str]:
    """Keep each thread of PoCL on a core of its own, where it has all cores of the machine.

    Threads that are woken together may get one core for some milliseconds. PoCL counts cores from
    0: with fewer threads, the processes of a machine would all be on the first ones; more threads
    than cores end the process.
    """
    own = sys.platform == "linux" and os.sched_getaffinity(0) == set(range(threads))
    chosen = any(name in os.environ for name in THREADS)  # by the user, who may want more or fewer
    return {"POCL_AFFINITY": "1"} if own and threads == os.cpu_count() and not chosen else {}


def _devices(platform: Any) -> list[Any]:
    """The devices of a platform: none where its driver finds no hardware."""
    try:
        return list(platform.get_devices())
    except cl.Error:
        return []


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


@contextmanager
def _faults_of(device: str) -> Iterator[None]:
    """Say in one line what a driver failed at.

    Raises:
        DeviceMemoryError, DeviceError: In place of the driver's error; what can only be a defect of
            ours passes as it is.
    """
    try:
        yield
    except cl.Error as error:
        if error.code in NO_MEMORY:
            raise out_of_memory(device, error) from error
        if error.code == cl.status_code.OUT_OF_RESOURCES:
            raise out_of_resources(device, error) from error
        if error.code in GONE:
            raise device_failed(device, error) from error
        raise


@dataclass(frozen=True)
class OpenCL(PrototypeLaunches):
    """Device arrays are `Array`."""

    name: str  # for `get_backend`
    queue: Any
    memory: SharedMemory | OwnMemory

    @property
    def on_host(self) -> bool:
        return isinstance(self.memory, SharedMemory)

    def wait(self) -> None:
        with _faults_of(self.name):
            self.queue.finish()

    def to_device(self, array: NDArray[Any]) -> Any:
        if not array.size:
            return self.empty(*array.shape, dtype=array.dtype)
        return self._allocated(self.memory.bring, np.ascontiguousarray(array))

    def to_host(self, array: Any) -> F32:
        if not array.size:
            return np.empty(array.shape, array.dtype)
        with _faults_of(self.name):
            return self.memory.fetch(array)

    def empty(self, *shape: int, dtype: Any = np.float32) -> Any:
        kind = np.dtype(dtype)
        size = math.prod(shape) * kind.itemsize
        data = self._allocated(self.memory.allocate, size) if size else None
        return Array(data, shape, kind)

    def zeros(self, *shape: int, dtype: Any = np.float32) -> Any:
        made, zero = self.empty(*shape, dtype=dtype), np.zeros(1, dtype)
        with _faults_of(self.name):
            cl.enqueue_fill_buffer(self.queue, made.data, zero, 0, made.size * zero.itemsize)
        return made

    def reshaped(self, array: Any, *shape: int) -> Any:
        return replace(array, shape=shape)

    def _allocated(self, allocate: Callable[[Any], Any], given: Any) -> Any:
        def attempt() -> Any:
            with _faults_of(self.name):
                return allocate(given)

        return self.within_memory(attempt)

    def launcher(
        self, kernel: str, inputs: list[Any], outputs: list[Any]
    ) -> Callable[[int, int], None]:
        types = *map(_type, inputs), np.int32, np.int32, *map(_type, outputs)
        compiled = _kernel(self.queue.context, kernel, types)
        many = LOCAL * GROUPS * self.queue.device.max_compute_units
        before, after = [_argument(a) for a in inputs], [_argument(a) for a in outputs]

        def launch(first: int, count: int) -> None:
            local = LOCAL if count >= many else 1
            padded = -(-count // local) * local
            given = [*before, first, count, *after]
            with _launching, _faults_of(self.name):
                compiled(self.queue, (padded,), (local,), *given)

        return launch

    def launch_on(self, kernel: str, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        if count:
            self.launch(kernel, 0, count, inputs, outputs)

    def split(self, count: int, work: Callable[[int, int], None]) -> None:
        """The driver has the threads."""
        if count:
            work(0, count)
        if count and self.on_host:  # the memory of an input may be NumPy's, which may change it
            self.wait()


_launching = threading.Lock()  # a kernel object holds the arguments of one launch


@functools.cache
def _kernel(context: Any, kernel: str, types: tuple[Any, ...]) -> Any:
    """The kernel ``stem.name``, built on first use, for arguments of those types.

    Without them pyopencl takes 14 us for each number that it is given.
    """
    stem, _, name = kernel.partition(".")
    built: Any = cl.Kernel(_program(context, stem), name)
    built.set_scalar_arg_dtypes(types)
    return built


@functools.cache
def _program(context: Any, stem: str) -> Any:
    source = files("mmmgpu.kernels").joinpath(f"{stem}.cl").read_text()
    program: Any = cl.Program(context, INCLUDED.sub(_included, source))
    try:
        return program.build(cache_dir=False)  # nor pyopencl's cache: it has stale locks
    except cl.RuntimeError as error:
        lines = [line for line in str(error).splitlines() if "error" in line.lower()]
        said = (lines or str(error).splitlines())[0]
        raise not_built(context.devices[0].name, f"{stem}.cl", said) from error


def _included(line: re.Match[str]) -> str:
    """The file that an include names: drivers take no folder with a blank in its name."""
    return files("mmmgpu.kernels").joinpath(line[1]).read_text()


def _type(argument: Any) -> Any:
    """Of a number; None stands for a buffer."""
    if isinstance(argument, int):
        return np.int32
    return np.float32 if isinstance(argument, float) else None


def _argument(argument: Any) -> Any:
    return argument.data if isinstance(argument, Array) else argument
