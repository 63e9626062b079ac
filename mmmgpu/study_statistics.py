"""What choices between two say: exact tests, and one scale for all conditions (Bradley-Terry).

Choices are counted; undecided ones are left out by the caller. All tests are two-sided. The scale
is that of Bradley & Terry (Biometrika 39, 1952), without ties and without an effect of sides:
P(i is chosen over j) = 1 / (1 + exp(theta_j - theta_i)).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse.csgraph import connected_components
from scipy.special import expit
from scipy.stats import binomtest, norm

Array = NDArray[np.float64]

CONFIDENCE = 0.95
_STEPS, _CONVERGED = 100, 1e-10  # Newton's method: most steps, largest gradient [choices]


@dataclass(frozen=True)
class Shares:
    """The share of `first` among first + second choices, and how sure one can be of it.

    low, high: exact interval of Clopper and Pearson. p: of a share of one half, exact. With no
    choices at all share, low and high are None, and p is 1.
    """

    first: int
    second: int
    share: float | None
    low: float | None
    high: float | None
    p: float


def exact_shares(first: int, second: int) -> Shares:
    """The exact binomial test of equal chances; of signs, it is the sign test."""
    if first + second == 0:
        return Shares(first, second, None, None, None, 1.0)
    test = binomtest(first, first + second)
    low, high = test.proportion_ci(CONFIDENCE, method="exact")
    return Shares(first, second, float(test.statistic), float(low), float(high), float(test.pvalue))


def sign_test(differences: Sequence[float]) -> Shares:
    """How many of `differences` are above, and below, zero; those that are zero are dropped."""
    return exact_shares(sum(d > 0 for d in differences), sum(d < 0 for d in differences))


def holm(p: ArrayLike) -> Array:
    """The p-values (n,) of n tests, adjusted so that all of them hold together.

    Holm, Scandinavian Journal of Statistics 6 (1979).
    """
    p = np.asarray(p, np.float64)
    order = np.argsort(p, kind="stable")
    factors = np.arange(len(p), 0, -1)
    adjusted = np.empty_like(p)
    adjusted[order] = np.minimum(np.maximum.accumulate(p[order] * factors), 1)
    return adjusted


@dataclass(frozen=True)
class Scale:
    """theta (C,), mean 0, and the covariance (C, C) of its estimate, of rank C - 1."""

    theta: Array
    covariance: Array

    def intervals(self) -> tuple[Array, Array]:
        """Lower and upper ends (C,) of 95 % intervals, from the curvature at the maximum."""
        half = norm.isf((1 - CONFIDENCE) / 2) * np.sqrt(np.diag(self.covariance))
        return self.theta - half, self.theta + half


def has_scale(wins: ArrayLike) -> bool:
    """Whether the likelihood has a maximum (Ford, American Mathematical Monthly 64, 1957).

    wins: (C, C), how often i was chosen over j. However the conditions are divided in two groups,
    each must have been chosen over the other at least once.
    """
    graph = np.asarray(wins, np.float64) > 0
    return bool(connected_components(graph, directed=True, connection="strong")[0] == 1)


def bradley_terry(wins: ArrayLike) -> Scale:
    """theta of greatest likelihood for `wins` (C, C), of which `has_scale` holds.

    Newton's method, with steps halved where they go too far; the likelihood is concave. The
    covariance is the pseudo-inverse of the information matrix, where choices are independent.
    """
    w = np.asarray(wins, np.float64)
    n = w + w.T
    theta = np.zeros(len(w))
    for _ in range(_STEPS):
        p = expit(theta[:, None] - theta)  # P(i over j)
        gradient = (w - n * p).sum(axis=1)
        if np.abs(gradient).max() < _CONVERGED:
            break
        step = _covariance(n, p) @ gradient
        while _log_likelihood(w, theta + step) < _log_likelihood(w, theta):
            step = step / 2
            if np.abs(step).max() < _CONVERGED:
                break
        theta = theta + step
    return Scale(theta - theta.mean(), _covariance(n, expit(theta[:, None] - theta)))


def _covariance(n: Array, p: Array) -> Array:
    """Pseudo-inverse of the information n_ij p_ij p_ji, a graph's Laplacian."""
    weights = n * p * p.T
    np.fill_diagonal(weights, 0)
    information = np.diag(weights.sum(axis=1)) - weights
    return np.asarray(np.linalg.pinv(information, hermitian=True), np.float64)


def _log_likelihood(w: Array, theta: Array) -> float:
    return float(-(w * np.logaddexp(0, theta - theta[:, None])).sum())
