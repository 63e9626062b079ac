"""NVIDIA Warp runtime (kernels/*.py) on all CPU cores or on one CUDA device.

A Warp launch on the CPU is one serial loop that releases the GIL, so the items of an operation are
cut into one contiguous part a thread. No two parts ever write different values to one place.
"""

import functools
import importlib
import itertools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp
from numpy.typing import NDArray

from mmmgpu.arrays import F32
from mmmgpu.backends.faults import device_failed, not_built, out_of_memory
from mmmgpu.backends.launches import GPU_WORKERS
from mmmgpu.backends.memory import KEPT, keep_freed_memory, use_huge_pages
from mmmgpu.backends.prototype_launches import PrototypeLaunches
from mmmgpu.backends.warp_cache import load, own_folder
from mmmgpu.errors import InputError

NO_MEMORY = "Failed to allocate"  # what Warp says
GONE = "CUDA error", "Failed to synchronize"
UNBUILT = "kernel build failed", "Failed to load"
POOLED = 0.5  # of a CUDA device's memory: so much, in use or free, is not given back


def open_backend(device: str, threads: int) -> "Warp":
    """The backend on a Warp device: "" or "cpu", "cuda:0", ..."""
    _start()
    try:
        found = wp.get_device(device or "cpu")
    except (ValueError, RuntimeError):  # RuntimeError: "cuda" where there is none
        present = ", ".join(f"warp:{d.alias}" for d in wp.get_devices())
        raise InputError(f"there is no device 'warp:{device}'; present: {present}") from None
    if found.is_cpu:
        keep_freed_memory()
        return Warp(workers=threads, device="cpu", threads=threads)
    if found.is_mempool_enabled:  # else each fetch would give back all that is free
        wp.set_mempool_release_threshold(found, POOLED)
    return Warp(workers=GPU_WORKERS, device=found.alias, threads=1)


def list_devices() -> dict[str, str]:
    """Names for `get_backend` and what they stand for."""
    _start()
    return {f"warp:{d.alias}": f"{d.name}, Warp {wp.__version__}" for d in wp.get_devices()}


@functools.cache
def _start() -> None:
    """Start Warp without its banner, and without its native warning where there is no CUDA."""
    wp.config.log_level = wp.LOG_ERROR
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        _initialise()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _initialise() -> None:
    try:
        cast(Any, wp).init()
    except OSError:  # there can be no cache in its place, as where the home is read-only
        wp.config.kernel_cache_dir = own_folder()
        cast(Any, wp).init()


@contextmanager
def _faults_of(device: str) -> Iterator[None]:
    """Say in one line what a device failed at.

    Raises:
        DeviceMemoryError, DeviceError: In place of Warp's error; what can only be a defect of ours
            passes as it is.
    """
    try:
        yield
    except RuntimeError as error:
        if NO_MEMORY in str(error):
            raise out_of_memory(f"warp:{device}", error) from error
        if any(words in str(error) for words in GONE):
            raise device_failed(f"warp:{device}", error) from error
        raise


@contextmanager
def _failed_builds(stem: str, device: str) -> Iterator[None]:
    """Say in one line why a kernel module cannot be compiled or loaded.

    Raises:
        DeviceError: In place of what a compiler, a loader or the disk said; what Warp says of our
            code passes as it is.
    """
    try:
        yield
    except Exception as error:  # Warp has no class for these
        if isinstance(error, OSError) or any(words in str(error) for words in UNBUILT):
            raise not_built(f"warp:{device}", f"{stem}.py", error) from error
        raise


@dataclass(frozen=True)
class Warp(PrototypeLaunches):
    """Device arrays are `wp.array` of scalars."""

    device: str
    threads: int  # launches in flight

    @property
    def on_host(self) -> bool:
        return self.device == "cpu"

    def wait(self) -> None:
        with _faults_of(self.device):
            wp.synchronize_device(self.device)

    def to_device(self, array: NDArray[Any]) -> Any:
        # a strided array would come with its strides, which the launches do not look at
        host = np.ascontiguousarray(array)
        return self._allocated(lambda: wp.array(host, device=self.device, copy=False))

    def to_host(self, array: Any) -> F32:
        self.wait()  # a copy from a device that failed says nothing
        with _faults_of(self.device):
            host: F32 = array.numpy()
        return host

    def empty(self, *shape: int, dtype: Any = np.float32) -> Any:
        scalar = cast(Any, wp).dtype_from_numpy(dtype)
        made = self._allocated(lambda: wp.empty(shape, dtype=scalar, device=self.device))
        if made.capacity > KEPT and self.device == "cpu":
            use_huge_pages(made.ptr, made.capacity)
        return made

    def zeros(self, *shape: int, dtype: Any = np.float32) -> Any:
        made = self.empty(*shape, dtype=dtype)
        with _faults_of(self.device):
            made.zero_()
        return made

    def reshaped(self, array: Any, *shape: int) -> Any:
        return array.reshape(shape)

    def _allocated(self, allocate: Callable[[], Any]) -> Any:
        def attempt() -> Any:
            with _faults_of(self.device):
                return allocate()

        return self.within_memory(attempt)

    def launcher(
        self, kernel: str, inputs: list[Any], outputs: list[Any]
    ) -> Callable[[int, int], None]:
        compiled, types = _kernel(kernel, self.device)
        device, block = wp.get_device(self.device), _block(self.device)
        before = [_as_declared(a, t) for a, t in zip(inputs, types, strict=False)]
        after = [_as_declared(a, t) for a, t in zip(outputs, types[len(before) + 2 :], strict=True)]

        def launch(first: int, count: int) -> None:
            given = [*before, first, count, *after]
            with _faults_of(self.device):
                wp.launch(compiled, dim=count, inputs=given, device=device, block_dim=block)

        return launch

    def split(self, count: int, work: Callable[[int, int], None]) -> None:
        if not count:
            return
        edges = np.linspace(0, count, min(self.threads, count) + 1).astype(int).tolist()
        own, *others = [(a, b - a) for a, b in itertools.pairwise(edges)]
        started = [_pool(self.threads).submit(work, *span) for span in others]
        try:
            work(*own)  # one thread less to wake, which may come to share a core with another
        finally:
            for span in started:
                span.exception()  # all end before the arrays that they write to are freed
        for span in started:
            span.result()


@functools.cache
def _kernel(kernel: str, device: str) -> tuple[Any, list[Any]]:
    """The Warp kernel ``stem.name``, ready on `device`, and the declared types of its arguments."""
    stem, _, name = kernel.partition(".")
    compiled = getattr(importlib.import_module(f"mmmgpu.kernels.{stem}"), name)
    with _compiling, _faults_of(device), _failed_builds(stem, device):
        loaded = load(compiled.module, wp.get_device(device), _block(device))
        loaded.get_kernel_hooks(compiled)
    return compiled, [argument.type for argument in compiled.adj.args]


_compiling = threading.Lock()


def _block(device: str) -> int:
    """Threads of a block, the same when a kernel is compiled and when it is launched."""
    return 1 if device == "cpu" else 256


def _as_declared(argument: Any, declared: Any) -> Any:
    """`argument`; an array as a view with the element type and axes that a kernel declares.

    Kernels index flat arrays, at half the cost of several indices. Two axes are rows of whole
    vectors: what is left over at the end of each row is not part of the view.
    """
    if not isinstance(argument, wp.array):
        return argument
    rows = argument.shape[0] if declared.ndim == 2 else 1
    row = argument.size // rows * wp.types.type_size_in_bytes(argument.dtype)
    size = wp.types.type_size_in_bytes(declared.dtype)
    axes = slice(2 - declared.ndim, 2)
    strides: Any = (row, size)[axes]
    return wp.array(
        ptr=argument.ptr,
        shape=(rows, row // size)[axes],
        strides=strides,
        dtype=declared.dtype,
        device=argument.device,
    )


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="mmmgpu")


if hasattr(os, "register_at_fork"):  # a forked child has the pool, but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
