"""Slow, obvious versions of the statistics of studies."""

from itertools import product
from math import comb, inf, log

import numpy as np
from scipy.optimize import minimize


def two_sided_by_counting(k, n):
    """The share of all 2^n outcomes of n fair coins that are no more likely than k heads."""
    outcomes = [sum(coins) for coins in product((0, 1), repeat=n)]
    return sum(comb(n, heads) <= comb(n, k) for heads in outcomes) / 2**n


def holm_by_hand(p):
    """Smallest level at which Holm's step-down procedure rejects each hypothesis, capped at 1."""
    p = list(p)
    adjusted = {}
    greatest = 0.0
    for rank, index in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        greatest = max(greatest, (len(p) - rank) * p[index])
        adjusted[index] = min(1.0, greatest)
    return [adjusted[i] for i in range(len(p))]


def bradley_terry_loss(wins, theta):
    """Minus the log-likelihood, choice by choice."""
    loss = 0.0
    for i in range(len(wins)):
        for j in range(len(wins)):
            if i != j:
                chance = np.exp(theta[i]) / (np.exp(theta[i]) + np.exp(theta[j]))
                loss -= wins[i][j] * (log(chance) if chance > 0 else -inf)
    return loss


def bradley_terry_by_search(wins):
    """theta of mean 0 by a search without derivatives, and its covariance by differences."""
    n = len(wins)

    def loss(free):
        return bradley_terry_loss(wins, np.append(free, -np.sum(free)))

    options = {"xatol": 1e-9, "fatol": 1e-12, "maxiter": 20000, "maxfev": 20000}
    free = minimize(loss, np.zeros(n - 1), method="Nelder-Mead", options=options).x
    theta = np.append(free, -free.sum())
    h = 1e-4
    hessian = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            a, b = h * np.eye(n)[i], h * np.eye(n)[j]
            corners = [(a + b, 1), (a - b, -1), (b - a, -1), (-a - b, 1)]
            hessian[i, j] = sum(s * bradley_terry_loss(wins, theta + d) for d, s in corners)
    return theta, np.linalg.pinv(hessian / (4 * h * h), rcond=1e-6)
