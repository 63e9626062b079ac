"""SciPy: `map_coordinates`, `RBFInterpolator`, distances."""

import numpy as np
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import map_coordinates


def sample(field, points):
    """One channel at a time."""
    return np.stack(
        [
            np.stack([map_coordinates(c, p.T[::-1], order=1, mode="nearest") for c in f.T], -1)
            for f, p in zip(field.swapaxes(1, 2), points, strict=True)
        ]
    )


def evaluate_rbf(points, centres, weights, affine, sharpness):
    """Its own interpolant of the values that the map has at the centres.

    It takes no weights and finds them anew, a hundredth of its time. They obey the side conditions,
    so that both are one function.
    """
    squares = ((centres[:, None] - centres) ** 2).sum(-1).astype(np.float64)
    extended = np.column_stack([np.ones(len(centres)), centres])
    values = extended @ affine.T + np.exp(-sharpness * squares) @ weights
    epsilon = float(np.sqrt(sharpness))
    return RBFInterpolator(centres, values, kernel="gaussian", epsilon=epsilon, degree=1)(points)
