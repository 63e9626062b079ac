"""Slow, obvious versions of Eq. 3 and 4 of CE05: dense matrices, as the paper writes them."""

import numpy as np


def dense_difference(n_frames, order):
    """W_k: applying the first difference k times, shape (max(T - k, 0), T)."""
    w = np.eye(n_frames)
    for _ in range(min(order, n_frames)):
        w = w[1:] - w[:-1]
    return w


def dense_trajectory(labels, segments, mean, variance, smoothness, order):
    """y of one dimension; `mean` and `variance` map a label to a number."""
    n = len(labels)
    durations = [sum(1 for other in segments if other == own) for own in segments]
    d = np.diag([np.sqrt(max(1 - dur / n, 0.02)) for dur in durations])
    p = np.diag([1 / variance[label] for label in labels])
    mu = np.array([mean[label] for label in labels])
    w = dense_difference(n, order)
    a = d.T @ p @ d + smoothness * w.T @ w
    return np.linalg.solve(a, d.T @ p @ d @ mu)


def dense_error(utterances, mean, variance, smoothness, order):
    """E_a summed over utterances (z, labels, segments) of one dimension."""
    return sum(
        np.sum((z - dense_trajectory(labels, segments, mean, variance, smoothness, order)) ** 2)
        for z, labels, segments in utterances
    )
