"""The operations as sequences of kernel launches, the same for every runtime that has the kernels.

A runtime (Warp, OpenCL) is a subclass that knows how to hold arrays and how to launch.
"""

import functools
import itertools
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import check_some_valid
from mmmgpu.backends.planes import LANES
from mmmgpu.backends.scratch import Scratch
from mmmgpu.errors import DeviceMemoryError

GPU_WORKERS = 1024  # accumulators in flight on a GPU; on a CPU there is one a thread
GROUP = 4  # channels of one forward warp, as in kernels/forward_warp
COLOURS = 3  # channels of a picture, as in kernels/sample
RUN = 16  # points of a thread, as in kernels/sample
VECTORS, BLENDED = 4, 4  # of one result, or results, of a thread of kernels/blend
TILE = 64  # corpus rows packed at a time
QUERIES, ROWS = 2, 4  # of one thread of kernels/distance_scan
PIECE, BLOCK = 1024, 4  # values and rows of one thread of kernels/normal_equations


@dataclass(frozen=True)
class Level:
    """One level of the pull-push pyramid: a cell is valid where its weight reaches `threshold`."""

    value: Any  # (B, h, w, C)
    weight: Any  # (B, h, w)
    threshold: float


@dataclass(frozen=True)
class Launches(ABC):
    """The operations of `mmmgpu.backends.Backend`, over what a runtime can do."""

    workers: int  # accumulators of a forward warp
    # so that not every frame allocates it anew
    scratch: Scratch = field(init=False, default_factory=Scratch, compare=False)

    @property
    @abstractmethod
    def on_host(self) -> bool: ...

    @abstractmethod
    def wait(self) -> None: ...

    @abstractmethod
    def to_device(self, array: NDArray[Any]) -> Any: ...

    @abstractmethod
    def to_host(self, array: Any) -> Any: ...

    @abstractmethod
    def empty(self, *shape: int, dtype: Any = np.float32) -> Any:
        """An uninitialised device array."""

    @abstractmethod
    def zeros(self, *shape: int, dtype: Any = np.float32) -> Any:
        """A device array to add to. What `to_device` gives is for reading: it may be the host's."""

    @abstractmethod
    def reshaped(self, array: Any, *shape: int) -> Any:
        """The same device array with other axes."""

    @abstractmethod
    def launcher(
        self, kernel: str, inputs: list[Any], outputs: list[Any]
    ) -> Callable[[int, int], None]:
        """What runs ``stem.name`` for the items `first` ... `first + count - 1`, given these two.

        The kernel's arguments are `inputs`, first, count and `outputs`.
        """

    @abstractmethod
    def split(self, count: int, work: Callable[[int, int], None]) -> None:
        """Call `work(first, n)` for contiguous parts of `count` items, on all threads."""

    def within_memory(self, allocate: Callable[[], Any]) -> Any:
        """What `allocate()` gives; where memory is short, the scratch of all threads goes first."""
        try:
            return allocate()
        except DeviceMemoryError:
            if not self.scratch.give_up():
                raise
        return allocate()

    def kept(
        self, purpose: str, number: int, shapes: list[tuple[tuple[int, ...], Any]]
    ) -> list[Any]:
        """Arrays (number or more, *shape), kept for a purpose and for this thread alone."""
        mine = self.scratch.of_this_thread()
        found = mine.arrays.get(purpose)
        if found is None or found[0] < number or found[1] != shapes:
            found = None
            mine.arrays.pop(purpose, None)  # before more is asked for
            arrays = [self.empty(number, *s, dtype=dtype) for s, dtype in shapes]
            found = mine.arrays[purpose] = number, shapes, arrays
        return found[2]

    def launch(
        self, kernel: str, first: int, count: int, inputs: list[Any], outputs: list[Any]
    ) -> None:
        """Run a kernel for the items `first` ... `first + count - 1`."""
        self.launcher(kernel, inputs, outputs)(first, count)

    def launch_all(self, kernel: str, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Run a kernel for the items 0 ... `count` - 1 on all threads."""
        if count:
            self.split(count, self.launcher(kernel, inputs, outputs))

    def launch_on(self, kernel: str, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """`launch_all`; a driver may be at it still: the caller keeps all arrays until it waits."""
        self.launch_all(kernel, count, inputs, outputs)

    def forward_warp(self, field: Any, flow: Any) -> tuple[Any, Any]:
        fields, height, width, channels = field.shape
        flows = flow.shape[0]
        batch = max(fields, flows)
        bands = min(height, math.ceil(self.workers / batch))
        rows = math.ceil(height / bands)
        total = self.empty(self.workers, rows, width, GROUP, dtype=np.float64)
        mass = self.empty(self.workers, rows, width, dtype=np.float64)
        warped = self.empty(batch, height, width, channels)
        weight = self.empty(batch, height, width)
        for channel in range(0, channels, GROUP):
            sizes = [fields, flows, batch, height, width, channels, channel, bands, self.workers]
            inputs, outputs = [field, flow, *sizes], [total, mass, warped, weight]
            self.launch_all("forward_warp.forward_warp", self.workers, inputs, outputs)
        return warped, weight

    def fill_holes(self, field: Any, weight: Any, threshold: float) -> Any:
        batch, height, width, _ = field.shape
        valid = self.empty(batch, height, dtype=np.int32)
        inputs = [weight, float(threshold), width]
        self.launch_all("fill_holes.count_valid", batch * height, inputs, [valid])
        number = self.to_host(valid).sum(axis=1)
        check_some_valid(number)
        holes = number < height * width
        if not holes.any():
            return field
        flags = self.to_device(holes.astype(np.int32))
        levels = [Level(self.empty(*field.shape), weight, float(threshold))]
        while levels[-1].value.shape[1:3] != (1, 1):
            levels.append(self._coarser(levels[-1]))
        self.split(batch, functools.partial(self._pull_push, field, flags, levels))
        return levels[0].value

    def blend(self, images: Any, weights: Any) -> Any:
        number, *shape = images.shape
        batch = weights.shape[0]
        size = math.prod(shape)
        blended = self.empty(batch, *shape)
        inputs = [images, weights, number, size]
        vectors = size // LANES
        if batch == 1:
            self.launch_all("blend.blend", math.ceil(vectors / VECTORS), inputs, [blended])
        else:
            count = math.ceil(batch / BLENDED) * vectors
            self.launch_all("blend.blend_together", count, [*inputs, batch], [blended])
        self.launch_all("blend.blend_rest", batch * (size % LANES), inputs, [blended])
        return blended

    def normal_equations(self, images: Any, wanted: Any) -> Any:
        number, size = images.shape[0], math.prod(images.shape[1:])
        pieces = math.ceil(size / PIECE)
        parts = self.empty(pieces, number + 1, number)
        self.multiply(images, wanted, size, size, 0, parts, self.launch_all)
        return self.add_up(parts, pieces)

    def multiply(
        self,
        images: Any,
        wanted: Any,
        stride: int,
        size: int,
        before: int,
        parts: Any,
        launch: Callable[[str, int, list[Any], list[Any]], None],
    ) -> int:
        """Products of images of `size` values, after the first `before` parts: the next number."""
        number = parts.shape[2]
        pieces, blocks = math.ceil(size / PIECE), number // BLOCK + 1
        count = pieces * (blocks * (blocks + 1) // 2)
        given = [images, wanted, number, stride, size, before]
        launch("normal_equations.multiply", count, given, [parts])
        return before + pieces

    def add_up(self, parts: Any, pieces: int) -> Any:
        """The first so many parts (pieces or more, M + 1, M), added up."""
        _, rows, number = parts.shape
        products = self.empty(rows, number)
        inputs, count = [parts, pieces, number], rows * number
        self.launch_all("normal_equations.add_up", count, inputs, [products])
        return products

    def sample(self, field: Any, points: Any) -> Any:
        fields, height, width, channels = field.shape
        sets, number, _ = points.shape
        batch = max(fields, sets)
        sampled = self.empty(batch, number, channels)
        inputs, runs = [field, points, fields, sets, number, height, width], math.ceil(number / RUN)
        if channels == COLOURS:
            self.launch_all("sample.sample_pictures", batch * runs, inputs, [sampled])
        else:
            self.launch_all("sample.sample", batch * runs, [*inputs, channels], [sampled])
        return sampled

    def distance_scan(self, queries: Any, corpus: Any, weights: Any) -> Any:
        number, points, channels = queries.shape
        rows = corpus.shape[0]
        packed = self._packed(queries, points, channels, number)
        shares = self._packed(weights, points, 1, 1)
        distance = self.empty(number, rows)
        groups = math.ceil(number / QUERIES)

        def scan(first: int, count: int) -> None:
            # the same for all tiles, which may be queued long before the first of them is scanned
            planes = self._planes(points, channels, min(TILE, count))
            for start in range(first, first + count, TILE):
                tile = min(TILE, first + count - start)
                self._pack(corpus, points, channels, start, tile, planes)
                sizes = [number, rows, start, tile, math.ceil(points / LANES), channels]
                inputs = [packed, planes, shares, *sizes]
                blocks = groups * math.ceil(tile / ROWS)
                self.launch("distance_scan.distance_scan", 0, blocks, inputs, [distance])

        self.split(rows, scan)
        return distance

    def evaluate_rbf(
        self, points: Any, centres: Any, weights: Any, affine: Any, sharpness: float
    ) -> Any:
        number, terms = points.shape[0], centres.shape[0]
        mapped = self.empty(number, 2)
        inputs = [points, centres, weights, affine, number, terms, float(sharpness)]
        self.launch_all("rbf.evaluate_rbf", math.ceil(number / LANES), inputs, [mapped])
        return mapped

    def piecewise_warp(
        self, field: Any, vertices: Any, triangles: Any, index: Any, barycentric: Any
    ) -> Any:
        fields, height, width, channels = field.shape
        sets, points, _ = vertices.shape
        number = index.shape[0]
        batch = max(fields, sets)
        warped = self.empty(batch, number, channels)
        sizes = [fields, sets, points, number, height, width, channels]
        inputs = [field, vertices, triangles, index, barycentric, *sizes]
        self.launch_all("piecewise_warp.piecewise_warp", batch * number, inputs, [warped])
        return warped

    def _coarser(self, level: Level) -> Level:
        """An uninitialised level of half the size; its weights are numbers of valid pixels."""
        batch, height, width, channels = level.value.shape
        half = (batch, (height + 1) // 2, (width + 1) // 2)
        return Level(self.empty(*half, channels), self.empty(*half), threshold=0.5)

    def _pull_push(
        self, field: Any, holes: Any, levels: list[Level], first: int, count: int
    ) -> None:
        """Fill the images `first` ... `first + count - 1`: down the levels, and up again."""
        pairs = list(itertools.pairwise(levels))
        for fine, coarse in pairs:
            rows = coarse.value.shape[1]
            finest = fine is levels[0]
            inputs = [holes, field if finest else fine.value, fine.weight, fine.threshold]
            inputs += [int(finest), *fine.value.shape[1:]]
            outputs = [fine.value, coarse.value, coarse.weight]
            self.launch("fill_holes.pull", first * rows, count * rows, inputs, outputs)
        for fine, coarse in reversed(pairs):
            rows = fine.value.shape[1]
            inputs = [holes, fine.weight, coarse.value, fine.threshold, *fine.value.shape[1:]]
            self.launch("fill_holes.push", first * rows, count * rows, inputs, [fine.value])

    def _planes(self, points: int, channels: int, count: int) -> Any:
        """Uninitialised planes, shape (count, C, V * 16)."""
        return self.empty(count, channels, math.ceil(points / LANES) * LANES)

    def _packed(self, fields: Any, points: int, channels: int, count: int) -> Any:
        """The first rows of `fields` (N, P, C) as padded planes."""
        planes = self._planes(points, channels, count)
        self._pack(fields, points, channels, 0, count, planes)
        return planes

    def _pack(
        self, fields: Any, points: int, channels: int, first: int, count: int, planes: Any
    ) -> None:
        whole = points - points % LANES if channels == 2 else 0
        if whole:
            self.launch("distance_scan.pack_flows", first, count, [fields, points], [planes])
        if whole < points:
            rest = [fields, points, channels, whole]
            self.launch("distance_scan.pack", first, count, rest, [planes])
