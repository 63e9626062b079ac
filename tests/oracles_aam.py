"""Appearance models as slow, obvious versions: a full SVD, pixel after pixel, dense solves."""

import numpy as np


def similarity(source, target, weights):
    """(a, b, t_x, t_y) that carries points (N, 2) to others best: a dense least-squares system."""
    rows, values = [], []
    for (x, y), (u, v), w in zip(source, target, np.sqrt(weights), strict=True):
        rows += [[w * x, -w * y, w, 0], [w * y, w * x, 0, w]]
        values += [w * u, w * v]
    return np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]


def carry(pose, points):
    """Points (N, 2) under a similarity, as complex numbers."""
    moved = (points[:, 0] + 1j * points[:, 1]) * (pose[0] + 1j * pose[1]) + pose[2] + 1j * pose[3]
    return np.stack([moved.real, moved.imag], axis=1)


def svd_components(rows):
    """Modes (r, D) and variances (r,) of differences from a mean (S, D)."""
    _, s, modes = np.linalg.svd(rows, full_matrices=False)
    return modes, s**2 / len(rows)


def triangle_of(vertices, triangles, x, y):
    """The first triangle that holds a point and the point's coordinates in it, or None."""
    for k, corners in enumerate(triangles):
        system = np.vstack([vertices[corners].T, np.ones(3)])
        if abs(np.linalg.det(system)) < 1e-9:
            continue
        shares = np.linalg.solve(system, [x, y, 1])
        if shares.min() >= -1e-9:
            return k, shares
    return None


def normal_light(texture, mean):
    """Gain and offset of each colour by dense least squares, (3, 2)."""
    light = []
    for c in range(3):
        system = np.stack([mean[:, c], np.ones(len(mean))], axis=1)
        light.append(np.linalg.lstsq(system, texture[:, c], rcond=None)[0])
    return np.array(light)


def gauss_newton_step(descent, hidden, missed, shape, prior):
    """One step dp of a fit: over dp and the amounts of all `hidden` images at once.

    descent: (n, D). hidden: (n, m). missed: (n,). shape: values that dp is taken from, (D,).
    prior: weight of what remains of them, (D,).
    """
    n, d = descent.shape
    m = hidden.shape[1]
    system = np.zeros((n + d, d + m))
    system[:n, :d], system[:n, d:] = descent, hidden
    system[n:, :d] = np.diag(np.sqrt(prior))
    values = np.concatenate([missed, np.sqrt(prior) * shape])
    return np.linalg.lstsq(system, values, rcond=None)[0][:d]
