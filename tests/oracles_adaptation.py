"""Adaptation as slow, obvious versions: dense systems, one solve for each parameter, loops."""

import numpy as np
from oracles_trajectories import dense_difference


def dense_system(labels, segments, covariance, smoothness, order):
    """A and D' Sigma^-1 D over all T d unknowns, frame by frame; `covariance` maps a label."""
    n, d = len(labels), len(smoothness)
    durations = [sum(1 for other in segments if other == own) for own in segments]
    pull = np.zeros((n * d, n * d))
    for t, label in enumerate(labels):
        weight = max(1 - durations[t] / n, 0.02)
        pull[t * d : (t + 1) * d, t * d : (t + 1) * d] = weight * np.linalg.inv(covariance[label])
    w = dense_difference(n, order)
    smooth = np.kron(w.T @ w, np.diag(smoothness)) if n > order else 0
    return pull + smooth, pull


def dense_follow(labels, segments, mean, covariance, smoothness, order):
    """y (T, d) of Eq. 3; `mean` and `covariance` map a label."""
    A, pull = dense_system(labels, segments, covariance, smoothness, order)
    mu = np.concatenate([mean[label] for label in labels])
    return np.linalg.solve(A, pull @ mu).reshape(len(labels), -1)


def regression_slope(clips, R, mean, covariance, class_of, smoothness, order):
    """dE/dR_g by Eq. 16: dy/dR_g for one entry of one R_g after the other.

    clips: (z, labels, segments); R: (G, d, d + 1); mean, covariance, class_of map a label.
    """
    slope = np.zeros_like(R)
    xi = {label: np.r_[1, mu] for label, mu in mean.items()}
    moved = {label: R[class_of[label]] @ xi[label] for label in mean}
    for z, labels, segments in clips:
        A, pull = dense_system(labels, segments, covariance, smoothness, order)
        y = dense_follow(labels, segments, moved, covariance, smoothness, order)
        for g, i, j in np.ndindex(R.shape):
            unit = np.zeros(R.shape[1:])
            unit[i, j] = 1
            by_entry = [
                unit @ xi[label] if class_of[label] == g else np.zeros(len(unit))
                for label in labels
            ]
            dy = np.linalg.solve(A, pull @ np.concatenate(by_entry))
            slope[g, i, j] += -2 * (z - y).ravel() @ dy
    return slope


def mllr_row(z, xi, variance, start, free, ridge, scale):
    """One row of R_g by np.linalg.lstsq: the frames' equations, and the ridge's below them.

    z, variance: (n,) of the class's frames; xi: (n, d + 1); start: the row of [0 | I];
    free: the entries that may change; scale: s of each entry.
    """
    weight = 1 / np.sqrt(variance)
    frames = weight[:, None] * xi[:, free]
    held = np.sqrt(ridge * np.mean(1 / variance)) * np.diag(scale[free])
    off = weight * (z - xi @ start)
    change = np.linalg.lstsq(
        np.vstack([frames, held]), np.r_[off, np.zeros(len(free))], rcond=None
    )[0]
    row = start.copy()
    row[free] += change
    return row
