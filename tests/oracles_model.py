"""The mathematics of the morphable model as slow, obvious loops and enumerations."""

from itertools import combinations

import numpy as np

from mmmgpu.operations import fill_holes, forward_warp
from mmmgpu.synthesis import HOLE


def synthesize(basis, alpha, beta):
    """Eq. 1-2, prototype by prototype, with the reference operations."""
    moving = [i for i in range(len(basis.images)) if i != basis.reference]
    flow = np.zeros_like(basis.flows[0], np.float64)
    for a, i in zip(alpha, moving, strict=True):
        flow += a * basis.flows[i]
    image = np.zeros_like(basis.images[0], np.float64)
    for b, prototype, own in zip(beta, basis.images, basis.flows, strict=True):
        oriented = _filled_warp(flow - own, own)
        image += b * _filled_warp(prototype, oriented)
    return image


def _filled_warp(field, flow):
    warped, weight = forward_warp(field, flow, backend="numpy")
    return fill_holes(warped, weight, threshold=HOLE, backend="numpy")


def solve_simplex(gram, right):
    """min b' G b / 2 - h' b, b >= 0, sum b = 1: every set of positive b is tried."""
    n = len(right)
    best, least = None, np.inf
    for size in range(1, n + 1):
        for chosen in combinations(range(n), size):
            at = np.array(chosen)
            system = np.ones((size + 1, size + 1))
            system[:size, :size] = gram[np.ix_(at, at)]
            system[size, size] = 0
            solved = np.linalg.lstsq(system, np.append(right[at], 1.0), rcond=None)[0][:size]
            if (solved < -1e-12).any() or abs(solved.sum() - 1) > 1e-9:
                continue
            b = np.zeros(n)
            b[at] = solved
            cost = b @ gram @ b / 2 - right @ b
            if cost < least:
                best, least = b, cost
    return best


def path_lengths(points, neighbours):
    """Floyd-Warshall on the graph in which a point touches its nearest `neighbours`."""
    n = len(points)
    distance = np.linalg.norm(points[:, None] - points, axis=-1)
    length = np.full((n, n), np.inf)
    for i in range(n):
        for j in np.argsort(distance[i], kind="stable")[: neighbours + 1]:
            length[i, j] = length[j, i] = distance[i, j]
    for k in range(n):
        for i in range(n):
            for j in range(n):
                length[i, j] = min(length[i, j], length[i, k] + length[k, j])
    return length


def smooth(values, weight, smoothness):
    """min_s sum_t weight_t |s_t - values_t|^2 + smoothness |second differences|^2, dense."""
    n = len(values)
    second = np.zeros((max(n - 2, 0), n))
    for t in range(n - 2):
        second[t, t : t + 3] = 1, -2, 1
    system = np.diag(weight + 1e-9) + smoothness * second.T @ second
    return np.linalg.solve(system, weight[:, None] * values)


def bilinear(field, x, y):
    """`field` (H, W, C) read at one point, the border repeated."""
    h, w = field.shape[:2]
    x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
    i, j = int(min(y, h - 2)), int(min(x, w - 2))
    u, v = x - j, y - i
    top = (1 - u) * field[i, j] + u * field[i, j + 1]
    low = (1 - u) * field[i + 1, j] + u * field[i + 1, j + 1]
    return (1 - v) * top + v * low
