"""NVIDIA Warp backend (kernels/*.py) on all CPU cores or on one CUDA device.

A Warp launch on the CPU is one serial loop that releases the GIL, so the items of an operation are
cut into one contiguous chunk a thread. No two chunks ever write to one place.
"""

import functools
import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.errors import InputError
from mmmgpu.kernels import blend, distance_scan, fill_holes, forward_warp, sample

CUDA_WORKERS = 1024  # accumulators in flight on a GPU
TILE = 16  # corpus rows packed at a time: small enough to stay in the cache


def open_backend(device: str, threads: int) -> "Warp":
    """The backend on a Warp device: "" or "cpu", "cuda:0", ..."""
    wp.config.log_level = wp.LOG_ERROR  # Warp would print its banner to stdout
    cast(Any, wp).init()
    try:
        found = wp.get_device(device or "cpu")
    except ValueError:
        present = ", ".join(f"warp:{d.alias}" for d in wp.get_devices())
        raise InputError(f"there is no device 'warp:{device}'; present: {present}") from None
    if found.is_cpu:
        return Warp("cpu", threads, workers=threads)
    return Warp(found.alias, 1, workers=CUDA_WORKERS)


@dataclass(frozen=True)
class Level:
    """One level of the pull-push pyramid: a cell is valid where its weight reaches `threshold`."""

    value: Any  # (B, h, w, C)
    weight: Any  # (B, h, w)
    threshold: float


@dataclass(frozen=True)
class Warp:
    """The operations as Warp kernels; device arrays are `wp.array` of float32."""

    device: str
    threads: int  # launches in flight
    workers: int  # accumulators of a forward warp

    def to_device(self, array: F32) -> Any:
        return wp.array(array, dtype=float, device=self.device, copy=False)

    def to_host(self, array: Any) -> F32:
        host: F32 = array.numpy()
        return host

    def forward_warp(self, field: Any, flow: Any) -> tuple[Any, Any]:
        fields, height, width, channels = field.shape
        flows = flow.shape[0]
        batch = max(fields, flows)
        bands = min(height, math.ceil(self.workers / batch))
        rows = math.ceil(height / bands)
        total = self._empty(self.workers, rows, width, dtype=forward_warp.vec4d)
        mass = self._empty(self.workers, rows, width, dtype=wp.float64)
        warped = self._empty(batch, height, width, channels)
        weight = self._empty(batch, height, width)
        for channel in range(0, channels, forward_warp.GROUP):
            sizes = [fields, flows, batch, height, width, channels, channel, bands, self.workers]
            inputs, outputs = [field, flow, *sizes], [total, mass, warped, weight]
            self._launch(forward_warp.forward_warp, self.workers, inputs, outputs)
        return warped, weight

    def fill_holes(self, field: Any, weight: Any, threshold: float) -> Any:
        batch, height, width, _ = field.shape
        valid = self._empty(batch * height, dtype=int)
        self._launch(fill_holes.count_valid, batch * height, [weight, threshold, width], [valid])
        number = valid.numpy().reshape(batch, height).sum(axis=1)
        check_some_valid(number)
        if (number == height * width).all():
            return field
        holes: Any = wp.array(number < height * width, dtype=int, device=self.device)
        levels = [Level(self._empty(*field.shape), weight, threshold)]
        while levels[-1].value.shape[1:3] != (1, 1):
            levels.append(self._coarser(levels[-1]))
        self._chunks(batch, functools.partial(self._pull_push, field, holes, levels))
        return levels[0].value

    def blend(self, images: Any, weights: Any) -> Any:
        number, *shape = images.shape
        batch = weights.shape[0]
        size = math.prod(shape)
        blended = self._empty(batch, *shape)
        rows = [_whole_vectors(a, size) for a in (images, blended)]
        whole, rest = divmod(size, blend.LANES)
        sizes = [number, size]
        self._launch(blend.blend, batch * whole, [rows[0], weights, *sizes], [rows[1]])
        self._launch(blend.blend_rest, batch * rest, [images, weights, *sizes], [blended])
        return blended

    def sample(self, field: Any, points: Any) -> Any:
        fields, height, width, channels = field.shape
        sets, number, _ = points.shape
        batch = max(fields, sets)
        sampled = self._empty(batch, number, channels)
        sizes = [fields, sets, number, height, width, channels]
        self._launch(sample.sample, batch * number, [field, points, *sizes], [sampled])
        return sampled

    def distance_scan(self, queries: Any, corpus: Any, weights: Any) -> Any:
        number, points, channels = queries.shape
        rows = corpus.shape[0]
        packed = self._packed(queries, 0, number)
        shares = self._packed(weights.reshape((1, points, 1)), 0, 1)
        distance = self._empty(number, rows)
        pairs = math.ceil(number / 2)
        sizes = [number, rows, math.ceil(points / distance_scan.LANES), channels]

        def scan(first: int, count: int) -> None:
            for start in range(first, first + count, TILE):
                tile = min(TILE, first + count - start)
                inputs = [packed, self._packed(corpus, start, tile), shares, *sizes]
                span = start * pairs, tile * pairs
                self._launch_chunk(distance_scan.distance_scan, *span, inputs, [distance])

        self._chunks(rows, scan)
        return distance

    def _coarser(self, level: Level) -> Level:
        """An uninitialised level of half the size; its weights are numbers of valid pixels."""
        batch, height, width, channels = level.value.shape
        half = (batch, (height + 1) // 2, (width + 1) // 2)
        return Level(self._empty(*half, channels), self._empty(*half), threshold=0.5)

    def _pull_push(
        self, field: Any, holes: Any, levels: list[Level], first: int, count: int
    ) -> None:
        """Fill the images `first` ... `first + count - 1`: down the levels, and up again."""
        start, size = first * field.strides[0] // 4, count * field.strides[0] // 4
        wp.copy(levels[0].value, field, start, start, size)
        pairs = list(itertools.pairwise(levels))
        for fine, coarse in pairs:
            rows = coarse.value.shape[1]
            inputs = [holes, fine.value, fine.weight, fine.threshold, int(fine is levels[0])]
            inputs += fine.value.shape[1:]
            outputs = [coarse.value, coarse.weight]
            self._launch_chunk(fill_holes.pull, first * rows, count * rows, inputs, outputs)
        for fine, coarse in reversed(pairs):
            rows = fine.value.shape[1]
            inputs = [holes, fine.weight, coarse.value, fine.threshold, *fine.value.shape[1:]]
            self._launch_chunk(fill_holes.push, first * rows, count * rows, inputs, [fine.value])

    def _packed(self, fields: Any, first: int, count: int) -> Any:
        """Rows of `fields` (N, P, C) as padded planes of vectors, shape (count * C * V,)."""
        _, points, channels = fields.shape
        vectors = count * channels * math.ceil(points / distance_scan.LANES)
        planes = wp.empty(vectors, dtype=distance_scan.vec16, device=self.device)
        values: Any = wp.array(
            ptr=planes.ptr, shape=vectors * distance_scan.LANES, dtype=float, device=self.device
        )
        self._launch_chunk(distance_scan.pack, first, count, [fields, points, channels], [values])
        return planes

    def _empty(self, *shape: int, dtype: Any = float) -> Any:
        return wp.empty(shape, dtype=dtype, device=self.device)

    def _launch(self, kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Run `kernel` for the items 0 ... `count` - 1 on all threads."""
        self._chunks(count, lambda first, n: self._launch_chunk(kernel, first, n, inputs, outputs))

    def _chunks(self, count: int, run: Callable[[int, int], None]) -> None:
        """Call `run(first, n)` for contiguous chunks of `count` items, one a thread."""
        edges = np.linspace(0, count, min(self.threads, count) + 1).astype(int).tolist()
        spans = [(a, b - a) for a, b in itertools.pairwise(edges)]
        if len(spans) > 1:
            list(_pool(self.threads).map(lambda span: run(*span), spans))
        elif count:
            run(0, count)

    def _launch_chunk(
        self, kernel: Any, first: int, count: int, inputs: list[Any], outputs: list[Any]
    ) -> None:
        """Run `kernel` for the items `first` ... `first + count - 1` in one serial launch."""
        wp.launch(
            kernel,
            dim=count,
            inputs=[*map(_flat, inputs), first, count],
            outputs=[*map(_flat, outputs)],
            device=self.device,
        )


def _flat(argument: Any) -> Any:
    """Kernels index flat arrays, at half the cost of several indices; rows of vectors are rows."""
    if isinstance(argument, wp.array) and argument.dtype is not blend.vec16:
        return cast(Any, argument).flatten()
    return argument


def _whole_vectors(array: Any, size: int) -> Any:
    """A view (rows, size // 16) of the whole 16-vectors in each row of `size` floats."""
    lane = np.dtype(np.float32).itemsize
    return wp.array(
        ptr=array.ptr,
        shape=(array.shape[0], size // blend.LANES),
        strides=(size * lane, blend.LANES * lane),
        dtype=blend.vec16,
        device=array.device,
    )


@functools.cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="mmmgpu")


if hasattr(os, "register_at_fork"):  # a forked child has the pool, but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
