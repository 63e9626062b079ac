"""Shapes: points of many pictures brought into one frame, whatever their place, size and turn.

    x = T(s),   T(p) = [a -b; b a] p + (t_x, t_y)

A shape is (N, 2), (x, y) [px]; a pose is the row (a, b, t_x, t_y) of the similarity T that carries
a shape s of the common frame to the points x of a picture. How shapes vary is found by
`mmmgpu.components`.

Sources: Goodall, "Procrustes methods in the statistical analysis of shape" (J. Royal Stat. Soc. B
53, 1991); Cootes & Taylor, "Statistical models of appearance for computer vision" (2004).
"""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SETTLED = 1e-10  # change of the mean as a share of its size at which Procrustes has ended
ITERATIONS = 100  # of it at most; 5 to 10 are usual


def fit_pose(source: Floats, target: Floats, weights: Floats) -> Floats:
    """The pose of least squares that carries `source` to `target`, (..., N, 2) both: (..., 4).

    sum_i w_i |T(source_i) - target_i|^2 is least over all similarities (no mirror images).

    weights: w, (N,), above 0.
    """
    w = weights / weights.sum()
    mean, middle = w @ source, w @ target
    x, y = source - mean[..., None, :], target - middle[..., None, :]
    power = ((x**2).sum(axis=-1) * w).sum(axis=-1)
    a = ((x * y).sum(axis=-1) * w).sum(axis=-1) / power
    b = ((x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]) * w).sum(axis=-1) / power
    turned = _turn(a, b, mean[..., None, :])[..., 0, :]
    return np.concatenate([np.stack([a, b], axis=-1), middle - turned], axis=-1)


def place(pose: Floats, points: Floats) -> Floats:
    """T(points): poses (..., 4), points (..., N, 2) -> (..., N, 2)."""
    placed: Floats = _turn(pose[..., 0], pose[..., 1], points) + pose[..., None, 2:]
    return placed


def inverse_pose(pose: Floats) -> Floats:
    """The pose that undoes `pose`, (..., 4)."""
    a, b = pose[..., 0], pose[..., 1]
    power = a**2 + b**2
    back = np.stack([a / power, -b / power], axis=-1)
    shift = _turn(back[..., 0], back[..., 1], -pose[..., None, 2:])[..., 0, :]
    return np.concatenate([back, shift], axis=-1)


def size_of(pose: Floats) -> Floats:
    """How much larger a shape is in the picture, poses (..., 4) -> (...)."""
    return np.hypot(pose[..., 0], pose[..., 1])


def _turn(a: Floats, b: Floats, points: Floats) -> Floats:
    a, b = np.asarray(a)[..., None], np.asarray(b)[..., None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([a * x - b * y, b * x + a * y], axis=-1)


def align(shapes: Floats, mean: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """`shapes` (T, N, 2) in the frame of `mean` (N, 2), by the poses that carry it nearest to them.

    What an aligned shape differs by is orthogonal (weighted) to all ways of moving, turning and
    enlarging the mean: the sum of the mean and of such differences is aligned as it is.

    weights: of the points, (N,); see `fit_pose`.

    Returns:
        The aligned shapes, (T, N, 2), and their poses, (T, 4): ``place(poses, aligned)`` gives the
        shapes back.
    """
    poses = fit_pose(np.broadcast_to(mean, shapes.shape), shapes, weights)
    return place(inverse_pose(poses), shapes), poses


def procrustes_mean(shapes: Floats, weights: Floats) -> Floats:
    """The mean shape of generalised Procrustes analysis, (T, N, 2) -> (N, 2) [px].

    Every shape is brought to the mean, the mean is taken anew, until it stays. Its centre is the
    origin, it stands as the first shape does, and its size is the shapes' mean size.

    weights: of the points, (N,); see `fit_pose`.
    """
    centred = shapes - shapes.mean(axis=1, keepdims=True)
    size = np.sqrt((centred**2).sum(axis=(1, 2))).mean()
    mean = centred[0] * (size / np.linalg.norm(centred[0]))
    for _ in range(ITERATIONS):
        moved, _ = align(centred, mean, weights)
        new = moved.mean(axis=0)
        new = place(fit_pose(new, centred[0], weights), new)  # or it would slowly turn
        new = (new - new.mean(axis=0)) * (size / np.linalg.norm(new - new.mean(axis=0)))
        settled = np.linalg.norm(new - mean) <= SETTLED * size
        mean = new
        if settled:
            break
    return np.asarray(mean)
