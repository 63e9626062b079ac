"""What errors of model coordinates do to pictures: the weights by which adaptation is judged.

All alphas of a basis move the same mouth, and their flows resemble one another, so that an error of
one number may or may not be seen. The flow of an error e of alpha is sum_i e_i C_i; its mean square
under the lip mask is e' W e with

    W_ij = sum_p w_f(p) C_i(p) . C_j(p) / sum_p w_f(p),

and an error of beta, whose sum is 0, changes the picture in the reference's shape by sum_i e_i T_i
with the prototypes carried there, T_i(p) = I_i(p + C_i(p)).
"""

import numpy as np
from numpy.typing import NDArray

from mmmgpu.basis import F32, Basis
from mmmgpu.components import gram_of
from mmmgpu.operations import sample

Floats = NDArray[np.float64]


def flow_weights(basis: Basis) -> Floats:
    """W of alpha, (M - 1, M - 1) [px^2]: e' W e is the mean square of the flow under w_f."""
    return _gram(basis.flows[basis.moving], basis.w_f)


def texture_weights(basis: Basis, *, backend: str = "warp") -> Floats:
    """W of beta, (M, M): e' W e is the mean square over colours under w_t, in [0, 1]^2."""
    y, x = np.indices(basis.w_t.shape)
    textures = sample(basis.images, np.stack([x, y], axis=-1) + basis.flows, backend=backend)
    W = _gram(textures - textures.mean(axis=0), basis.w_t)
    return np.asarray(W / textures.shape[-1])


def _gram(fields: F32, mask: F32) -> Floats:
    """Products of fields (n, h, w, c), summed over c, in the mean under a mask (h, w): (n, n)."""
    shown = (fields * np.sqrt(mask)[..., None]).reshape(len(fields), -1)
    return np.asarray(gram_of(shown) / mask.sum())
