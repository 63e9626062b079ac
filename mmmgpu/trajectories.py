"""Trajectory synthesis: from a timed row of phones to model coordinates, and its adjoint.

A trajectory y of one dimension minimises Eq. 3 of CE05,

    E_s = (y - mu)' D' Sigma^-1 D (y - mu) + lambda y' W_k' W_k y,

and so solves A y = D' Sigma^-1 D mu with A = D' Sigma^-1 D + lambda W_k' W_k, where

    mu, Sigma   mean and variance of the phone of each frame (Sigma is diagonal),
    D           D_tt = sqrt(1 - dur/T): a short phone is to be met better than a long one,
    W_k         the k-th order difference along time.

A is banded (k beside the diagonal) and positive definite: one banded Cholesky for each dimension.
Utterances laid end to end are one system, whose band is zero where two of them meet: a `Timeline`.

lambda is in units of 1/variance. The same number suits streams and dimensions of any scale when it
is divided by the variance of each: see `scaled_smoothness`.

Sources: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), section
3.2; the form of D is recalled from Ezzat, Geiger & Poggio (SIGGRAPH 2002).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, StandIn, Utterance, segment_durations

LEAST_WEIGHT = 0.02  # of D^2: an utterance of a single phone would have D = 0 and no solution

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Timeline:
    """Utterances laid end to end, N frames in all: all of Eq. 3 but the models and lambda.

    Attributes:
        phone: Row of the model of each frame, shape (N,).
        weight: D_tt^2, shape (N,).
        band: (W_k' W_k)[t + i, t] at [t, i], shape (N, k + 1); zero across two utterances.
    """

    phone: NDArray[np.int64]
    weight: Array
    band: Array


def lay_out(
    phones: Sequence[NDArray[np.int64]], durations: Sequence[NDArray[np.int64]], *, order: int = 4
) -> Timeline:
    """Make the timeline of utterances from the phone and the segment's length of each frame."""
    weights = [np.maximum(1 - dur / max(len(dur), 1), LEAST_WEIGHT) for dur in durations]
    bands = [difference_band(len(phone), order) for phone in phones]
    return Timeline(np.concatenate(phones), np.concatenate(weights), np.concatenate(bands))


def lay_out_utterances(
    models: PhonemeModels, utterances: Sequence[Utterance], *, order: int = 4
) -> Timeline:
    """Make the timeline of the labels of `utterances`, all of whose phones have models."""
    return lay_out(
        [models.index(u.labels) for u in utterances],
        [segment_durations(u.labels, u.segments) for u in utterances],
        order=order,
    )


def difference_band(n_frames: int, order: int) -> Array:
    """W_k' W_k of T frames as its lower band: [t, i] is entry (t + i, t), shape (T, k + 1).

    Where there are no more than k frames there is no k-th difference: zero.
    """
    band = np.zeros((n_frames, order + 1))
    stencil = np.array([(-1) ** i * comb(order, i) for i in range(order + 1)], dtype=np.float64)
    for row in range(n_frames - order):
        for i in range(order + 1):
            band[row + i, : order + 1 - i] += stencil[i] * stencil[i:]
    return band


def scaled_smoothness(models: PhonemeModels, smoothness: float) -> Array:
    """lambda of each dimension, shape (d,): `smoothness` over the variance within a phone.

    `smoothness` has no unit, and its best value depends on the frame rate alone: A of one dimension
    times its variance does not change with the dimension's scale.
    """
    return smoothness / models.typical_variance


def synthesize_trajectory(
    models: PhonemeModels,
    labels: Sequence[str],
    *,
    smoothness: ArrayLike,
    order: int = 4,
    segments: ArrayLike | None = None,
    stand_in: StandIn | None = None,
) -> Array:
    """Solve Eq. 3 for a row of phones: A y = D' Sigma^-1 D mu.

    Args:
        models: Gaussians of the phones, d dimensions.
        labels: The phone of each frame, length T, at the frame rate that the models come from.
        smoothness: lambda [1/model coordinates squared], one number or shape (d,), not negative.
        order: k, the order of the difference that is kept small; at least 1.
        segments: Segment number of each frame, shape (T,). None: runs of equal labels.
        stand_in: Gives, for a phone that has no model, one that has; `mmmgpu.phones.stand_in`.

    Returns:
        y [model coordinates], shape (T, d).

    Raises:
        InputError: A phone has no model, or an argument is out of its range.
    """
    lam = _checked_smoothness(smoothness, order, models.mean.shape[1])
    phone = models.index(labels, stand_in=stand_in)
    if len(phone) == 0:
        return np.empty((0, len(lam)))
    line = lay_out([phone], [segment_durations(labels, segments)], order=order)
    y = [follow(line, models.mean[:, j], models.variance[:, j], lam[j])[0] for j in range(len(lam))]
    return np.stack(y, axis=1)


def _checked_smoothness(smoothness: ArrayLike, order: int, n_dims: int) -> Array:
    """`smoothness` as shape (d,)."""
    lam = np.asarray(smoothness, dtype=np.float64)
    if lam.shape not in ((), (n_dims,)) or not np.all(np.isfinite(lam) & (lam >= 0)):
        raise InputError(
            f"smoothness: must be one number >= 0 or one for each of {n_dims} dimensions, "
            f"got {smoothness!r}"
        )
    if order < 1:
        raise InputError(f"order: must be at least 1, got {order}; the usual value is 4")
    return np.broadcast_to(lam, (n_dims,))


def follow(line: Timeline, mean: Array, variance: Array, smoothness: float) -> tuple[Array, Array]:
    """Solve Eq. 3 in one dimension.

    Args:
        line: N frames.
        mean, variance: mu_p and sigma2_p of this dimension, shape (P,).
        smoothness: lambda.

    Returns:
        y, shape (N,), and the banded Cholesky factor of A, shape (k + 1, N), for the adjoint.
    """
    q = line.weight / variance[line.phone]  # D' Sigma^-1 D
    A = smoothness * line.band
    A[:, 0] += q
    factor = cholesky_banded(A.T, lower=True, overwrite_ab=True, check_finite=False)
    return _solve(factor, q * mean[line.phone]), factor


def _solve(factor: Array, b: Array) -> Array:
    """A^-1 b."""
    x: Array = cho_solve_banded((factor, True), b, check_finite=False)
    return x


def error_and_gradient(
    line: Timeline, z: Array, mean: Array, variance: Array, smoothness: float
) -> tuple[float, Array, Array]:
    """Eq. 4 in one dimension, E = (z - y)' (z - y), and its exact gradient by the adjoint.

    With g = A^-1 2 (y - z), P = 1/sigma2 and D_tt of frame t:

        dE/dmu_p         =   sum over t in p of D_tt^2 P g_t
        dE/dlog sigma2_p = - sum over t in p of D_tt^2 P g_t (mu_t - y_t)

    One more banded solve for all parameters together, with the factor that gave y.

    Args:
        line: N frames.
        z: Real trajectory, shape (N,).
        mean, variance: mu_p and sigma2_p of this dimension, shape (P,).
        smoothness: lambda.

    Returns:
        E, dE/dmu (P,), dE/dlog sigma2 (P,).
    """
    y, factor = follow(line, mean, variance, smoothness)
    residual = y - z
    g = _solve(factor, 2 * residual)
    pull = line.weight / variance[line.phone] * g  # D^2 P g
    by_mean = _sum_by_phone(line, pull, len(mean))
    by_log_variance = -_sum_by_phone(line, pull * (mean[line.phone] - y), len(mean))
    return float(residual @ residual), by_mean, by_log_variance


def _sum_by_phone(line: Timeline, x: Array, n_phones: int) -> Array:
    return np.bincount(line.phone, x, n_phones).astype(np.float64)
