"""Synthesis of mouth images from model coordinates (CE05, Eq. 1-2).

    C_syn = sum_i alpha_i C_i
    I_syn = sum_i beta_i W_F(I_i, W_F(C_syn - C_i, C_i))

The residual flow C_syn - C_i lives on the reference; W_F(., C_i) carries it to prototype i, whose
pixels it then moves. Both warps leave holes, which are filled from around them.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from mmmgpu.backends import Backend, get_backend
from mmmgpu.basis import Basis

F32 = NDArray[np.float32]
Floats = NDArray[np.float64]

HOLE = 0.1  # a pixel that received less than this share of a source pixel is a hole
NO_TEXTURE = 1e-4  # a smaller beta cannot be seen: half a grey level needs 0.002


def synthesize(
    basis: Basis, alpha: Iterable[Floats], beta: Iterable[Floats], *, backend: str = "warp"
) -> Iterator[F32]:
    """Yield the mouth region, (h, w, 3) in [0, 1], for every alpha (M - 1,) and beta (M,)."""
    kernels = get_backend(backend)
    for a, b in zip(alpha, beta, strict=True):
        yield synthesize_one(basis, a, b, kernels)


def synthesize_one(basis: Basis, alpha: Floats, beta: Floats, kernels: Backend) -> F32:
    """One mouth region, (h, w, 3) in [0, 1]; prototypes without texture cost nothing."""
    used = np.flatnonzero(beta > NO_TEXTURE)
    warped = warp_prototypes(basis, basis.flow(alpha), used, kernels)
    weights = kernels.to_device((beta[used] / beta[used].sum()).astype(np.float32)[None])
    return np.asarray(np.clip(kernels.to_host(kernels.blend(warped, weights))[0], 0, 1))


def warp_prototypes(
    basis: Basis, flow: F32, used: NDArray[np.int64], kernels: Backend
) -> NDArray[np.float32]:
    """The prototypes `used` (n,), each moved along C_syn = `flow`: device array (n, h, w, 3)."""
    everything = len(used) == len(basis.images)
    flows = basis.flows if everything else basis.flows[used]
    images = basis.images if everything else basis.images[used]
    residual = kernels.to_device(flow[None] - flows)
    moved, weight = kernels.forward_warp(residual, kernels.to_device(flows))
    oriented = kernels.fill_holes(moved, weight, HOLE)
    texture, weight = kernels.forward_warp(kernels.to_device(images), oriented)
    filled: NDArray[np.float32] = kernels.fill_holes(texture, weight, HOLE)
    return filled
