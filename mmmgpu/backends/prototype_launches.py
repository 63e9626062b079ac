"""The operations on prototypes that stay on a device: moved, mixed, and fitted to a picture."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.arrays import F32, check_some_valid
from mmmgpu.backends.held import MARGIN, Prototypes
from mmmgpu.backends.launches import COLOURS, GPU_WORKERS, Launches
from mmmgpu.backends.moved_equations import moved_equations
from mmmgpu.backends.orientation import orient
from mmmgpu.backends.planes import LANES, pitch_of

WHITE = 65535  # of a texture, as in kernels/prototypes
TOGETHER = 4, 2, 1  # mixtures whose flows are re-oriented at once: as many as there are enough of


@dataclass(frozen=True)
class PrototypeLaunches(Launches):
    """The operations of `mmmgpu.backends.Backend` on what `hold_prototypes` gives."""

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

    def prototype_equations(
        self, held: Prototypes, flow: F32, used: NDArray[np.int64], wanted: Any, scale: Any
    ) -> Any:
        return moved_equations(self, held, flow, used, wanted, scale)

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
        height, pitch, together = held.height, held.pitch, members[2].shape[1]
        if not mixtures:
            return self.empty(0, 3, height, pitch)
        workers = min(self.workers, len(members[0]) - 1)
        size, ring = held.pyramid, held.ring
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
        scratch = self.kept("mixtures", workers, shapes)
        self.launch_all("prototypes.mix_prototypes", workers, inputs, [*scratch, mixed, arrived])
        check_some_valid(self.to_host(arrived))
        return mixed
