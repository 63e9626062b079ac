"""Kalman filter and RTS smoother for labelled sequences: exact inference in a linear system.

    x_1 ~ N(mu, Sigma),   x_t = A x_{t-1} + nu + w_t,   y_t = x_t + v_t,  w ~ N(0, Q),  v ~ N(0, R)

with the parameters of each frame's label. Many sequences run side by side. A system of d dimensions
is G independent ones of b: (1, d) when full, (d, 1) when all is diagonal; both are this same code.

Source: Englebienne, Cootes & Rattray (NIPS 2007), section 3; the smoother is that of Rauch, Tung &
Striebel (1965).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.labelled import Batch, Floats


@dataclass(frozen=True)
class System:
    """Parameters by row, in blocks.

    Attributes:
        mu, nu: Shape (Q, G, b, 1).
        Sigma, A, Q, R: Shape (Q, G, b, b); Sigma, Q and R symmetric, positive definite.
    """

    mu: Floats
    Sigma: Floats
    A: Floats
    nu: Floats
    Q: Floats
    R: Floats


@dataclass(frozen=True)
class Posterior:
    """What is known of x given all of y; nothing is said after a sequence's end.

    Attributes:
        mean: E x_t, shape (S, T, G, b, 1).
        covariance: Cov x_t, shape (S, T, G, b, b).
        cross: Cov(x_t, x_{t-1}), shape (S, T, G, b, b); that of the first frame is zero.
        log_likelihood: log p(y) [nats], shape (S,).
    """

    mean: Floats
    covariance: Floats
    cross: Floats
    log_likelihood: Floats


@dataclass(frozen=True)
class _Filtered:
    """Given y up to each frame: x_t (mean, covariance), and x_t before y_t (ahead)."""

    mean: Floats
    covariance: Floats
    mean_ahead: Floats
    covariance_ahead: Floats
    log_likelihood: Floats


def smooth(system: System, batch: Batch) -> Posterior:
    """The distribution of x given y, and the likelihood of y, for every sequence of `batch`."""
    f = _filter(system, batch)
    mean, covariance, cross = f.mean.copy(), f.covariance.copy(), np.zeros_like(f.covariance)
    for t in range(len(batch.active) - 2, -1, -1):
        on = slice(batch.active[t + 1])  # sequences that go on after t
        A = system.A[batch.rows[on, t + 1]]
        J = multiply(
            multiply(f.covariance[on, t], transpose(A)), inverse(f.covariance_ahead[on, t + 1])
        )
        mean[on, t] += multiply(J, mean[on, t + 1] - f.mean_ahead[on, t + 1])
        news = covariance[on, t + 1] - f.covariance_ahead[on, t + 1]
        covariance[on, t] += multiply(multiply(J, news), transpose(J))
        cross[on, t + 1] = multiply(covariance[on, t + 1], transpose(J))
    return Posterior(mean, covariance, cross, f.log_likelihood)


def _filter(system: System, batch: Batch) -> _Filtered:
    S, T = batch.rows.shape
    G, b = system.A.shape[1:3]
    y = batch.y.reshape(S, T, G, b, 1)
    vector, matrix = np.zeros((S, T, G, b, 1)), np.zeros((S, T, G, b, b))
    f = _Filtered(vector, matrix, vector.copy(), matrix.copy(), np.zeros(S))
    for t, n in enumerate(batch.active):
        on, p = slice(n), batch.rows[:n, t]
        if t == 0:
            x, P = system.mu[p], system.Sigma[p]
        else:
            A = system.A[p]
            x = multiply(A, f.mean[on, t - 1]) + system.nu[p]
            P = multiply(multiply(A, f.covariance[on, t - 1]), transpose(A)) + system.Q[p]
        f.mean_ahead[on, t], f.covariance_ahead[on, t] = x, P
        R = system.R[p]
        e, certain = y[on, t] - x, inverse(P + R)
        K = multiply(P, certain)
        f.mean[on, t] = x + multiply(K, e)
        f.covariance[on, t] = symmetric(multiply(K, R))  # = P - K P
        distance = (e * multiply(certain, e)).sum(axis=(1, 2, 3))
        spread = log_determinant(P + R).sum(axis=1) + G * b * np.log(2 * np.pi)
        f.log_likelihood[on] -= 0.5 * (distance + spread)
    return f


def multiply(a: Floats, b: Floats) -> Floats:
    """Products of blocks; those of size 1 are numbers, which is much faster."""
    return np.asarray(a * b if a.shape[-1] == 1 else a @ b)


def inverse(a: Floats) -> Floats:
    """Inverses of symmetric blocks."""
    return np.asarray(1 / a) if a.shape[-1] == 1 else symmetric(np.asarray(np.linalg.inv(a)))


def transpose(a: Floats) -> Floats:
    """Transposed blocks."""
    return a.swapaxes(-1, -2)


def symmetric(a: Floats) -> Floats:
    """Blocks without what rounding made of their antisymmetric part."""
    return a if a.shape[-1] == 1 else (a + transpose(a)) / 2


def log_determinant(a: Floats) -> NDArray[np.float64]:
    """log |block|, the last two axes gone."""
    if a.shape[-1] == 1:
        return np.asarray(np.log(a[..., 0, 0]))
    return np.asarray(np.linalg.slogdet(a)[1])
