"""What GDLR is measured against: mean shift, MLLR and MAP, all of the frames' likelihood.

None of them knows of trajectories: a frame z_t of phone p is a draw from N(mu_p, diag sigma2_p).

Mean shift and MLLR (maximum likelihood linear regression) move the means of a class g together, by
a matrix R_g as GDLR does. Each row w of R_g is a weighted least squares fit, with a ridge that
pulls to the row w0 of [0 | I], in dimension j

    min_w  sum over t in g of (z_tj - w' xi_t)^2 / sigma2_tj
           + r v_j (s_0^2 (w - w0)_0^2 + sum_i s_i^2 (w - w0)_i^2),

where v_j is the mean of 1/sigma2_tj over the class, s_0 = 1 and s_i^2 is the variance of dimension
i within a phone: the ridge stands for r frames in which nothing is different. It is needed: xi_t
has at most as many values as the class has phones.

    shift     only w_0, a bias, is free
    diagonal  w_0 and w_j are free: a bias and a scale
    full      all of w is free

MAP (maximum a posteriori) moves each phone by its own frames, and a phone without frames stays:

    mu_p^adapt = (tau mu_p + sum over t in p of z_t) / (tau + n_p).

Of full covariances the diagonal is used.

Sources: MLLR: Leggetter & Woodland, Computer Speech and Language 9 (1995). MAP: Gauvain & Lee, IEEE
Trans. on Speech and Audio Processing 2 (1994).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mmmgpu.phonemes import PhonemeModels, sum_by

Array = NDArray[np.float64]
Rows = NDArray[np.int64]
Shape = Literal["shift", "diagonal", "full"]


def regress_means(
    models: PhonemeModels, phone: Rows, z: Array, class_of: Rows, *, shape: Shape, ridge: float
) -> Array:
    """Mean shift or MLLR.

    Args:
        models: N(mu_p, Sigma_p), P phones, d dimensions.
        phone: Row of the phone of each frame, shape (N,).
        z: Real trajectories, shape (N, d).
        class_of: Class of each phone, shape (P,).
        shape: What is free in R_g.
        ridge: r, in frames; above zero, but a shift may do without.

    Returns:
        Adapted means, shape (P, d). A class without frames is as it was.
    """
    frames, total = _phone_sums(models, phone, z)
    mean = models.mean.copy()
    for g in np.unique(class_of[frames > 0]):
        own = np.flatnonzero(class_of == g)
        weight = frames[own, None] / models.variance[own]  # (m, d)
        off = total[own] / np.maximum(frames[own, None], 1) - models.mean[own]
        free, scale = _free(models, own, shape)  # (d, m, f), (d, f)
        pull = ridge * weight.sum(axis=0) / frames[own].sum()  # (d,) r v_j
        mean[own] += _moved(free, weight.T, off.T, pull[:, None] * scale).T
    return mean


def _moved(F: Array, v: Array, off: Array, held: Array) -> Array:
    """F x of least sum of v (F x - off)^2 and held x^2, by dimension, (d, m).

    Of the normal equations' two forms the smaller one: with B = sqrt(v) F and H = diag(held),

        x = (B'B + H)^-1 B' sqrt(v) off = H^-1 B' (B H^-1 B' + I)^-1 sqrt(v) off.

    Args:
        F: shape (d, m, f). Where m < f nothing of `held` (d, f) is zero.
        v, off: Weights and what to come near, of each phone, shape (d, m).
    """
    root = np.sqrt(v)[:, :, None]
    B, right = root * F, root * off[:, :, None]
    if F.shape[1] < F.shape[2]:
        free = np.swapaxes(B / held[:, None], 1, 2)  # (d, f, m)
        x = free @ np.linalg.solve(B @ free + np.eye(F.shape[1]), right)
    else:
        turned = np.swapaxes(B, 1, 2)
        gram = turned @ B + held[:, :, None] * np.eye(F.shape[2])
        x = np.linalg.solve(gram, turned @ right)
    return np.asarray((F @ x)[:, :, 0])


def _free(models: PhonemeModels, own: Rows, shape: Shape) -> tuple[Array, Array]:
    """What the free part of w multiplies, (d, m, f), and its s^2, (d, f), by dimension."""
    mean, v = models.mean[own], models.typical_variance
    one, d = np.ones((*mean.shape[::-1], 1)), len(v)
    if shape == "shift":
        return one, np.ones((d, 1))
    if shape == "diagonal":
        return np.dstack([one, mean.T]), np.stack([np.ones(d), v], axis=1)
    every = np.broadcast_to(mean, (d, *mean.shape))
    return np.dstack([one, every]), np.tile(np.r_[1, v], (d, 1))


def map_means(models: PhonemeModels, phone: Rows, z: Array, *, tau: float) -> Array:
    """MAP: adapted means, shape (P, d).

    Args:
        models: N(mu_p, Sigma_p), P phones, d dimensions.
        phone: Row of the phone of each frame, shape (N,).
        z: Real trajectories, shape (N, d).
        tau: How many frames mu_p stands for, above zero.
    """
    frames, total = _phone_sums(models, phone, z)
    return np.asarray((tau * models.mean + total) / (tau + frames[:, None]))


def _phone_sums(models: PhonemeModels, phone: Rows, z: Array) -> tuple[Rows, Array]:
    """n_p, shape (P,), and the sum of z_t over t in p, shape (P, d)."""
    count = len(models.mean)
    return np.bincount(phone, minlength=count), sum_by(phone, z, count)
