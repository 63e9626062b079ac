"""Re-selection, its statistics: phoneme models rewritten in terms of other prototypes.

When prototypes are chosen anew, each old prototype is analysed in the new ones; its coordinates are
a column of M_AB, and Eq. 13 of CE05 carries the phoneme models of a stream over:

    mu'_p = M_AB mu_p,    Sigma'_p = M_AB Sigma_p M_AB'.

Sigma' is not diagonal, and of betas (which sum to 1) singular: either its diagonal is kept, no less
than a floor, or all of it, with the floor added to its diagonal.

Source: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), 5.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, positive

COVARIANCES = ("diagonal", "full")


def carry(
    models: PhonemeModels,
    matrix: NDArray[np.float64],
    *,
    covariance: str = "diagonal",
    floor_share: float = 0.05,
) -> PhonemeModels:
    """Eq. 13: the models of one stream in other coordinates.

    Args:
        models: N(mu_p, Sigma_p) in d dimensions.
        matrix: M_AB of this stream (A for alpha, B for beta), shape (d', d): column j is old
            prototype j in the new coordinates.
        covariance: "diagonal": the diagonal of Sigma', at least the floor. "full": Sigma' plus the
            floor on its diagonal.
        floor_share: The floor as a share of the variance of the whole stream (within and between
            the phones) in the new coordinates, dimension by dimension, as in `phonemes.pool`.

    Returns:
        Models in d' dimensions, of the same phones and counts.

    Raises:
        InputError: `matrix` has another width or is not finite, or `covariance` is unknown.
    """
    M = np.asarray(matrix, dtype=np.float64)
    if M.ndim != 2 or M.shape[1] != models.mean.shape[1] or not np.isfinite(M).all():
        raise InputError(
            f"matrix: must be finite with one column for each of {models.mean.shape[1]} old "
            f"dimensions, got shape {M.shape}; analyse every old prototype in the new ones"
        )
    if covariance not in COVARIANCES:
        raise InputError(f"covariance: must be one of {', '.join(COVARIANCES)}, got {covariance!r}")
    mean = models.mean @ M.T
    if models.covariance is None:
        full = np.einsum("ij,pj,kj->pik", M, models.variance, M)
    else:
        full = M @ models.covariance @ M.T
    own = np.diagonal(full, axis1=1, axis2=2)
    floor = floor_share * positive(_stream_variance(mean, own, models.count))
    if covariance == "diagonal":
        return PhonemeModels(models.labels, mean, np.maximum(own, floor), models.count)
    full = full + np.diag(floor)
    return PhonemeModels(models.labels, mean, own + floor, models.count, full)


def _stream_variance(
    mean: NDArray[np.float64], variance: NDArray[np.float64], count: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Variance of all frames: that within the phones and that between them, shape (d,)."""
    between = (mean - np.average(mean, axis=0, weights=count)) ** 2
    return np.asarray(np.average(variance + between, axis=0, weights=count))
