"""Slow, obvious versions of the models of movement: dense matrices over whole sequences."""

import numpy as np


def drawn_labels(rng, number, *, labels="abc", length=(12, 20), first=None):
    """`number` rows of labels in runs of 1 to 5; `first` begins each."""
    rows = []
    for _ in range(number):
        n = rng.integers(*length)
        row = [first] if first else []
        while len(row) < n:
            row += [labels[rng.integers(len(labels))]] * rng.integers(1, 6)
        rows.append(row[:n])
    return rows


def dense_slds(system, rows):
    """The joint Gaussian of a sequence's x and y: mean (T d,), Cov x, Cov y (T d, T d).

    `system` has mu, nu (Q, d) and Sigma, A, Q, R (Q, d, d); x = L w + m, stacked over time.
    """
    T, d = len(rows), system["mu"].shape[1]
    m, noise = [], np.zeros((T * d, T * d))
    L = np.zeros((T * d, T * d))
    output = np.zeros((T * d, T * d))
    for t, p in enumerate(rows):
        at = slice(t * d, (t + 1) * d)
        noise[at, at] = system["Sigma" if t == 0 else "Q"][p]
        output[at, at] = system["R"][p]
        m.append(system["mu"][p] if t == 0 else system["A"][p] @ m[-1] + system["nu"][p])
        L[at, at] = np.eye(d)
        if t:
            before = slice((t - 1) * d, t * d)
            L[at] += system["A"][p] @ L[before]
    covariance = L @ noise @ L.T
    return np.concatenate(m), covariance, covariance + output


def dense_posterior(system, rows, y):
    """log p(y), E[x | y] (T, d) and Cov[x | y] (T d, T d) from the joint Gaussian."""
    mean, Cx, Cy = dense_slds(system, rows)
    e = y.ravel() - mean
    solved = np.linalg.solve(Cy, e)
    value = -0.5 * (e @ solved + np.linalg.slogdet(Cy)[1] + len(e) * np.log(2 * np.pi))
    return value, (mean + Cx @ solved).reshape(y.shape), Cx - Cx @ np.linalg.solve(Cy, Cx)


def dpds_design(A, rows):
    """X (T, 2P) of one dimension with x = X [mu; nu]; A is (P,)."""
    P = len(A)
    X = np.zeros((len(rows), 2 * P))
    X[0, rows[0]] = 1
    for t, p in enumerate(rows[1:], start=1):
        X[t] = A[p] * X[t - 1]
        X[t, P + p] += 1
    return X


def dpds_least_squares(A, rows, sequences):
    """Minimum-norm [mu; nu] (2P,) of one dimension by least squares over all frames."""
    X = np.concatenate([dpds_design(A, r) for r in rows])
    return np.linalg.lstsq(X, np.concatenate(sequences), rcond=None)[0]


def dpds_path(A, mu, nu, rows):
    """x (T,) of one dimension."""
    x = [mu[rows[0]]]
    for p in rows[1:]:
        x.append(A[p] * x[-1] + nu[p])
    return np.array(x)


def dpds_slope(A, mu, nu, rows, y):
    """dE/dA (P,) of E = sum (x - y)^2 of one dimension by Eq. 2 of Appendix A, as printed."""
    x = dpds_path(A, mu, nu, rows)
    by_A, total = np.zeros(len(A)), np.zeros(len(A))
    for t in range(1, len(rows)):
        by_A = A[rows[t]] * by_A
        by_A[rows[t]] += x[t - 1]
        total += 2 * (x[t] - y[t]) * by_A
    return total


def dense_brand(mean, variance, step_mean, step_variance):
    """The most likely y (T,) of one dimension; arguments (T,), a frame each."""
    T = len(mean)
    W = np.concatenate([np.eye(T), np.eye(T)[1:] - np.eye(T)[:-1]])
    P = np.diag(np.concatenate([1 / variance, 1 / step_variance[1:]]))
    m = np.concatenate([mean, step_mean[1:]])
    return np.linalg.solve(W.T @ P @ W, W.T @ P @ m)
