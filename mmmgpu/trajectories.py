"""Trajectory synthesis: from a timed row of phones to model coordinates, and its adjoint.

A trajectory y of one dimension minimises Eq. 3 of CE05,

    E_s = (y - mu)' D' Sigma^-1 D (y - mu) + lambda y' W_k' W_k y,

and so solves A y = D' Sigma^-1 D mu with A = D' Sigma^-1 D + lambda W_k' W_k, where

    mu, Sigma   mean and variance of the phone of each frame,
    D           D_tt = sqrt(1 - dur/T): a short phone is to be met better than a long one,
    W_k         the k-th order difference along time.

A is banded (k beside the diagonal) and positive definite: one banded Cholesky for each dimension.
Utterances laid end to end are one system, whose band is zero where two of them meet: a `Timeline`.
Full covariances couple the d dimensions: one system of N d unknowns, frame by frame, with k d
beside the diagonal, where D' Sigma^-1 D is d x d blocks and lambda W_k' W_k has one lambda for each
dimension. `System` is either, in all dimensions at once.

lambda is in units of 1/variance. The same number suits streams and dimensions of any scale when it
is divided by the variance of each: see `scaled_smoothness`.

Sources: CE05 = Chang & Ezzat, "Transferable Videorealistic Speech Animation" (SCA 2005), section
3.2; the form of D is recalled from Ezzat, Geiger & Poggio (SIGGRAPH 2002).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import comb

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dpbtrf, dpbtrs

from mmmgpu.errors import InputError
from mmmgpu.phonemes import PhonemeModels, StandIn, Utterance, segment_durations, sum_by

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
    for i in range(order + 1):
        band[i : max(n_frames - order, 0) + i, : order + 1 - i] += stencil[i] * stencil[i:]
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
    lam = checked_smoothness(smoothness, order, models.mean.shape[1])
    phone = models.index(labels, stand_in=stand_in)
    if len(phone) == 0:
        return np.empty((0, len(lam)))
    line = lay_out([phone], [segment_durations(labels, segments)], order=order)
    return factor_system(line, models, lam).follow(models.mean)


def checked_smoothness(smoothness: ArrayLike, order: int, n_dims: int) -> Array:
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


@dataclass(frozen=True)
class System:
    """Eq. 3 in all d dimensions, with A factored: the means are free, Sigma and lambda are not.

    Attributes:
        line: N frames.
        precision: Sigma_p^-1, shape (P, d), or (P, d, d) if the models are full.
        factor: Banded Cholesky factor of A. Diagonal models: dimensions laid end to end, shape
            (k + 1, d N); full ones: frame by frame, shape (k d + 1, N d).
    """

    line: Timeline
    precision: Array
    factor: Array

    def follow(self, mean: Array) -> Array:
        """y, shape (N, d), of the phones' means, shape (P, d)."""
        return self._solve(self._pull(mean[self.line.phone]))

    def error_and_slope(self, mean: Array, z: Array) -> tuple[float, Array]:
        """Eq. 4 over all dimensions, and its exact gradient dE/dmu by the adjoint.

        With g = A^-1 2 (y - z):  dE/dmu_p = sum over t in p of D_tt^2 Sigma_p^-1 g_t.

        Args:
            mean: mu_p, shape (P, d).
            z: Real trajectories, shape (N, d).

        Returns:
            E and dE/dmu, shape (P, d).
        """
        residual = self.follow(mean) - z
        slope = sum_by(self.line.phone, self._pull(self._solve(2 * residual)), len(mean))
        return float(np.sum(residual**2)), slope

    def slope_of(self, z: Array) -> Callable[[Array], Array]:
        """dE/dmu as a function of mu, for many means and one z (N, d).

        Where dimensions are apart, y_j = G_j mu_j, and E is quadratic: dE/dmu_j at mu is that at 0
        and 2 G_j' G_j mu_j more. Full models take the adjoint every time.
        """
        if self.precision.ndim == 3:
            return lambda mean: self.error_and_slope(mean, z)[1]
        at_zero = self.error_and_slope(np.zeros((self.precision.shape[0], z.shape[1])), z)[1]
        return lambda mean: at_zero + 2 * (self._gram @ mean.T[:, :, None])[:, :, 0].T

    @cached_property
    def _gram(self) -> Array:
        """G_j' G_j of diagonal models, shape (d, P, P): a solve for each phone that is there."""
        phone, n = self.line.phone, len(self.line.phone)
        present, column = np.unique(phone, return_inverse=True)
        gram = np.zeros((self.precision.shape[1], *2 * self.precision.shape[:1]))
        for j, precision in enumerate(self.precision.T):
            impulses = np.zeros((n, len(present)), order="F")
            impulses[np.arange(n), column] = self.line.weight * precision[phone]
            G = _solve(self.factor[:, j * n : (j + 1) * n], impulses)
            gram[j][np.ix_(present, present)] = G.T @ G
        return gram

    def _pull(self, x: Array) -> Array:
        """D' Sigma^-1 D x, (N, d) -> (N, d)."""
        P, d2 = self.precision[self.line.phone], self.line.weight[:, None]
        return np.asarray(d2 * (P * x if P.ndim == 2 else (P @ x[:, :, None])[:, :, 0]))

    def _solve(self, b: Array) -> Array:
        """A^-1 b, (N, d) -> (N, d)."""
        if self.precision.ndim == 2:
            return _solve(self.factor, b.T.ravel()).reshape(b.shape[::-1]).T
        return _solve(self.factor, b.ravel()).reshape(b.shape)


def factor_system(line: Timeline, models: PhonemeModels, smoothness: Array) -> System:
    """Factor A of Eq. 3, once for any means.

    Args:
        line: N frames, N > 0.
        models: Whose Sigma_p is used.
        smoothness: lambda of each dimension, shape (d,).

    Full models take 8 N d (k d + 1) bytes: 2 MB a second at 25 frames/s, d = 46 and k = 4.
    """
    P = models.precision
    band = _band(line, P, smoothness) if P.ndim == 2 else _coupled_band(line, P, smoothness)
    factor = cholesky_banded(band.T, lower=True, overwrite_ab=True, check_finite=False)
    return System(line, P, factor)


def _band(line: Timeline, precision: Array, smoothness: Array) -> Array:
    """A of all dimensions laid end to end as its lower band, shape (d N, k + 1)."""
    A = smoothness[:, None, None] * line.band
    A[:, :, 0] += (line.weight[:, None] * precision[line.phone]).T
    return np.asarray(A.reshape(-1, A.shape[2]))


def _coupled_band(line: Timeline, precision: Array, smoothness: Array) -> Array:
    """A frame by frame as its lower band: [t d + j, i] is entry (t d + j + i, t d + j)."""
    n, d, order = len(line.phone), len(smoothness), line.band.shape[1] - 1
    A = np.zeros((n, d, order * d + 1))
    A[:, :, ::d] = smoothness[:, None] * line.band[:, None, :]
    blocks = line.weight[:, None, None] * precision[line.phone]
    for j in range(d):
        A[:, j, : d - j] += blocks[:, j:, j]
    return A.reshape(n * d, -1)


def follow(line: Timeline, mean: Array, variance: Array, smoothness: float) -> tuple[Array, Array]:
    """Solve Eq. 3 in one dimension.

    Args:
        line: N frames.
        mean, variance: mu_p and sigma2_p of this dimension, shape (P,).
        smoothness: lambda.

    Returns:
        y, shape (N,), and the banded Cholesky factor of A, shape (k + 1, N), for the adjoint.
    """
    q, factor = _factored(line, variance, smoothness)
    return _solve(factor, q * mean[line.phone]), factor


def _factored(line: Timeline, variance: Array, smoothness: float) -> tuple[Array, Array]:
    """D' Sigma^-1 D of one dimension, shape (N,), and the factor of A."""
    q = line.weight * (1 / variance)[line.phone]
    A = smoothness * line.band
    A[:, 0] += q
    factor, failed = dpbtrf(A.T, lower=1, overwrite_ab=1)
    if failed:
        raise np.linalg.LinAlgError(f"A is not positive definite at frame {failed - 1}")
    return q, factor


def _solve(factor: Array, b: Array) -> Array:
    """A^-1 b. SciPy's `cho_solve_banded` takes a tenth more for its checks."""
    x: Array = dpbtrs(factor, b, lower=1)[0]
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
    q, factor = _factored(line, variance, smoothness)
    mu = mean[line.phone]
    y = _solve(factor, q * mu)
    residual = y - z
    pull = q * _solve(factor, residual)  # D^2 P g / 2
    by_mean = 2 * _sum_by_phone(line, pull, len(mean))
    by_log_variance = 2 * _sum_by_phone(line, pull * (y - mu), len(mean))
    return float(residual @ residual), by_mean, by_log_variance


def _sum_by_phone(line: Timeline, x: Array, n_phones: int) -> Array:
    return np.bincount(line.phone, x, n_phones).astype(np.float64)
