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

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends.orientation import orient
from mmmgpu.backends.planes import LANES, pitch_of
from mmmgpu.backends.scratch import Scratch
from mmmgpu.errors import DeviceMemoryError

GPU_WORKERS = 1024  # accumulators in flight on a GPU; on a CPU there is one a thread
GROUP = 4  # channels of one forward warp, as in kernels/forward_warp
COLOURS = 3  # channels of a picture, as in kernels/sample
RUN = 16  # points of a thread, as in kernels/sample
WHITE = 65535  # of a texture, as in kernels/prototypes
MARGIN = 40  # pixels of a row of sums beside the picture, as in kernels/rings
TOGETHER = 4, 2, 1  # mixtures whose flows are re-oriented at once: as many as there are enough of
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
class Prototypes:
    """Prototypes of height x width pixels on a device.

    arrays: As the kernels of kernels/prototypes take them, from `images` to `row_shares`.
    number, height, width: M and the size of a prototype.
    nodes: See `mmmgpu.backends.orientation.Orientations`.
    hole: Less weight makes a pixel a hole.
    """

    arrays: tuple[Any, ...]
    number: int
    height: int
    width: int
    nodes: int
    hole: float


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

    def launch(
        self, kernel: str, first: int, count: int, inputs: list[Any], outputs: list[Any]
    ) -> None:
        """Run a kernel for the items `first` ... `first + count - 1`."""
        self.launcher(kernel, inputs, outputs)(first, count)

    def launch_all(self, kernel: str, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Run a kernel for the items 0 ... `count` - 1 on all threads."""
        if count:
            self.split(count, self.launcher(kernel, inputs, outputs))

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
        self.launch_all("blend.blend", batch * (size // LANES), inputs, [blended])
        self.launch_all("blend.blend_rest", batch * (size % LANES), inputs, [blended])
        return blended

    def normal_equations(self, images: Any, wanted: Any) -> Any:
        number, size = images.shape[0], math.prod(images.shape[1:])
        pieces, blocks = math.ceil(size / PIECE), number // BLOCK + 1
        parts = self.empty(pieces, number + 1, number)
        products = self.empty(number + 1, number)
        count = pieces * (blocks * (blocks + 1) // 2)
        self.launch_all("normal_equations.multiply", count, [images, wanted, number, size], [parts])
        inputs, count = [parts, pieces, number], (number + 1) * number
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
        packed = self._packed(queries, points, channels, 0, number)
        shares = self._packed(weights, points, 1, 0, 1)
        distance = self.empty(number, rows)
        groups = math.ceil(number / QUERIES)

        def scan(first: int, count: int) -> None:
            for start in range(first, first + count, TILE):
                tile = min(TILE, first + count - start)
                planes = self._packed(corpus, points, channels, start, tile)
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

    def hold_prototypes(self, images: F32, flows: F32, hole: float) -> Prototypes:
        number, height, width, _ = images.shape
        held = orient(flows, hole)
        textures = np.ones((number, height, pitch_of(width), COLOURS + 1), np.uint16)
        textures[:, :, :width, :COLOURS] = np.rint(images * WHITE)
        parts = np.pad(held.flows.ravel(), LANES), held.shares, held.firsts, held.parts
        rows = held.rows, held.targets, held.starts, held.row_taps, held.row_shares
        arrays = tuple(self.to_device(a) for a in (textures, *parts, *rows))
        return Prototypes(arrays, number, height, width, held.nodes, float(hole))

    def move_prototypes(
        self, held: Prototypes, flow: Any, used: NDArray[np.int64], scale: Any
    ) -> Any:
        alone = [np.arange(len(used) + 1), used, np.ones((len(used), 1))]
        return self._mixtures(held, flow, len(used), alone, scale)

    def mix_prototypes(self, held: Prototypes, flows: Any, weights: F32, scale: Any) -> Any:
        mixtures, number = weights.shape
        gpu = self.workers >= GPU_WORKERS
        # on a CPU a mixture is one worker's, so that bits do not depend on the number of threads
        shares = min(number, self.workers // max(mixtures, 1)) if gpu else 1
        if shares <= 1:
            return self._mix(held, flows, weights, scale)
        which = np.arange(number) % shares == np.arange(shares)[:, None, None]
        apart = np.where(which, weights, 0).reshape(-1, number)  # some prototypes a worker
        mixed = self._mix(held, flows, apart, scale)
        shape = mixtures, *mixed.shape[1:]
        ones = self.to_device(np.ones((1, shares), np.float32))
        whole = self.blend(self.reshaped(mixed, shares, math.prod(shape)), ones)
        return self.reshaped(whole, *shape)

    def _mix(self, held: Prototypes, flows: Any, weights: F32, scale: Any) -> Any:
        mixtures, number = weights.shape
        together = next(n for n in TOGETHER if n == 1 or mixtures >= n * self.workers)
        groups = math.ceil(mixtures / together)
        padded = np.zeros((groups, together, number), np.float32)
        padded.reshape(-1, number)[:mixtures] = weights
        used = padded.any(axis=1)
        parts = np.concatenate([[0], np.cumsum(np.count_nonzero(used, axis=1))])
        members = [parts, np.nonzero(used)[1], padded.transpose(0, 2, 1)[used]]
        return self._mixtures(held, flows, mixtures, members, scale)

    def _mixtures(
        self,
        held: Prototypes,
        flows: Any,
        mixtures: int,
        members: list[Any],
        scale: Any,
    ) -> Any:
        """Run kernels/prototypes with an accumulator for every worker.

        Mixture b is along flow b, from the first again after the last.
        """
        height, pitch, together = held.height, pitch_of(held.width), members[2].shape[1]
        if not mixtures:
            return self.empty(0, 3, height, pitch)
        workers = min(self.workers, len(members[0]) - 1)
        size = _pyramid((height + 1) // 2, (held.width + 1) // 2)
        ring = 1 << (height - 1).bit_length()
        given = zip(members, (np.int32, np.int32, np.float32), strict=True)
        shapes = [
            ((ring, pitch + MARGIN, COLOURS + 1), np.float32),
            ((COLOURS + 1, size), np.float32),
            ((together, 2, height * pitch + LANES), np.float32),
            ((together, 2, height * pitch + size), np.float32),  # at least as many as nodes
            ((height + 1,), np.int32),
            ((2, pitch), np.int32),
            ((7, pitch), np.float32),
            ((height, pitch), np.int32),
        ]
        mixed = self.empty(mixtures, 3, height, pitch)
        arrived = self.empty(mixtures, dtype=np.int32)
        inputs = [flows, *held.arrays, *(self.to_device(a.astype(t)) for a, t in given), scale]
        inputs += [flows.shape[0], mixtures, together, height, held.width, size, ring, held.nodes]
        inputs += [held.hole, workers]
        # last: until here, all that is kept can be given up
        scratch = self._scratch(workers, shapes)
        self.launch_all("prototypes.mix_prototypes", workers, inputs, [*scratch, mixed, arrived])
        check_some_valid(self.to_host(arrived))
        return mixed

    def _scratch(self, workers: int, shapes: list[Any]) -> list[Any]:
        """Arrays (workers or more, *shape), of this thread alone."""
        kept = self.scratch.of_this_thread()
        found = kept.arrays
        if found is None or found[0] < workers or found[1] != shapes:
            found = kept.arrays = None  # before more is asked for
            arrays = [self.empty(workers, *s, dtype=dtype) for s, dtype in shapes]
            found = kept.arrays = workers, shapes, arrays
        return found[2]

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

    def _packed(self, fields: Any, points: int, channels: int, first: int, count: int) -> Any:
        """Rows of `fields` (N, P, C) as padded planes, shape (count, C, V * 16)."""
        planes = self.empty(count, channels, math.ceil(points / LANES) * LANES)
        whole = points - points % LANES if channels == 2 else 0
        if whole:
            self.launch("distance_scan.pack_flows", first, count, [fields, points], [planes])
        if whole < points:
            rest = [fields, points, channels, whole]
            self.launch("distance_scan.pack", first, count, rest, [planes])
        return planes


def _pyramid(height: int, width: int) -> int:
    """Pixels of all levels of a picture, each half as high and wide, in padded rows."""
    size = height * pitch_of(width)
    while (height, width) != (1, 1):
        height, width = (height + 1) // 2, (width + 1) // 2
        size += height * pitch_of(width)
    return size
