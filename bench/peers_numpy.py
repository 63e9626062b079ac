"""NumPy as a user would write it: BLAS where it can be used."""

import numpy as np


def blend(images, weights):
    """One product with a row of weights."""
    flat = images.reshape(len(images), -1)
    return lambda: (weights @ flat).reshape(-1, *images.shape[1:])


def normal_equations(images, wanted):
    """The product with the transpose, of which BLAS computes one half; then one with a column."""
    rows, column = images.reshape(len(images), -1), wanted.ravel()
    return lambda: np.vstack([rows @ rows.T, rows @ column])


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """All Gaussians at once, distances by a product."""
    ones = np.ones((len(points), 1), np.float32)
    extended = np.hstack([ones, points])

    def run():
        squares = (points**2).sum(1)[:, None] + (centres**2).sum(1) - 2 * points @ centres.T
        return extended @ affine.T + np.exp(-sharpness * squares) @ weights

    return run


def distance_scan(queries, corpus, weights):
    """A row of the corpus at a time, channels first, so that what is between stays in the cache."""
    q, c = (np.ascontiguousarray(np.moveaxis(a, -1, 0)) for a in (queries, corpus))
    x, y = np.empty((2, *queries.shape[:2]), np.float32)

    def one(n):
        np.subtract(q[0], c[0, n], out=x)
        np.subtract(q[1], c[1, n], out=y)
        x[:] = np.sqrt(np.multiply(x, x, out=x) + np.multiply(y, y, out=y))
        return x @ weights

    return lambda: np.stack([one(n) for n in range(len(corpus))], axis=1)
