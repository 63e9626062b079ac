"""What the fit of a DPDS solves: mu and nu for given A, and the slope of the error along A.

For given A every x_t of the recursion x_1 = mu, x_t = A x_{t-1} + nu is linear in mu and nu. With

    C_t,m = dx_t / d(mu or nu of label m):   C_t = A_pit C_{t-1},  then C_t,pit += 1 (of nu)

least squares is D theta = b, D = sum C C', b = sum C y: the sums of the paper's Algorithm 1, whose
print has slips (see docs/dynamics.md). Parameters that no frame depends on are left out; of the
others D is positive definite. At the best mu and nu the slope of the error along A is that of
Appendix A, dx_t/dA_n = x_{t-1} [pi_t = n] + A_pit dx_{t-1}/dA_n, here summed from the end:

    l_t = 2 (x_t - y_t) + A_pi(t+1) l_{t+1},    dE/dA_n = sum over t in n, t >= 2, of l_t x_{t-1}

All dimensions are apart, and done at once. Frame 1 counts as any other (Sigma = R).

Source: Englebienne, Cootes & Rattray (NIPS 2007), Appendix A.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mmmgpu.labelled import Batch, Floats, Rows
from mmmgpu.phonemes import sum_by

BLOCK_NUMBERS = 4_000_000  # in the C of one stretch of time


@dataclass(frozen=True)
class Parameters:
    """A, mu and nu of P labels, shape (P, d) each; zero where no frame depends on them."""

    A: Floats
    mu: Floats
    nu: Floats


def profile(A: Floats, parts: Sequence[Batch]) -> tuple[Floats, Floats, Parameters]:
    """The least squared error that any mu and nu reach with `A`, and how it changes with A.

    Args:
        A: Shape (P, d).
        parts: The data.

    Returns:
        E = sum of (x - y)^2, shape (d,); dE/dA, shape (P, d); and the best parameters.
    """
    best = best_offsets(A, parts)
    error, slope = np.zeros(A.shape[1]), np.zeros_like(A)
    for batch in parts:
        x = trajectories(best, batch)
        residual = np.where(batch.real[..., None], x - batch.y, 0)
        error += (residual**2).sum(axis=(0, 1))
        slope += _slope(best, batch, x, residual)
    return error, slope, best


def trajectories(p: Parameters, batch: Batch) -> Floats:
    """x of every sequence, shape (S, T, d); of no meaning after a sequence's end."""
    x = np.zeros_like(batch.y)
    x[:, 0] = p.mu[batch.rows[:, 0]]
    for t, n in enumerate(batch.active[1:], start=1):
        r = batch.rows[:n, t]
        x[:n, t] = p.A[r] * x[:n, t - 1] + p.nu[r]
    return x


def _slope(p: Parameters, batch: Batch, x: Floats, residual: Floats) -> Floats:
    """dE/dA, shape (P, d), of the residuals x - y (S, T, d), which are zero after the end."""
    pull = 2 * residual
    for t in range(len(batch.active) - 2, -1, -1):
        n = batch.active[t + 1]
        pull[:n, t] += p.A[batch.rows[:n, t + 1]] * pull[:n, t + 1]
    later = batch.real[:, 1:]
    return sum_by(batch.rows[:, 1:][later], (pull[:, 1:] * x[:, :-1])[later], len(p.A))


def best_offsets(A: Floats, parts: Sequence[Batch]) -> Parameters:
    """mu and nu of least squared error for given `A`, (P, d)."""
    P, d = A.shape
    D, b = normal_equations(A, parts)
    used = np.flatnonzero(np.diagonal(D, axis1=1, axis2=2).any(axis=0))
    theta = np.zeros((d, 2 * P))
    theta[:, used] = np.linalg.solve(D[:, used[:, None], used], b[:, used, None])[..., 0]
    return Parameters(A, theta[:, :P].T.copy(), theta[:, P:].T.copy())


def normal_equations(A: Floats, parts: Sequence[Batch]) -> tuple[Floats, Floats]:
    """D (d, 2P, 2P) and b (d, 2P) of D [mu; nu] = b (Eq. 3), rows of unused parameters zero."""
    P, d = A.shape
    D, b = np.zeros((d, 2 * P + 1, 2 * P + 1)), np.zeros((d, 2 * P + 1))
    for batch in parts:
        slots, place = _slots(batch, P)
        own_D, own_b = _own_equations(A, batch, slots, place.shape[1])
        for s, at in enumerate(place):  # what fills a row up has coefficients of zero
            D[:, at[:, None], at] += own_D[s]
            b[:, at] += own_b[s]
    return D[:, :-1, :-1], b[:, :-1]


def _slots(batch: Batch, P: int) -> tuple[Rows, Rows]:
    """Each sequence's own parameters: slot 0 is the mu of its start, the others its nus.

    Returns:
        The slot of each frame's nu, shape (S, T); and which parameter each slot is, shape (S, K):
        n for mu_n, P + n for nu_n, 2 P for none.
    """
    slots = np.zeros_like(batch.rows)
    owned = []
    for s, T in enumerate(batch.lengths):
        labels, number = np.unique(batch.rows[s, 1:T], return_inverse=True)
        slots[s, 1:T] = number + 1
        owned.append([batch.rows[s, 0], *(P + labels)])
    most = max(map(len, owned))
    return slots, np.array([row + [2 * P] * (most - len(row)) for row in owned])


def _own_equations(
    A: Floats, batch: Batch, slots: Rows, K: int
) -> tuple[NDArray[np.float64], Floats]:
    """D (S, d, K, K) and b (S, d, K) of each sequence's own parameters."""
    S, T, d = batch.y.shape
    D, b = np.zeros((S, d, K, K)), np.zeros((S, d, K))
    stretch = max(1, BLOCK_NUMBERS // (S * K * d))
    C = np.zeros((S, d, K))
    for start in range(0, T, stretch):
        stop = min(start + stretch, T)
        block = np.zeros((S, d, stop - start, K))
        for t in range(start, stop):
            n = batch.active[t]
            if t == 0:
                C[:, :, 0] = 1
            else:
                C[:n] *= A[batch.rows[:n, t]][..., None]
                C[np.arange(n), :, slots[:n, t]] += 1
            block[:n, :, t - start] = C[:n]
        D += block.swapaxes(-1, -2) @ block
        y = batch.y[:, start:stop].swapaxes(1, 2)[:, :, None]
        b += (y @ block)[:, :, 0]
    return D, b
