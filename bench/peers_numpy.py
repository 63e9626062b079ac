"""NumPy as a user would write it: BLAS where it can be used."""

import numpy as np


def blend(images, weights):
    """One product with a row of weights."""
    return (weights @ images.reshape(len(images), -1)).reshape(-1, *images.shape[1:])


def normal_equations(images, wanted):
    """The product with the transpose, of which BLAS computes one half; then one with a column."""
    rows = images.reshape(len(images), -1)
    return np.vstack([rows @ rows.T, rows @ wanted.ravel()])


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """All Gaussians at once, distances by a product."""
    squares = (points**2).sum(1)[:, None] + (centres**2).sum(1) - 2 * points @ centres.T
    return affine[:, 0] + points @ affine[:, 1:].T + np.exp(-sharpness * squares) @ weights


def distance_scan(queries, corpus, weights):
    """A row of the corpus at a time, channels first, so that what is between stays in the cache."""
    q = np.ascontiguousarray(np.moveaxis(queries, -1, 0))
    x, y = np.empty((2, *queries.shape[:2]), np.float32)
    distance = np.empty((len(queries), len(corpus)), np.float32)
    for n, row in enumerate(corpus):
        c = np.ascontiguousarray(row.T)
        np.subtract(q[0], c[0], out=x)
        np.subtract(q[1], c[1], out=y)
        x[:] = np.sqrt(np.multiply(x, x, out=x) + np.multiply(y, y, out=y))
        distance[:, n] = x @ weights
    return distance
