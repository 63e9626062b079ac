"""Synthesis of mouth images from model coordinates (CE05, Eq. 1-2).

    C_syn = sum_i alpha_i C_i
    I_syn = sum_i beta_i W_F(I_i, W_F(C_syn - C_i, C_i))

The residual flow C_syn - C_i lives on the reference; W_F(., C_i) carries it to prototype i, whose
pixels it then moves. Both warps leave holes, which are filled from around them. All of that is one
launch for many frames, over what `prepare_synthesis` keeps on the device.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import Backend, get_backend
from mmmgpu.backends.planes import picture, planes
from mmmgpu.basis import Basis, around, cut
from mmmgpu.batches import in_parts

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

HOLE = 0.1  # a pixel that received less than this share of a source pixel is a hole
NO_TEXTURE = 1e-4  # a smaller beta cannot be seen: half a grey level needs 0.002
BATCH = 8  # frames of a launch
BLOCK = 16  # [px] of a cell of hole filling, four levels up


@dataclass(frozen=True)
class Synthesizer:
    """What synthesis needs of a basis, computed once.

    kernels, held: the backend, and the prototypes on it.
    flows: on the device: of the prototypes but the reference, planes (M - 1, 2, h, pitch) [px].
    scale: on the device: 1 where a picture is made, else 0, (h, pitch).
    inside: the rectangle with all of that, in the region.
    outside: the reference prototype where no picture is made, else 0, (h, w, 3).
    """

    kernels: Backend
    held: Any
    flows: Any
    scale: Any
    inside: tuple[slice, slice]
    outside: F32


def prepare_synthesis(
    basis: Basis, *, shown: NDArray[np.bool_] | None = None, backend: str = "warp"
) -> Synthesizer:
    """Compute what does not change from frame to frame.

    Args:
        basis: Of a model.
        shown: Where pictures will be looked at, (h, w); None: everywhere. The rest is that of the
            reference prototype; what is outside the rectangle around them costs nothing.
        backend: A name for `mmmgpu.backends.get_backend`.

    Raises:
        InputError: A flow of the basis leaves no pixel in the picture.
    """
    shown = np.ones(basis.w_t.shape, bool) if shown is None else shown
    inside = from_whole_blocks(around(shown))
    kernels, part = get_backend(backend), cut(basis, inside)
    scale = planes(shown[inside][..., None].astype(np.float32))[0]
    return Synthesizer(
        kernels=kernels,
        held=kernels.hold_prototypes(part.images, part.flows, HOLE),
        flows=kernels.to_device(planes(part.flows[part.moving])),
        scale=kernels.to_device(scale),
        inside=inside,
        outside=np.where(shown[..., None], 0, basis.images[basis.reference]),
    )


def from_whole_blocks(inside: tuple[slice, slice]) -> tuple[slice, slice]:
    """`inside`, beginning where a block of the coarser levels of hole filling does.

    So holes are filled from the same pixels as in the whole picture, unless they are very large.
    """
    rows, columns = (slice(s.start // BLOCK * BLOCK, s.stop) for s in inside)
    return rows, columns


def synthesize(
    basis: Basis, alpha: Iterable[Floats], beta: Iterable[Floats], *, backend: str = "warp"
) -> Iterator[F32]:
    """Yield the mouth region, (h, w, 3) in [0, 1], for every alpha (M - 1,) and beta (M,)."""
    yield from mouths(prepare_synthesis(basis, backend=backend), alpha, beta)


def mouths(
    synthesizer: Synthesizer, alpha: Iterable[Floats], beta: Iterable[Floats], *, batch: int = BATCH
) -> Iterator[F32]:
    """As `synthesize`. Frames are taken `batch` at a time, and made by one launch."""
    frames = zip(alpha, beta, strict=True)
    while some := list(islice(frames, batch)):
        yield from synthesize_batch(synthesizer, *map(np.stack, zip(*some, strict=True)))


def synthesize_batch(synthesizer: Synthesizer, alpha: Floats, beta: Floats) -> F32:
    """Mouth regions (B, h, w, 3) in [0, 1] of alpha (B, M - 1) and beta (B, M).

    They are made by one launch, or by as few as the device's memory allows.

    Raises:
        DeviceMemoryError: It does not hold a single frame.
    """
    parts = in_parts(lambda part: _made(synthesizer, alpha[part], beta[part]), len(alpha))
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _made(synthesizer: Synthesizer, alpha: Floats, beta: Floats) -> F32:
    s, k = synthesizer, synthesizer.kernels
    weights = np.where(beta > NO_TEXTURE, beta, 0)
    weights = (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)
    flows = k.blend(s.flows, k.to_device(alpha.astype(np.float32)))
    mixed = k.mix_prototypes(s.held, flows, weights, s.scale)
    made = np.tile(s.outside, (len(alpha), 1, 1, 1))
    for image, one in zip(made, k.to_host(mixed), strict=True):
        part = image[s.inside]
        part += picture(one, part.shape[1])
    return np.minimum(made, 1, out=made)
